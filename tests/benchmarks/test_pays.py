"""Rigs, their folders and rivals of ``benchmarks.pays``; the table of what a diagnosis buys."""

import numpy as np
import pytest

from benchmarks.pays.__main__ import closed, interval, table
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


@pytest.mark.parametrize("name", RIGS)
def test_a_rig_is_recorded_as_its_sheet_has_it_but_for_what_is_hidden(name, tmp_path):
    pytest.importorskip("mujoco")
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
