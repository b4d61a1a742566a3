"""A run that begins in motion is no physics; what all runs begin with alike is no start."""

import numpy as np
import pytest

from diffsim.data.study import Channel, Run, Study
from diffsim.data.study_file import load_study
from diffsim.diagnose.checks.starts import _usual, start_problems
from diffsim.systems.registry import setup_of
from labs.records.rigs import pendulum

STATED = {"q": 0, "w": 0}
MEASURED = {"q": "first_angle", "w": "first_rate"}


@pytest.mark.parametrize(
    ("first_rows", "offset", "states", "said"),
    [
        ((0, 0, 150), 0.0, STATED, "channel angle begins at "),
        ((0, 0, 150), 0.0, {"q": "first_angle", "w": 0}, "channel rate begins at "),
        ((0, 0, 150), 0.0, MEASURED, None),
        ((0, 0, 0), 0.5, STATED, None),  # as a sensor's offset has it
        ((0, 0, 0), 0.0, STATED, None),
    ],
)
def test_a_run_that_begins_in_motion_is_told_with_its_states(
    first_rows, offset, states, said, tmp_path
):
    rig = pendulum(np.random.default_rng(5))
    tables = dict(rig.tables)
    for run, row in zip("abc", first_rows, strict=True):
        table = {name: values[row:] for name, values in tables[run].items()}
        table["time_s"] = table["time_s"] - table["time_s"][0]
        tables[run] = {**table, "angle_rad": table["angle_rad"] + offset}
    model = {**rig.study["model"], "states": states}
    study = load_study(rig.changed(tables, model=model).write(tmp_path / "rig"))
    problems = list(start_problems(study, setup_of(study)))
    assert [p.where for p in problems] == (["run c"] if said else [])
    stated = {name for name, start in states.items() if start == 0}
    assert not said or said in problems[0].message
    assert not said or all(f"{n}: {MEASURED[n]}" in problems[0].message for n in stated)


@pytest.mark.parametrize(
    ("start", "room", "is_said"),
    [
        ({"value": 20, "sd": 1.5, "per": "run"}, 20, True),
        (20, 20, True),  # known exactly, as they say, and 1 K off
        ({"value": "20 degC", "sd": 1.5, "per": "run"}, "20 degC", False),
        ({"value": 290, "sd": 5, "per": "run"}, 293, False),
        ({"value": 20, "sd": 300, "per": "run"}, 20, False),  # as the study knows no start
    ],
)
def test_numbers_in_degrees_celsius_beside_readings_in_kelvin_are_told(start, room, is_said):
    """An offset of 273 K was answered as two causes of sensors and a turned heater."""
    time, rng = 10.0 * np.arange(300), np.random.default_rng(1)
    runs = []
    for name, begin in (("a", 20.5), ("b", 19.0)):
        seen = 293.15 + (begin - 20.0) * np.exp(-time / 2e3) + 0.1 * rng.standard_normal(300)
        runs.append(Run(name, time, seen[:, None], {"heat": np.zeros(300)}, name))
    model = {
        "system": "ode",
        "states": {"a": start},
        "rates": {"a": "(heat - k*(a - room))/C"},
        "inputs": ["heat"],
        "parameters": {"k": 5.0, "C": {"value": 1e4, "percent": 5}, "room": room},
        "readings": {"top": "a"},
    }
    channels = (Channel("top", "K", "temperature", sd=0.1),)
    study = Study("tank", "ode", channels, tuple(runs), model=model)
    problems = [p.message for p in start_problems(study, setup_of(study))]
    assert len(problems) == is_said
    assert not is_said or "is in K; write `20 degC` in `states:`" in problems[0]


def test_the_usual_speed_of_a_line_is_its_slope():
    time = 0.1 * np.arange(120)
    run = Run("a", time, np.stack([3.0 * time, -0.5 * time], 1), {}, "a")
    motion, speed = _usual([run])
    np.testing.assert_allclose(speed, [3.0, 0.5], rtol=1e-9)
    np.testing.assert_allclose(motion, np.std(time) * speed, rtol=1e-9)


@pytest.mark.parametrize(("slip", "turned"), [(0.7, 0.0), (0.0, 0.5)])
def test_a_slope_that_no_start_gives_is_no_start(slip, turned):
    """A wheel that slips under load blamed the record; a rover that begins turned still does."""
    rng, time = np.random.default_rng(7), 0.05 * np.arange(200)
    runs = []
    for k, loaded in enumerate((0.0, 0.0, 1.0)):
        speed = 1.0 + 0.2 * np.sin(time)
        course = turned * loaded + 0.3 * time
        gone = np.cumsum((1.0 - slip * loaded) * speed * np.exp(1j * course)) * 0.05
        seen = np.stack([gone.real, gone.imag, course], 1) - [gone.real[0], gone.imag[0], 0.0]
        noisy = seen + 2e-3 * rng.standard_normal(seen.shape)
        command = {"v": speed, "turn": np.full(len(time), 0.3)}
        runs.append(Run("abc"[k], time, noisy, command, "abc"[k], k))
    model = {
        "system": "ode",
        "states": {"px": "0 m", "py": "0 m", "th": "0 rad"},
        "rates": {"px": "r*v*cos(th)", "py": "r*v*sin(th)", "th": "turn"},
        "inputs": ["v", "turn"],
        "parameters": {"r": {"value": 1.0, "percent": 2}},
        "readings": {"x": "px", "y": "py", "yaw": "th"},
    }
    channels = (
        Channel("x", "m", "position", sd=2e-3),
        Channel("y", "m", "position", sd=2e-3),
        Channel("yaw", "rad", "angle", sd=2e-3),
    )
    study = Study("rover", "ode", channels, tuple(runs), model=model)
    problems = list(start_problems(study, setup_of(study)))
    assert [p.where for p in problems] == (["run c"] if turned else [])
