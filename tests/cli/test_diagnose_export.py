"""`diagnose export`: constants in the words of other programs, from the file of an answer."""

import json

import numpy as np
import pytest
import yaml

from diffsim.cli import main

STUDY = {
    "name": "motor",
    "model": {
        "system": "ode",
        "parameters": {
            "supply": "12 V",
            "kt": {"value": 2.0, "percent": 50},
            "resistance": {"value": 4.0, "percent": 50},
        },
        "inputs": ["duty"],
        "states": {"w": 0},
        "rates": {"w": "(supply*duty - kt*w)*kt/resistance"},
        "readings": {"speed": "w"},
        "effects": {"only": ["sensor_scale"]},
    },
    "channels": [{"name": "speed", "unit": "rad/s", "sd": 0.01}],
    "commands": ["duty"],
    "runs": [{"file": "a.csv"}],
    "export": {
        "mujoco": {"damping": "kt**2/resistance", "forcerange": "supply*kt/resistance"},
        "bam": {"kt": "kt", "scale": "1 + sensor_scale"},
    },
}
SAVED = {
    "model": "motor",
    "study": "motor",
    "verdict": "none",
    "parameters": {
        "kt": {"value": 3.0, "sd": 0.3, "unit": "N m/A"},
        "resistance": {"value": 6.0, "sd": 0.8, "unit": "ohm"},
    },
    "effects": {},
}


@pytest.fixture
def folder(tmp_path):
    time_s = 0.01 * np.arange(50)
    rows = [f"{t:.2f},{np.sin(t):.4f},{np.sin(3 * t):.4f}" for t in time_s]
    (tmp_path / "a.csv").write_text("\n".join(["time_s,speed,duty", *rows]))
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(STUDY))
    (tmp_path / "answer").mkdir()
    (tmp_path / "answer" / "extended_model.yaml").write_text(yaml.safe_dump(SAVED))
    return tmp_path


def export(folder):
    return main(["diagnose", "export", str(folder), "--out", str(folder / "answer")])


def test_constants_are_formulas_of_the_saved_values(folder, capsys):
    assert export(folder) == 0
    wrote = {p: json.loads((folder / "answer" / f"{p}.json").read_text()) for p in STUDY["export"]}
    assert wrote["mujoco"] == {"damping": 1.5, "forcerange": 6.0}
    assert wrote["bam"] == {"kt": 3.0, "scale": 1.0}
    said = capsys.readouterr().out
    # kt**2/resistance: 2 * 3 / 6 * 0.3 = 0.3 and 9 / 36 * 0.8 = 0.2, at right angles
    assert "damping                           1.5 +- 0.36" in said


def test_a_name_that_there_is_not_is_told_with_the_closest(folder, capsys):
    stated = STUDY | {"export": {"mujoco": {"damping": "kt**2/resistence"}}}
    (folder / "study.yaml").write_text(yaml.safe_dump(stated))
    assert export(folder) == 2
    assert "export.mujoco.damping: no number 'resistence'; did you mean 'resistance'" in (
        capsys.readouterr().err
    )
    (folder / "study.yaml").write_text(yaml.safe_dump(STUDY | {"export": {}}))
    assert export(folder) == 2
    assert "no `export` in the study" in capsys.readouterr().err
