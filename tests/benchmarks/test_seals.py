"""The published procedure of the sealed cylinders, by its values."""

import numpy as np
import pytest

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
