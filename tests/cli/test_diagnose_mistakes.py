"""Mistakes that strangers made in their first study, each of which `check` once let through."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from diffsim import cli

BASE: dict[str, Any] = {
    "name": "servo",
    "time": {"column": "Zeit [ms]", "unit": "ms"},
    "channels": [{"name": "Ist", "column": "Ist [°]", "unit": "deg", "sd": 0.1}],
    "commands": [{"name": "Soll", "column": "Soll [°]", "unit": "deg", "lower": -30, "upper": 30}],
    "runs": [
        {"name": "a", "file": "a.csv"},
        {"name": "b", "file": "b.csv"},
        {"name": "c", "file": "c.csv", "use": "test"},
    ],
    "model": {
        "system": "ode",
        "parameters": {"J": {"value": 0.002, "percent": 10}, "kp": "0.9 N m", "kd": 0.045},
        "inputs": ["Soll"],
        "states": {"theta": 0, "omega": 0},
        "rates": {"theta": "omega", "omega": "(kp*(Soll - theta) - kd*omega)/J"},
        "readings": {"Ist": "theta"},
        "places": [{"name": "shaft", "position": "theta", "velocity": "omega", "inertia": "J"}],
    },
}


@pytest.fixture
def folder(tmp_path):
    t = np.arange(30) * 10.0
    for seed, name in enumerate("abc"):
        soll = 10.0 * np.sin((seed + 1) * t / 50.0)
        ist = soll + 0.1 * np.random.default_rng(seed).normal(size=30)
        rows = ["Zeit [ms];Soll [°];Ist [°]"]
        rows += [f"{a:g};{b:.4f};{c:.4f}" for a, b, c in zip(t, soll, ist, strict=True)]
        text = "\n".join([rows[0], *(r.replace(".", ",") for r in rows[1:])])
        (tmp_path / f"{name}.csv").write_bytes(text.encode("cp1252"))
    return tmp_path


def told(folder: Path, capsys, at: str = "", value: Any = None) -> tuple[int, str]:
    """Exit code and what `check` says after a change of one key, such as model.rates.omega."""
    study = copy.deepcopy(BASE)
    if at:
        *way, last = at.split(".")
        part = study
        for key in way:
            part = part[int(key) if isinstance(part, list) else key]
        part[int(last) if isinstance(part, list) else last] = value
    (folder / "study.yaml").write_text(yaml.safe_dump(study, allow_unicode=True), encoding="utf-8")
    code = cli.main(["diagnose", "check", str(folder)])
    said = capsys.readouterr()
    return code, said.out + said.err


def test_without_a_mistake_nothing_is_said(folder, capsys):
    code, said = told(folder, capsys)
    assert code == 0 and "error" not in said and "warning" not in said, said


ERRORS = {
    "a power written ^": ("model.rates.omega", "-kp*theta^2/J", "a power is written **"),
    "a place that moves like it lies": (
        "model.places.0.velocity",
        "theta",
        "is its position, too; name the other state",
    ),
    "limits the wrong way round": ("commands.0.lower", 40, "lower must be below upper, got 40"),
    "units of two quantities": (
        "model.parameters.kp",
        {"value": "3 mm", "unit": "s"},
        "unit 's' is no unit of the quantity",
    ),
    "a decimal comma": ("model.parameters.kp", "0,9 N m", "use a decimal point"),
    "German degrees": ("channels.0.unit", "Grad", "write deg for degrees, gon for gradians"),
    "a division by 0": (
        "model.rates.omega",
        "(kp*(Soll - theta) - kd*omega)/J/theta",
        "gives no number",
    ),
    "a cause of a known name": (
        "model.effects",
        {"own": [{"name": "lag", "adds_to": "omega", "term": "size", "typical": 1}]},
        "there is a cause 'lag' already",
    ),
    "a cause that acts at size 0": (
        "model.effects",
        {"own": [{"name": "magnet", "adds_to": "omega", "term": "9 + size", "typical": 1}]},
        "model.effects.own magnet: it acts although its size is 0",
    ),
    "a channel in a rate": (
        "model.rates.omega",
        "(kp*(Soll - Ist) - kd*omega)/J",
        "Ist is a channel: write what its reading is made of",
    ),
    "an equation for a formula": (
        "model.rates.omega",
        "d_omega = -kp*theta/J",
        "write what is right of the = alone",
    ),
    "a copy for a repeat": (
        "runs.1",
        {"name": "b", "file": "a.csv", "repeat_of": "a"},
        "run b: it is a copy of run a",
    ),
    "a key at another level": ("parameters", {"J": 1}, "study.yaml: no key 'parameters' here"),
}


@pytest.mark.parametrize("mistake", ERRORS)
def test_a_mistake_is_an_error(folder, capsys, mistake):
    at, value, message = ERRORS[mistake]
    code, said = told(folder, capsys, at, value)
    assert code == 2 and message in said, said
    assert "Traceback" not in said


WARNINGS = {
    "seconds for milliseconds": ("time.unit", "s", "the header 'Zeit [ms]' says ms"),
    "radians for degrees": ("channels.0.unit", "rad", "the header 'Ist [°]' says °"),
    "a parameter without use": ("model.parameters.extra", 1.0, "extra: no formula uses it"),
    "a force in grams": (
        "channels.0",
        {"name": "thrust", "column": "Ist [°]", "unit": "g", "sd": 1},
        "g is a mass; of a force write gf",
    ),
}


@pytest.mark.parametrize("mistake", WARNINGS)
def test_a_doubt_is_a_warning(folder, capsys, mistake):
    at, value, message = WARNINGS[mistake]
    _, said = told(folder, capsys, at, value)
    assert message in said, said


def _with_header(folder: Path, old: str, new: str) -> None:
    for file in folder.glob("*.csv"):
        text = file.read_bytes().decode("cp1252")
        file.write_bytes(text.replace(old, new, 1).encode("cp1252"))


HEADERS = {
    "kelvins for degrees Celsius": ("Ist [°C]", "K", "says °C, the study says unit: K"),
    "radians for an ending in degrees": ("Ist_deg", "rad", "says deg, the study says unit: rad"),
    "minutes for seconds": (None, None, "the header 'min' says min, the study says unit: s"),
    "a letter that is no unit": ("Ist_m", "deg", None),
    "revolutions of engineers": ("Ist [1/min]", "rpm", None),
}


@pytest.mark.parametrize("case", HEADERS)
def test_units_of_headers_are_held_against_the_study(folder, capsys, case):
    header, unit, message = HEADERS[case]
    if header is None:
        _with_header(folder, "Zeit [ms]", "min")
        _, said = told(folder, capsys, "time", {"column": "min", "unit": "s"})
    else:
        _with_header(folder, "Ist [°]", header)
        channel = {"name": "Ist", "column": header, "unit": unit, "sd": 0.1}
        _, said = told(folder, capsys, "channels.0", channel)
    assert (message in said) if message else "which is right" not in said, said


def test_a_counter_for_a_clock_is_told(folder, capsys):
    for file in folder.glob("*.csv"):
        head, *rows = file.read_bytes().decode("cp1252").splitlines()
        counted = [f"No.;{head}", *(f"{i};{row}" for i, row in enumerate(rows))]
        file.write_bytes("\n".join(counted).encode("cp1252"))
    _, said = told(folder, capsys, "time", {"column": "No."})
    assert "warning: time: column No. counts rows; give step" in said, said


def test_rows_without_a_clock_go_on_nowhere(folder, capsys):
    study = {**copy.deepcopy(BASE), "time": {"step": 0.01}}
    rows = [f.read_bytes().decode("cp1252").splitlines() for f in sorted(folder.glob("?.csv"))]
    lines = [f"trial;{rows[0][0]}"]
    for trial, table in zip("abc", rows, strict=True):
        lines += [f"{trial};{row}" for row in table[1:]]
    (folder / "all.csv").write_bytes("\n".join(lines).encode("cp1252"))
    study["runs"] = [
        {"name": "{trial}", "file": "all.csv", "split": "trial", "use": {"test": ["c"]}}
    ]
    (folder / "study.yaml").write_text(yaml.safe_dump(study, allow_unicode=True), encoding="utf-8")
    cli.main(["diagnose", "check", str(folder)])
    said = capsys.readouterr()
    assert "it goes on where run" not in said.out + said.err


def test_a_channel_that_a_run_lacks_altogether_is_told(folder, capsys):
    rows = (folder / "b.csv").read_bytes().decode("cp1252").splitlines()
    empty = [rows[0], *(row.rpartition(";")[0] + ";" for row in rows[1:])]
    (folder / "b.csv").write_bytes("\n".join(empty).encode("cp1252"))
    study = copy.deepcopy(BASE)
    study["channels"].append({"name": "Soll_2", "column": "Soll [°]", "unit": "deg", "sd": 0.1})
    study["model"]["readings"]["Soll_2"] = "Soll"
    (folder / "study.yaml").write_text(yaml.safe_dump(study, allow_unicode=True), encoding="utf-8")
    cli.main(["diagnose", "check", str(folder)])
    said = capsys.readouterr()
    assert "run b: Ist was not recorded: all its cells are empty" in said.out + said.err


def test_a_clock_since_1970_is_told_and_shown_in_full(folder, capsys):
    rows = (folder / "a.csv").read_bytes().decode("cp1252").splitlines()
    moved = [f"{1.7e12 + 10 * k:.0f};{r.partition(';')[2]}" for k, r in enumerate(rows[1:])]
    (folder / "a.csv").write_bytes("\n".join([rows[0], *moved]).encode("cp1252"))
    code, said = told(folder, capsys)
    assert code == 0
    assert "1700000000.00 .. 1700000000.29 s" in said
    assert "zero_time: start" in said
