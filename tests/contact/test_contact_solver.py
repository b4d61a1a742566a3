"""How much a step in contact and its adjoint cost: iterations, and the way they are solved."""

import math

import pytest
import torch

from diffsim import contact, mesh, soft

RADIUS, SPIN, DT = 0.05, 10.0, 5e-3  # [m], [rad/s], [s]


def rolled(youngs_modulus: float, **options):
    """Statistics of five steps of a rolling ball, steps and adjoints, and its gradient."""
    ball = mesh.hex_sphere(RADIUS, 0.02, (0.0, 0.0, RADIUS))
    solver = soft.SolverOptions(**{"rtol": 1e-4, **options})
    body = soft.SoftBody(
        ball, dt=DT, youngs_modulus=youngs_modulus, poissons_ratio=0.3, solver=solver
    )
    turn = torch.tensor([0.0, SPIN, 0.0], dtype=torch.float64).expand_as(body.x_rest)
    v = torch.linalg.cross(turn, body.x_rest).requires_grad_()
    generator = torch.Generator().manual_seed(0)
    weight = torch.randn(v.shape, generator=generator, dtype=v.dtype)
    floor = contact.floor(friction=math.inf)
    with soft.record_stats() as solves:
        end = soft.rollout(body, soft.State(body.x_rest, v), 5, obstacles=floor).final
        (grad,) = torch.autograd.grad((weight * end.v).sum(), v)
    return solves, grad


def mean_iterations(solves, kind: str) -> float:
    counts = [float(s.num_iters) for s in solves if s.kind == kind]
    return sum(counts) / len(counts)


def test_a_stiff_ball_turns_at_no_price():
    """The constant factor takes a turn for a deformation; the stiffer the ball, the more so."""
    # Without the body's rotations: 16 iterations at 1e5 Pa, 42 at 1e8; with them 13 and 14.
    for youngs_modulus in (1e5, 1e8):
        solves, _ = rolled(youngs_modulus, method="newton_pcg")
        assert all(int(s.num_factorizations) == 0 for s in solves)
        assert mean_iterations(solves, "adjoint") < 20


@pytest.mark.parametrize("method", ["auto", "newton_pcg"])
def test_gradients_are_those_of_a_factor_of_the_tangent(method):
    tight = {"rtol": 1e-11, "adjoint_rtol": 1e-11}
    _, exact = rolled(2e6, method="newton_cholesky", **tight)
    _, found = rolled(2e6, method=method, **tight)
    assert float((found - exact).norm()) < 1e-7 * float(exact.norm())
