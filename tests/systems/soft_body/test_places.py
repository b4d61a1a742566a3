"""Markers on stubs are carried by the nodes around; what forces keep has the same bits."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from diffsim.systems.soft_body.kept import OfScene, OfTime, ratio
from diffsim.systems.soft_body.places import INSIDE, carried_weights, point_weights
from diffsim.systems.soft_body.scene import Moment
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


X = torch.zeros(1, 3, dtype=torch.float64)


def moment(time, dt=1e-3):
    return Moment(X, X, time, dt)


def test_a_signal_of_time_is_that_of_the_times_of_steps():
    asked = []

    def signal(times):
        asked.append(len(times))
        return torch.stack([times.sin(), times**2], -1)

    kept, start = OfTime(signal), 0.1
    for k in range(600):  # over the seams of what is computed at a time
        time = start + k * 1e-3
        alone = signal(torch.tensor([time], dtype=torch.float64))[0]
        asked.pop()
        assert torch.equal(kept(moment(time)), alone)
    assert max(asked) < 600
    assert sum(asked) < 2 * 600


def test_moments_out_of_step_are_computed_alone():
    kept = OfTime(lambda times: times[:, None])
    times = [0.0, 1e-3, 2.5e-3, 9.0, -1.0, 2e-3]
    np.testing.assert_array_equal([float(kept(moment(t))) for t in times], times)


def test_a_signal_of_time_has_its_gradient():
    size = torch.ones((), dtype=torch.float64, requires_grad=True)
    kept = OfTime(lambda times: size * times)
    (kept(moment(0.0)) + kept(moment(1e-3)) + kept(moment(2e-3))).backward()
    assert float(size.grad) == 3e-3


def test_a_value_of_a_scene_is_that_of_the_scene_that_is_asked_for():
    made = []
    kept = OfScene(lambda scene: made.append(scene) or len(scene))
    first, second = [1.0], [1.0, 2.0]
    assert (kept(first), kept(first), kept(second), kept(first)) == (1, 1, 2, 1)
    assert made == [first, second, first]


def test_a_ratio_is_that_of_multiples_alone():
    one = torch.tensor([1.0, -2.0, 0.0], dtype=torch.float64)
    assert float(ratio(one, -3.0 * one)) == -3.0
    assert float(ratio(one, 0.0 * one)) == 0.0
    assert ratio(one, one + 1e-9) is None
    assert ratio(one, one[:2]) is None
    assert ratio(0.0 * one, one) is None
