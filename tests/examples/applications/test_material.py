"""Plant, bouncing ball and bunny on coarse meshes: gradients, what fits find, the shapes."""

import numpy as np
import pytest
import torch

from diffsim import mesh
from examples.applications import evaluate, minimize, solver_options
from examples.applications.identification import visibility
from examples.applications.table import load

NAMES = ("plant", "bouncing_ball", "bunny")


def built(name, rtol=None, **options):
    module = load(name)
    return module.build(
        solver_options("projective_dynamics", rtol=rtol or module.RTOL), True, **options
    )


@pytest.mark.parametrize("name", NAMES)
def test_gradient_is_the_central_difference_along_a_direction(name):
    application = built(name, rtol=1e-10)
    at, parameters = application.parameters.first, application.parameters
    rng = np.random.default_rng(0)
    way = 1e-5 * rng.normal(size=len(at)) * (parameters.upper - parameters.lower)
    found = evaluate(application, at)
    up, down = (evaluate(application, at + s, gradient=False).loss for s in (way, -way))
    assert np.array(found.gradient) @ way == pytest.approx(0.5 * (up - down), rel=1e-4)


@pytest.mark.parametrize(
    "name, fall",
    [
        pytest.param("plant", 1e3, marks=pytest.mark.slow),
        pytest.param("bouncing_ball", 1e2, marks=pytest.mark.story),
    ],
)
def test_loss_falls_in_few_evaluations(name, fall):
    found = minimize(built(name), max_evaluations=5)
    assert found.best.loss < found.evaluations[0].loss / fall


@pytest.mark.story
def test_a_bunny_that_flies_the_wrong_way_turns_round():
    found = minimize(built("bunny"), max_evaluations=6)
    assert found.best.loss < 0.25 * found.evaluations[0].loss


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plant", "bouncing_ball"])
def test_truth_is_found(name):
    application = built(name)
    found = minimize(application, max_evaluations=40)
    error = np.exp(np.array(found.best.values) - application.oracle_parameters) - 1.0
    assert np.abs(error).max() < 0.01


def test_visibility_is_the_curvature_of_the_loss():
    application = built("bouncing_ball", rtol=1e-10)
    truth = application.oracle_parameters
    seen = visibility(application, truth, step=1e-3)
    shift = np.array([1e-3, -2e-3])
    loss = evaluate(application, truth + shift, gradient=False).loss
    count = application.motion(truth).shape[:2].numel()
    assert loss == pytest.approx(count * shift @ seen.metric @ shift, rel=0.02)
    assert (seen.together < seen.alone).all()  # each can hide behind the other
    along, moved = seen.weak
    assert moved <= seen.together.min()
    assert np.linalg.norm(along) == pytest.approx(1.0)


def test_shapes_are_of_the_size_of_the_thesis():
    plant = load("plant").grow(0.0048)
    ball = load("bouncing_ball").holed_ball(24)
    bunny = load("bunny").bunny(0.0052)
    assert (plant.num_elements, plant.num_nodes) == (5072, 29724 // 3)
    assert (ball.num_elements, ball.num_nodes) == (1288, 8280 // 3)
    assert (bunny.num_elements, bunny.num_nodes) == (1538, 6795 // 3)
    for m in (plant, ball, bunny):
        assert mesh.quality(m).scaled_jacobian.minimum > 0.99  # cubes


def test_rotation_of_the_bunny_is_one_about_the_named_axes():
    rotation = load("bunny").rotation
    turn = rotation(torch.tensor([0.3, -0.7, 1.1], dtype=torch.float64))
    assert turn @ turn.T == pytest.approx(np.eye(3), abs=1e-15)
    assert float(torch.det(turn)) == pytest.approx(1.0)
    quarter = rotation(torch.tensor([0.0, 0.0, np.pi / 2], dtype=torch.float64))
    ahead = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    assert (quarter @ ahead).numpy() == pytest.approx([0.0, 1.0, 0.0], abs=1e-15)
