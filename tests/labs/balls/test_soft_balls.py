"""The thesis's two soft balls: size, inertia, motion before the impact, gradients, camera."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.systems.rigid_body.camera import eye, on_plane, plain_camera, projected
from labs.balls.soft import SoftBalls, ball_mesh
from tests.examples.stories import load_story

RADIUS, MASS = 0.03429, 0.0577


def scalars(**values: float) -> dict[str, torch.Tensor]:
    return {n: torch.tensor(v, dtype=torch.float64) for n, v in values.items()}


START = scalars(x0=0.53, y0=0.29, x1=0.62, y1=0.3, vx1=-1.2, vy1=0.1, wx1=-1.0, wy1=0.1)
LAWS = scalars(pair_stiffness=2500.0, ball_friction=0.2, table_friction=0.3, youngs_modulus=4e5)


@pytest.fixture(scope="module")
def balls() -> SoftBalls:
    return SoftBalls(RADIUS, MASS)


def test_size_is_that_of_table_4_2(balls):
    assert balls.ball.num_elements == 320
    assert 3 * balls.ball.num_nodes == 489
    assert balls.body.mesh.num_elements == 640
    assert balls.body.dt == pytest.approx(5.6e-3, abs=5e-5)


def test_mass_and_inertia_are_nearly_a_tennis_balls():
    from diffsim.mesh import nodal_volume

    ball = ball_mesh(RADIUS, 2)
    share = nodal_volume(ball) / nodal_volume(ball).sum()
    second = torch.einsum("n,ni,nj->ij", share, ball.x_rest, ball.x_rest)
    about_an_axis = second.trace() - second.diagonal()
    half = torch.full((3,), 0.5, dtype=torch.float64)
    torch.testing.assert_close(about_an_axis / RADIUS**2, half, atol=0.02, rtol=0.0)


def test_one_ball_waits_until_the_other_comes(balls):
    with torch.no_grad():
        centers = balls.centers({**START, **LAWS}, 5)
    still, coming = centers[:2, 0, :2], centers[:, 1, 0]
    assert float((still - still[0]).abs().max()) < 1e-4  # [m]: it settles on its facet
    assert bool((coming.diff() < 0).all())
    assert float(centers[-1, 0, 0]) < 0.52  # struck


def test_places_carry_over_the_table(balls):
    """Moving both balls moves everything by as much: the table is the same everywhere."""
    moved = {**START, **{n: START[n] + 0.1 for n in ("x0", "x1")}}
    with torch.no_grad():
        a, b = (balls.centers({**s, **LAWS}, 4) for s in (START, moved))
    torch.testing.assert_close(b[..., 0] - 0.1, a[..., 0], atol=1e-6, rtol=0.0)
    torch.testing.assert_close(b[..., 1:], a[..., 1:], atol=1e-6, rtol=0.0)


@pytest.mark.parametrize("name", ["vx1", "wx1", "y1", "pair_stiffness", "table_friction"])
def test_gradient_through_the_impact_equals_differences(balls, name):
    def travel(value: torch.Tensor) -> torch.Tensor:
        centers = balls.centers({**START, **LAWS, name: value}, 5)
        return centers[-1, 0, :2].sum() + 2.0 * centers[-1, 1, 1]

    at = ({**START, **LAWS})[name].clone().requires_grad_()
    (slope,) = torch.autograd.grad(travel(at), at)
    h = 1e-5 * max(1.0, float(at.detach().abs()))
    with torch.no_grad():
        expected = (travel(at + h) - travel(at - h)) / (2.0 * h)
    # the solver's tolerance 1e-6 over h limits the difference
    assert float(slope) == pytest.approx(float(expected), rel=0.02, abs=1e-6)


@pytest.fixture(scope="module")
def known():
    return load_story("sim_to_real/film_tennis_balls.py").known_model(4, (1280, 720))


def test_camera_alone_costs_no_simulation(known):
    model, x = known
    run = replace(_run(), measured=np.full((4, 6), np.nan))
    points = torch.from_numpy(np.stack([x, x, x]))
    points[1, 0] += 0.1  # focal length
    points[2, -1] += 0.1  # Young's modulus
    motions: list[int] = []
    model.report = lambda: motions.append(1)
    many = model.predict_many(run, points)
    assert len(motions) == 2
    for row, point in zip(many, points, strict=True):
        torch.testing.assert_close(row, model.predict(run, point))


def _run():
    from diffsim.data import Run

    zeros = {f"corner_{a}_m": np.zeros(4) for a in "xyz"}
    return Run("film", np.arange(4) / 60.0, np.zeros((4, 6)), zeros, "film")


def test_samples_between_frames_are_refused(known):
    model, x = known
    run = replace(_run(), time_s=np.array([0.0, 1.0, 2.5, 3.0]) / 60.0)
    with pytest.raises(ValueError, match="no whole number of frames"):
        model.predict(run, torch.from_numpy(x))


def test_pixels_and_table_are_inverse(known):
    model, x = known
    values = model.values_at(x)
    places = torch.tensor([[0.3, 0.2, 0.034], [0.9, 0.5, 0.034]], dtype=torch.float64)
    pixels = projected(values, model.rotation, places)
    back = on_plane(values, model.rotation, pixels, 0.034)
    torch.testing.assert_close(back, places[:, :2])
    assert float(eye(values, model.rotation)[2]) == pytest.approx(1.27, abs=0.1)


def test_radial_distortion_moves_points_away_from_the_axis(known):
    model, x = known
    values = {**model.values_at(x), "radial": torch.tensor(0.1, dtype=torch.float64)}
    place = torch.tensor([[0.0, 0.0, 0.0]], dtype=torch.float64)
    straight = projected({**values, **plain_camera()}, model.rotation, place)
    bent = projected(values, model.rotation, place)
    middle = torch.tensor([640.0, 360.0], dtype=torch.float64)
    stretch = (bent - middle) / (straight - middle)
    assert float(stretch.min()) > 1.01
    torch.testing.assert_close(stretch[:, 0], stretch[:, 1])
