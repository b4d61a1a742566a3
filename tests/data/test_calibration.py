"""A camera from clicked points, without OpenCV."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from diffsim.data.calibration import calibrate

SIZE = (1920, 1080)
GRID = np.array([[x, y, z] for x in (0.0, 1.5, 3.0) for y in (-0.5, 0.5) for z in (0.2, 1.0, 2.0)])


def clicked(focal, rotation, shift):
    """Pixels of the grid by the form of the data set, written out anew."""
    seen = GRID @ rotation.T + shift
    return np.column_stack(
        [960.0 + focal * seen[:, 0] / seen[:, 2], 540.0 - focal * seen[:, 1] / seen[:, 2]]
    )


LEVEL = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])  # looks along y


@pytest.mark.parametrize("focal", [700.0, 1400.0, 5000.0])
@pytest.mark.parametrize("angles", [(0, 0, 0), (-20, 25, 5), (30, -30, -20), (10, 170, 0)])
def test_camera_is_found_from_any_side(focal, angles):
    """From the side, from above, tilted, from behind; with a wide lens and a tele lens."""
    turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix() @ LEVEL
    shift = np.array([0.1, -0.2, -focal / 200.0]) - turn @ GRID.mean(0)
    assert (GRID @ turn.T + shift)[:, 2].max() < 0.0  # in front
    found = calibrate(GRID, clicked(focal, turn, shift), SIZE)
    assert found["alpha_px"] == pytest.approx(focal, rel=1e-6)
    np.testing.assert_allclose(found["R"], turn, atol=1e-7)
    np.testing.assert_allclose(found["T_m"], shift, atol=1e-5)
    assert found["reprojection_rms_px"] < 1e-6


def test_clicks_of_a_pixel_still_find_it():
    pixels = clicked(1400.0, LEVEL, np.array([1.5, 1.0, -4.0]))
    found = calibrate(GRID, pixels + np.random.default_rng(0).normal(size=(len(GRID), 2)), SIZE)
    assert found["alpha_px"] == pytest.approx(1400.0, rel=0.02)
    assert 0.6 < found["reprojection_rms_px"] / np.sqrt(2.0) < 1.3
