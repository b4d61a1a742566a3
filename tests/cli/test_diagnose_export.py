"""`diagnose export`: constants in the words of other programs, from the file of an answer."""

import json

import numpy as np
import pytest
import yaml

from diffsim.cli import main
from diffsim.identify.model_file import read_extended
from diffsim.identify.ranges import range_of

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
        "bam": {"model": "'m1'", "kt": "kt", "scale": "1 + sensor_scale"},
    },
}
SAVED = {
    "model": "motor",
    "study": "motor",
    "verdict": "none",
    "parameters": {
        "kt": {"value": 3.0, "sd": 0.01, "unit": "N m/A", "low": 2.7, "high": 3.6},
        "resistance": {"value": 6.0, "sd": 0.02, "unit": "ohm", "low": 5.4, "high": 7.2},
    },
    "effects": {},
}


@pytest.fixture
def folder(tmp_path):
    time_s = 0.01 * np.arange(50)
    rows = [f"{t:.2f},{np.sin(t):.4f},{np.sin(3 * t):.4f}" for t in time_s]
    for name in "ab":
        (tmp_path / f"{name}.csv").write_text("\n".join(["time_s,speed,duty", *rows]))
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(STUDY))
    (tmp_path / "answer").mkdir()
    save(tmp_path, SAVED)
    return tmp_path


def save(folder, content):
    (folder / "answer" / "extended_model.yaml").write_text(yaml.safe_dump(content))


def export(folder):
    return main(["diagnose", "export", str(folder), "--out", str(folder / "answer")])


def wrote(folder, name):
    return json.loads((folder / "answer" / f"{name}.json").read_text())


def test_constants_are_formulas_of_the_saved_values(folder, capsys):
    assert export(folder) == 0
    assert wrote(folder, "mujoco") == {"damping": 1.5, "forcerange": 6.0}
    assert wrote(folder, "bam") == {"model": "m1", "kt": 3.0, "scale": 1.0}
    said = capsys.readouterr().out
    assert "verdict: none" in said
    assert "kt                                  3 (2.7 to 3.6)" in said
    assert "Not in the model, so taken as 0: sensor_scale." in said


def test_a_formula_may_spell_a_cause_by_another_case(folder):
    """Causes have the case of their places, which was all small in 1.0.0."""
    model = {**STUDY["model"], "effects": {"only": ["Sensor_Scale"]}}
    study = {**STUDY, "model": model, "export": {"mujoco": {"gain": "2 + SENSOR_scale"}}}
    (folder / "study.yaml").write_text(yaml.safe_dump(study))
    scale = {"value": 0.5, "sd": 0.01, "unit": "-", "low": 0.4, "high": 0.6}
    save(folder, {**SAVED, "effects": {"sensor_scale": scale}})
    assert export(folder) == 0
    assert wrote(folder, "mujoco") == {"gain": 2.5}


def test_a_number_has_the_interval_of_the_answer_not_of_the_fit(folder):
    assert export(folder) == 0
    found = wrote(folder, "export")["bam"]["kt"]
    # 16,384 even draws: ends to a hundredth of a standard deviation, here 0.004
    assert [found["low"], found["high"]] == pytest.approx([2.7, 3.6], abs=0.004)


def test_numbers_that_are_known_together_make_a_narrow_interval(folder):
    apart = width(folder)
    save(folder, SAVED | {"correlation": {"resistance": {"kt": 0.99}}})
    # of a ratio of two numbers with relative widths of s: s sqrt(2 (1 - r)), 0.1 of that with r = 0
    assert width(folder) == pytest.approx(0.1 * apart, rel=0.05)


def width(folder):
    saved = read_extended(folder / "answer")
    found = range_of(lambda v: v["kt"] / v["resistance"], ["kt", "resistance"], saved)
    return found.high - found.low


def test_a_file_of_before_says_that_its_intervals_are_of_the_fit(folder, capsys):
    old = {n: {k: e[k] for k in ("value", "sd", "unit")} for n, e in SAVED["parameters"].items()}
    save(folder, SAVED | {"parameters": old})
    assert export(folder) == 0
    assert "these are of its fit alone, too narrow" in capsys.readouterr().out
    assert wrote(folder, "export")["bam"]["kt"]["high"] == pytest.approx(3.0165, abs=2e-4)


def test_a_size_without_sign_is_never_below_zero(folder):
    size = {"value": 0.01, "sd": 0.001, "unit": "-", "low": 0.0, "high": 0.09}
    save(folder, SAVED | {"effects": {"sensor_scale": size}})
    assert export(folder) == 0
    low = wrote(folder, "export")["bam"]["scale"]["low"]
    assert 1.0 <= low < 1.0 + 1e-5


def test_each_device_has_a_file_of_its_own(folder, capsys):
    given = STUDY["model"]["parameters"] | {"kt": {"value": 2.0, "percent": 50, "per": "servo"}}
    runs = [{"file": f"{name}.csv", "setup": {"servo": name}} for name in "ab"]
    stated = STUDY | {"model": STUDY["model"] | {"parameters": given}, "runs": runs}
    (folder / "study.yaml").write_text(yaml.safe_dump(stated))
    kt, resistance = SAVED["parameters"].values()
    other = kt | {"value": 4.0, "low": 3.9, "high": 4.1}
    save(
        folder,
        SAVED | {"parameters": {"kt[servo=a]": kt, "kt[servo=b]": other, "resistance": resistance}},
    )
    assert export(folder) == 0
    assert [wrote(folder, f"bam_{name}")["kt"] for name in "ab"] == [3.0, 4.0]
    assert wrote(folder, "mujoco_b")["forcerange"] == pytest.approx(8.0)
    assert "bam, servo b:" in capsys.readouterr().out


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


def test_an_interval_must_hold_its_value(folder, capsys):
    wrong = SAVED["parameters"]["kt"] | {"low": 3.1}
    save(folder, SAVED | {"parameters": SAVED["parameters"] | {"kt": wrong}})
    assert export(folder) == 2
    assert "kt: value must lie from low to high" in capsys.readouterr().err


def test_the_speed_of_stribeck_friction_has_the_interval_of_its_shape(folder):
    model = {
        **STUDY["model"],
        "states": {"q": 0, "w": 0},
        "rates": {"q": "w", "w": "(supply*duty - kt*w)*kt/resistance"},
        "places": [{"name": "shaft", "position": "q", "velocity": "w", "unit": "N m"}],
        "effects": {"only": ["stribeck_friction_at_shaft"]},
    }
    speed = {"mujoco": {"stribeck_speed": "stribeck_speed_at_shaft"}}
    (folder / "study.yaml").write_text(yaml.safe_dump({**STUDY, "model": model, "export": speed}))
    assert export(folder) == 0
    (usual,) = wrote(folder, "mujoco").values()  # without the cause: where it had fallen
    fall = {"value": 0.5, "sd": 0.2, "unit": "-", "low": 0.2, "high": 0.9}
    found = {**SAVED["parameters"], "fall_of_stribeck_friction_at_shaft": fall}
    save(folder, {**SAVED, "parameters": found})
    assert export(folder) == 0
    found = wrote(folder, "export")["mujoco"]["stribeck_speed"]
    ends = [found["value"], found["low"], found["high"]]
    assert np.log(np.divide(ends, usual)) == pytest.approx([0.5, 0.2, 0.9], abs=0.004)
