"""A run that begins in motion is no physics; what all runs begin with alike is no start."""

import numpy as np
import pytest

from diffsim.data.study import Run
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


def test_the_usual_speed_of_a_line_is_its_slope():
    time = 0.1 * np.arange(120)
    run = Run("a", time, np.stack([3.0 * time, -0.5 * time], 1), {}, "a")
    motion, speed = _usual([run])
    np.testing.assert_allclose(speed, [3.0, 0.5], rtol=1e-9)
    np.testing.assert_allclose(motion, np.std(time) * speed, rtol=1e-9)
