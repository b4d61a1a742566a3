"""The recipes run as they stand, one after the other, in an empty folder."""

import json
import re
import shlex
from pathlib import Path

import pytest

from diffsim.cli import main
from tests.optional import needs

needs("mujoco", reason="a URDF is read by MuJoCo")
needs("stable_baselines3", reason="PPO")
needs("matplotlib", reason="pages")

PAGE = Path(__file__).resolve().parents[2] / "docs" / "recipes.md"


@pytest.mark.example
@pytest.mark.story
def test_recipes_run_as_they_stand(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "__main__"}
    for kind, text in re.findall(r"```(python|yaml|sh)\n(.*?)```", PAGE.read_text("utf-8"), re.S):
        if kind == "python":
            exec(compile(text, "docs/recipes.md", "exec"), names)
        elif kind == "yaml":
            Path(text.split("\n")[0].removeprefix("# ")).write_text(text)
        else:
            for line in text.strip().splitlines():
                assert main(shlex.split(line.removeprefix("diffsim "))) == 0, line
    fitted = json.loads(Path("fitted/fit.json").read_text())
    assert 2.97e5 < _value(fitted, "youngs_modulus") < 3.04e5
    assert abs(float(names["stiffness"].grad.sum())) > 0.0
    assert 2.9e5 < float(names["np"].exp(names["found"].x)[0]) < 3.1e5
    assert Path("flight/flight.csv").is_file()
    assert abs(_value(json.loads(Path("fitted_lever/fit.json").read_text()), "mass") - 1.15) < 0.01
    assert (
        0.88 < _value(json.loads(Path("fitted_arm/fit.json").read_text()), "body.rod.mass") < 0.96
    )
    (motor,) = json.loads(Path("which_motor/faults.json").read_text())["verdicts"]
    assert (motor["group"], motor["causes"]) == ("x", ["loss_2"])
    found = json.loads(Path("which_sensor/report.json").read_text())
    assert found["named"] == ["sensor_scale_of_camera"]
    constants = json.loads(Path("answer/mujoco.json").read_text())
    assert abs(_value(constants, "kp") - 12.0) < 1.5


def _value(found, name):
    """A number by its name, wherever the file has it."""
    if isinstance(found, dict):
        for key, inner in found.items():
            if key == name:
                return inner["value"] if isinstance(inner, dict) else float(inner)
            if (value := _value(inner, name)) is not None:
                return value
    if isinstance(found, list):
        for inner in found:
            if isinstance(inner, dict) and inner.get("name") == name:
                return inner["value"]
    return None
