"""The published procedure of the sealed cylinders, by its values; pull tests of a servo."""

import numpy as np
import pytest

from benchmarks.pull_tests import sides
from benchmarks.seals import measured_strokes
from tests.measured import data_folder

PUBLISHED = {
    "o_ring": (7.84, 10.88, 13.84, 15.62),
    "x_ring_257": (9.19, 13.13, 17.30, 30.23),
}


def test_a_square_wave_of_friction_is_found():
    upper = (np.arange(3015) - 15) // 300 % 2 == 0
    pressure = np.where(upper, 3.0e5, 2.9e5)
    force = pressure * np.pi / 4.0 * 0.025**2 + np.where(upper, 5.0, -4.0)
    found = measured_strokes(force, pressure)
    assert found.friction_range == pytest.approx(9.0)
    assert found.scatter == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("label", PUBLISHED)
def test_published_values_come_out(label):
    folder = data_folder("pneumatic_actuator")
    for level, value in zip((1, 3, 5, 7), PUBLISHED[label], strict=True):
        read = np.genfromtxt(folder / f"{label}_{level}bar.csv", delimiter=",", names=True)
        found = measured_strokes(read["force_N"], read["pressure_Pa"])
        assert found.friction_range == pytest.approx(value, abs=0.02)


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
