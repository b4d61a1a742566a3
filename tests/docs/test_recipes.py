"""The recipes run as they stand, each in an empty folder, with no name of another one."""

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
    seen = {}
    for k, recipe in enumerate(re.split(r"\n## ", PAGE.read_text("utf-8"))):
        (tmp_path / str(k)).mkdir()
        monkeypatch.chdir(tmp_path / str(k))
        seen |= _run(recipe)

    def read(path):
        (found,) = tmp_path.glob(f"*/{path}")
        return json.loads(found.read_text())

    fitted = read("fitted/fit.json")
    assert 2.97e5 < _value(fitted, "youngs_modulus") < 3.04e5
    assert abs(float(seen["stiffness"].grad.sum())) > 0.0
    assert 2.9e5 < float(seen["np"].exp(seen["found"].x)[0]) < 3.1e5
    assert len([*tmp_path.glob("*/flight/flight.csv")]) == 1
    assert abs(_value(read("fitted_lever/fit.json"), "mass") - 1.15) < 0.01
    assert 0.88 < _value(read("fitted_arm/fit.json"), "body.rod.mass") < 0.96
    (motor,) = read("which_motor/faults.json")["verdicts"]
    assert (motor["group"], motor["causes"]) == ("x", ["loss_2"])
    found = read("which_sensor/report.json")
    assert found["named"] == ["sensor_scale_of_camera"]
    constants = read("answer/mujoco.json")
    assert abs(_value(constants, "kp") - 12.0) < 1.5


def _run(recipe):
    """What the blocks of a recipe leave as names."""
    names = {"__name__": "__main__"}
    for kind, text in re.findall(r"```(python|yaml|sh)\n(.*?)```", recipe, re.S):
        if kind == "python":
            exec(compile(text, "docs/recipes.md", "exec"), names)
        elif kind == "yaml":
            Path(text.split("\n")[0].removeprefix("# ")).write_text(text)
        else:
            for line in text.strip().splitlines():
                assert main(shlex.split(line.removeprefix("diffsim "))) == 0, line
    return names


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
