"""Places of a described soft body: markers on stubs are carried by the nodes around."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from diffsim.systems.soft_body.places import carried_weights

MARKERS = np.array([[0.0, 0.015, 0.036], [0.0, -0.006, 0.024], [0.0, 0.036, 0.006]])


@pytest.mark.property
def test_markers_follow_any_rigid_motion_of_the_face():
    y, z = np.meshgrid(np.linspace(0, 0.03, 4), np.linspace(0, 0.03, 4))
    points = np.column_stack([0 * y.ravel(), y.ravel(), z.ravel()])
    w = carried_weights(points, MARKERS)
    rot = Rotation.from_rotvec([0.1, 0.35, -0.2]).as_matrix()
    move = np.array([0.001, -0.002, -0.017])
    np.testing.assert_allclose(w @ (points @ rot.T + move), MARKERS @ rot.T + move, atol=1e-15)
