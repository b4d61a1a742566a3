"""Rigs, their folders and rivals of ``benchmarks.pays``; the table of what a diagnosis buys."""

import numpy as np
import pytest

from benchmarks.pays.__main__ import closed, interval, table
from benchmarks.pays.film import SHAPES
from benchmarks.pays.quadrotor import GRAVITY, MASS, Quadrotor, quadrotor
from benchmarks.pays.rigs import RIGS
from benchmarks.pays.trial import METHODS, Trial
from diffsim.systems import setup_of


def _rows(*scores):
    return [
        {
            "rig": "arm",
            "seed": k,
            "verdict": "named",
            "named": ["delay"],
            "scores": dict(zip(METHODS, given, strict=True)),
            "cpu_s": {"diagnose": 1.0},
        }
        for k, given in enumerate(scores)
    ]


def test_the_share_of_the_gap_is_that_of_mean_misses():
    rows = _rows((10.0, 9.0, 5.0, 2.0, 1.0, 0.0), (4.0, 4.0, 4.0, 1.0, 1.0, 1.0))
    share, low, high = closed(rows, "extended")
    assert share == pytest.approx(1.0 - 3.0 / 2.0 / (7.0 - 0.5) + 0.5 / 6.5)
    assert low <= share <= high
    assert interval(np.array([3.0, 3.0])) == (3.0, 3.0, 3.0)
    assert "| arm | 2 | 7 | 6.5 | 4.5 | 1.5 | 1 | 0.5 | 85 %" in table({"arm": rows})


ELSEWHERE = {"quadrotor": "rotorpy"}  # rigs that are not MuJoCo's


@pytest.mark.cpu(15)  # RotorPy steps in Python
@pytest.mark.parametrize("name", RIGS)
def test_a_rig_is_recorded_as_its_sheet_has_it_but_for_what_is_hidden(name, tmp_path):
    pytest.importorskip(ELSEWHERE.get(name, "mujoco"))
    trial = Trial.made(name, 1, tmp_path)
    again = Trial.made(name, 1, tmp_path / "again")
    for run, same in zip(trial.study.runs, again.study.runs, strict=True):
        assert np.array_equal(run.measured, same.measured)
    model = setup_of(trial.study).model
    run = trial.study.fit_runs[0]
    seen = model.predict(run, model.at_prior()).detach().numpy()
    sd = np.array([c.sd for c in trial.study.channels])
    rest = seen[0] - run.measured[0]
    assert (np.abs(rest) < 5.0 * sd).all()
    left = np.abs(seen - run.measured)
    assert (left.max(0) > 20.0 * sd).all()  # the hidden causes, and numbers off their sheet
    assert (left.mean(0) < 2.0 * np.ptp(run.measured, axis=0)).all()
    assert trial.score(trial.task.near_rest) > 1.0
    names = [c.name for c in trial.study.channels]
    for line in SHAPES[name](dict(zip(names, run.measured[0], strict=True))):
        assert line.shape == (2, 2) or line.shape == (3, 2)
        assert np.isfinite(line).all()


def test_weak_rear_rotors_raise_the_nose_and_lower_the_height():
    pytest.importorskip("rotorpy")
    given = quadrotor(np.random.default_rng(0)).numbers | {"mass": MASS, "k_d": 0.0}
    time_s = np.linspace(0.0, 0.1, 6)
    still = [np.zeros(6), np.zeros(6)]
    hover = Quadrotor(given, weak=0.0, late_s=0.0).record(time_s, still)
    assert np.abs(hover).max() < 1e-9
    weak = Quadrotor(given, weak=0.1, late_s=0.0).record(time_s, still)[-1]
    assert weak[1] == pytest.approx(
        -0.05 * GRAVITY * 0.1**2 / 2, rel=0.02
    )  # of four, two lose a tenth
    assert weak[2] < 0.0  # pitch is nose down
