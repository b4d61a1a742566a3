"""What the page of the starfish claims."""

from __future__ import annotations

import numpy as np
import pytest

from diffsim.data.importers import import_study
from diffsim.data.recording import find_dataset
from diffsim.diagnose import diagnose
from diffsim.diagnose.setups import setup_of
from diffsim.diagnose.setups.starfish import modes

PERIOD_S = {"baseline": 0.9216, "horizontal_cyclic3": 0.9290}  # of the legs, the same sequence
CYCLES, PHASES = 32, 40


@pytest.fixture(scope="module")
def study():
    if find_dataset("starfish") is None:
        pytest.skip("no measured data: set DIFFSIM_DATA to the folder that holds starfish/")
    return import_study("starfish")


@pytest.fixture(scope="module")
def cycles(study):
    """(CYCLES, PHASES, 3 modes) [m] of the two runs of one sequence, from 2 s after the start."""
    cut = modes(study, windows={name: (0.0, 33.0) for name in PERIOD_S}, holdout=[])
    out = {}
    for run in cut.runs:
        when = 2.2 + PERIOD_S[run.name] * np.arange(CYCLES * PHASES) / PHASES
        whole = np.stack([np.interp(when, run.time_s, y) for y in run.measured.T], 1)
        out[run.name] = whole.reshape(CYCLES, PHASES, 3)
    return out


def test_legs_repeat_between_cycles_and_runs(cycles):
    """Mean cycles of odd and even cycles, and of the two runs at the best lag."""
    means = {}
    for name, motion in cycles.items():
        legs = motion[:, :, :2] - motion[:, :, :2].mean(1, keepdims=True)
        means[name] = legs.mean(0)
        for c in range(2):
            assert np.corrcoef(legs[::2, :, c].mean(0), legs[1::2, :, c].mean(0))[0, 1] > 0.98
    a, b = means.values()
    for c in range(2):
        alike = [np.corrcoef(a[:, c], np.roll(b[:, c], s))[0, 1] for s in range(PHASES)]
        assert max(alike) > 0.95


def test_travel_repeats_neither_between_runs_nor_between_cycles(cycles):
    travel = {name: np.diff(motion[:, 0, 2]) for name, motion in cycles.items()}
    slow, fast = (-t.mean() / PERIOD_S[name] for name, t in travel.items())
    assert slow > 0.0  # towards -x
    assert fast / slow > 1.8
    assert travel["baseline"].std() > 0.8 * abs(travel["baseline"].mean())
