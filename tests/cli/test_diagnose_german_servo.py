"""A servo with play in its gear, logged in degrees and milliseconds with decimal commas.

The recordings are made here by Euler steps of 0.5 ms that share nothing with diffsim.
"""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from diffsim import cli
from diffsim.data import load_study

INERTIA, STIFFNESS, DAMPING = 0.002, 0.9, 0.045  # kg m^2, N m/rad, N m s/rad
PLAY, STEP = np.deg2rad(2.4), 5e-4  # rad, s
COMMANDS = {  # degrees
    "sinus1": lambda t: 15.0 * np.sin(3.0 * t),
    "sinus1_wdh": lambda t: 15.0 * np.sin(3.0 * t),
    "sinus2": lambda t: 25.0 * np.sin(6.0 * t),
    "rampe": lambda t: 20.0 * (2.0 * abs((t / 2.0) % 1.0 * 2.0 - 1.0) - 1.0),
    "sprung": lambda t: (0.0, 10.0, -5.0, 20.0, 0.0, -12.0)[int(t / 0.7) % 6],
}
MODEL = {
    "system": "ode",
    "parameters": {
        "J": {"value": 0.0021, "percent": 10},
        "kp": {"value": "0.9 N m", "percent": 10},
        "kd": {"value": 0.045, "percent": 20},
    },
    "inputs": [{"name": "Soll", "held": True}],
    "states": {"theta": 0, "omega": 0},
    "rates": {"theta": "omega", "omega": "(kp*(Soll - theta) - kd*omega)/J"},
    "readings": {"Ist": "theta"},
    "places": [
        {
            "name": "shaft",
            "position": "theta",
            "velocity": "omega",
            "inertia": "J",
            "unit": "N m",
            "position_unit": "rad",
        }
    ],
}


def write_run(path: Path, command, rng: np.random.Generator) -> None:
    """One run as a logger writes it: rounded to 0.05 degrees, one cell in fifty empty."""
    angle = rate = seen = 0.0
    lines = ["Zeit [ms];Soll [°];Ist [°]"]
    for i in range(8000):
        asked = command(i // 20 * 0.01)
        rate += STEP * (STIFFNESS * (np.deg2rad(asked) - angle) - DAMPING * rate) / INERTIA
        angle += STEP * rate
        seen = min(max(seen, angle - 0.5 * PLAY), angle + 0.5 * PLAY)
        if i % 20 == 0:
            shown = round((np.rad2deg(seen) + 0.08 * rng.normal()) / 0.05) * 0.05
            cell = f"{shown:.3f}" if rng.random() > 0.02 else ""
            lines.append(f"{0.5 * i:.3f};{asked:.3f};{cell}".replace(".", ","))
    path.write_bytes(("\r\n".join(lines) + "\r\n").encode("cp1252"))


@pytest.fixture
def folder(tmp_path):
    rng = np.random.default_rng(11)
    for name, command in COMMANDS.items():
        write_run(tmp_path / f"{name}.csv", command, rng)
    assert cli.main(["diagnose", "init", str(tmp_path)]) == 0
    path = tmp_path / "study.yaml"
    guessed = yaml.safe_load(path.read_text(encoding="utf-8"))
    stated = {**guessed, "model": MODEL, "todo": []}
    path.write_text(yaml.safe_dump(stated, allow_unicode=True), encoding="utf-8")
    return tmp_path


def test_the_loggers_files_are_read_as_they_are(folder):
    study = load_study(folder)
    assert [c.name for c in study.channels] == ["Ist"]
    assert [c.name for c in study.commands] == ["Soll"]
    runs = {r.name: r for r in study.runs}
    assert runs["sinus1_wdh"].group == "sinus1" and runs["sprung"].use == "test"
    run = runs["sinus2"]
    assert run.time_s[-1] == pytest.approx(3.99)
    assert np.abs(run.command["Soll"]).max() == pytest.approx(np.deg2rad(25.0), rel=1e-3)
    assert 0.005 < np.isnan(run.measured).mean() < 0.05


@pytest.mark.slow
def test_play_at_the_output_is_named_with_its_size(folder, tmp_path_factory, capsys):
    out = tmp_path_factory.mktemp("out")
    assert cli.main(["diagnose", "check", str(folder)]) == 0
    assert cli.main(["diagnose", "explain", str(folder), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "Sensor backlash is missing" in said and "verdict: named" in said
    report = json.loads((out / "report.json").read_text())
    units = {row["what"]: row["unit"] for row in report["outside"]}
    assert units["rate of Soll"] == "rad/s"
    saved = yaml.safe_load((out / "extended_model.yaml").read_text(encoding="utf-8"))
    size = saved["effects"]["sensor_backlash"]["value"]
    assert size == pytest.approx(0.5 * PLAY, rel=0.05)
