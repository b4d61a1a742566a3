"""Starts of the rule on NanoBench's flights: in flight until the last sample compared."""

from __future__ import annotations

import numpy as np

from benchmarks.ahead import AHEAD
from benchmarks.nanobench import EVERY, starts_of
from diffsim.data.study import Run


def test_starts_fly_until_the_last_sample_compared():
    time = 0.01 * np.arange(400)
    measured = np.zeros((400, 13))
    measured[100:300, 2] = 1.0  # height: on the ground before and after
    measured[200, 2] = np.nan  # a gap of the record
    run = Run("flight", time, measured, {"mean_command": np.full(400, 0.8)}, "flight")
    starts = starts_of(run).numpy()
    assert list(starts) == [*range(100, 150, EVERY), *range(210, 300 - AHEAD, EVERY)]


def test_a_drone_on_the_ground_has_no_starts():
    measured = np.ones((200, 13))
    run = Run("idle", 0.01 * np.arange(200), measured, {"mean_command": np.full(200, 0.3)}, "idle")
    assert not len(starts_of(run))
