"""Places of a described soft body: markers on stubs are carried by the nodes around."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from diffsim.systems.soft_body.places import INSIDE, carried_weights, point_weights
from tests.soft.cases import irregular_mesh

MARKERS = np.array([[0.0, 0.015, 0.036], [0.0, -0.006, 0.024], [0.0, 0.036, 0.006]])


@pytest.mark.property
def test_markers_follow_any_rigid_motion_of_the_face():
    y, z = np.meshgrid(np.linspace(0, 0.03, 4), np.linspace(0, 0.03, 4))
    points = np.column_stack([0 * y.ravel(), y.ravel(), z.ravel()])
    w = carried_weights(points, MARKERS)
    rot = Rotation.from_rotvec([0.1, 0.35, -0.2]).as_matrix()
    move = np.array([0.001, -0.002, -0.017])
    np.testing.assert_allclose(w @ (points @ rot.T + move), MARKERS @ rot.T + move, atol=1e-15)


@pytest.mark.property
@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_weights_of_a_point_are_those_of_an_affine_map_to_the_very_surface(kind):
    """Inside, on each corner, and as far outside as rounding may put what lies on the surface."""
    mesh = irregular_mesh(kind, (2, 2, 2))
    x = mesh.x_rest.numpy()
    middle = x.mean(0)
    points = [*(middle + 0.3 * (x - middle)), *x, *(middle + (1.0 + 0.1 * INSIDE) * (x - middle))]
    for point in points:
        nodes, weights = point_weights(mesh, point)
        np.testing.assert_allclose(weights.sum(), 1.0, rtol=1e-12)
        np.testing.assert_allclose(weights @ x[nodes], point, atol=2.0 * INSIDE)
    for point in middle + 1.3 * (x[[0, -1]] - middle):
        with pytest.raises(ValueError, match="lies outside of the body"):
            point_weights(mesh, point)
