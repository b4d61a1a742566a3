"""Pull tests: a servo that is pulled to either side, and where it stays."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.pull_tests import sides

STATES = (  # goals of the pullers, and where the tested servo ends
    ((1747, 1947), 2057),
    ((1747, 2347), 2052),
    ((2147, 2347), 2041),
    ((1747, 2347), 2044),
)


def test_a_pulled_servo_stays_off_by_the_difference_of_both_sides():
    names = ["tested1_goal_count", "pulling1_goal_count", "pulling2_goal_count"]
    kinds = [(name, float) for name in (*names, "tested1_position_count")]
    rows, here = [], 2047.0
    for _ in range(2):
        for goals, end in STATES:
            for _ in range(8):
                rows.append((2047.0, *goals, here))  # read before the goal is sent
                here += 0.9 * (end - here)
    found = sides(np.array(rows, dtype=kinds))
    assert found["tested1"] == pytest.approx((16.0, 8.0), abs=0.1)
