"""Multigrid in contact: the answers of a factor of the tangent, by few iterations."""

import math

import pytest
import torch

from benchmarks.contact_large import LANDING_GAP, rubber, started
from benchmarks.contact_scenes import ball_obstacle, napkin, rolling_sphere, rolling_state
from diffsim import contact, mesh, soft
from examples.applications.bouncing_ball import ABOVE, FRICTION, SPEED, holed_ball
from tests.soft.cases import noise, soft_body

# Friction, and the speed at which a block meets a slope: all that touches slips, sticks, or both.
CASES = {"smooth": (0.0, 1.0), "slips": (0.3, 2.0), "both": (0.9, 0.1), "sticks": (math.inf, 0.1)}
# Iterations that an adjoint may take; it takes 6 or 7.
MOST = 9


def block(method: str, preconditioner: str) -> soft.SoftBody:
    """A block of 10 x 10 x 5 cells, of which a part is a hundred times stiffer."""
    m = mesh.hex_box((10, 10, 5), (0.2, 0.2, 0.1))
    middle = m.x_rest[m.elements].mean(1)[:, 0]
    return soft_body(
        m,
        dt=0.01,
        youngs_modulus=torch.where(middle > 0.1, 1e6, 1e4).double(),
        poissons_ratio=0.4,
        density=1e3,
        solver=soft.SolverOptions(method=method, preconditioner=preconditioner, rtol=1e-9),
    )


def pass_of(body: soft.SoftBody, friction: float, speed: float):
    """Positions, gradients by start and friction, and statistics of two steps on a slope."""
    slope = contact.plane((0.1, 0.05, 1.0), friction=friction)
    x = body.x_rest + 1e-3 * noise(*body.x_rest.shape)
    x = x - torch.tensor([0.0, 0.0, 0.003], dtype=x.dtype)
    start = x.requires_grad_()
    v = torch.zeros_like(x) + torch.tensor([speed, 0.0, -0.5], dtype=x.dtype)
    v.requires_grad_()
    with soft.record_stats() as solves:
        end = soft.rollout(body, soft.State(start, v), 2, obstacles=slope).final
        (noise(*x.shape) * (end.x + 1e-3 * end.contact_force)).sum().backward()
    return end.x.detach(), torch.stack([start.grad, v.grad]), solves


@pytest.mark.parametrize("case", CASES)
def test_answers_are_those_of_a_factor(case):
    by_factor = pass_of(block("newton_cholesky", "auto"), *CASES[case])
    by_multigrid = pass_of(block("newton_pcg", "multigrid"), *CASES[case])
    slipping = [int(s.num_slipping) for s in by_multigrid[2] if s.kind == "step"]
    touching = [int(s.num_contacts) for s in by_multigrid[2] if s.kind == "step"]
    assert min(touching) > 5
    if case == "both":
        assert any(0 < s < c for s, c in zip(slipping, touching, strict=True))
    elif case == "sticks":
        assert slipping[-1] == 0  # before, those that would be pulled may slide
    else:
        assert slipping == touching
    torch.testing.assert_close(by_multigrid[0], by_factor[0], rtol=0, atol=1e-9)
    scale = float(by_factor[1].abs().max())
    torch.testing.assert_close(by_multigrid[1], by_factor[1], rtol=0, atol=1e-6 * scale)
    adjoints = [s for s in by_multigrid[2] if s.kind == "adjoint"]
    assert [int(s.num_factorizations) for s in adjoints] == [0, 0]


@pytest.mark.parametrize("case", CASES)
def test_an_adjoint_takes_few_iterations(case):
    body = block("newton_pcg", "multigrid")
    body.solver = soft.SolverOptions(method="newton_pcg", preconditioner="multigrid", rtol=1e-4)
    *_, solves = pass_of(body, *CASES[case])
    assert max(int(s.num_iters) for s in solves if s.kind == "adjoint") <= MOST


def test_linear_solves_leave_little_of_the_tolerance():
    """Solved to 0.1 of the right-hand side, not 0.001, steps end with a fifth of the tolerance.

    Such a rest may be rigid motion, wrong by as much as weight is (docs/measured/contact.md).
    """
    body = block("newton_pcg", "multigrid")
    body.solver = soft.SolverOptions(method="newton_pcg", preconditioner="multigrid", rtol=1e-4)
    *_, solves = pass_of(body, *CASES["slips"])
    steps = [s for s in solves if s.kind == "step"]
    assert len(steps) == 2
    assert max(float(s.residual_norm / s.tolerance) for s in steps) < 0.03


def test_diagonal_blocks_beside_multigrid_are_solved_as_loosely_as_elsewhere():
    """A soft sheet in short steps, on which `auto` prefers them: the same way, bit by bit."""
    ends = []
    for method, preconditioner in (("auto", "multigrid"), ("newton_jacobi", "auto")):
        options = soft.SolverOptions(method=method, preconditioner=preconditioner, rtol=1e-4)
        body, obstacle = napkin(16, 0.8, options), ball_obstacle(math.inf)
        state = body.rest_state()
        state = state._replace(v=state.v - torch.tensor([0.0, 0.0, 2.0], dtype=state.v.dtype))
        with soft.record_stats() as solves:
            ends.append(soft.rollout(body, state, 2, obstacles=obstacle).final.x)
        assert int(solves[-1].num_contacts) > 5
    assert torch.equal(*ends)


def test_nodes_that_all_but_stick_cost_no_iterations_more():
    """As a ball begins to slide its slip is tiny: friction stiffens nodes 1e6 times across it.

    In single precision that loses what such a node has beside it. With it inside of multigrid, and
    GMRES that preconditions its sum of directions anew, a step took 224 iterations instead of 24.
    """
    body = rolling_sphere(0.012)
    body.solver = soft.SolverOptions(method="newton_pcg", preconditioner="multigrid", rtol=1e-4)
    state = soft.State(*(t.detach() for t in rolling_state(body)))
    with soft.record_stats() as steps:
        for _ in range(8):
            state = body(state, obstacles=contact.floor(friction=0.05))
    assert max(s.num_slipping.item() for s in steps) > 0
    assert max(s.num_solves.item() for s in steps) < 60


def landed(cells: int, **options) -> tuple[torch.Tensor, list]:
    """Where a drilled ball is after it has landed, its half 100 times stiffer, and statistics."""
    ball = holed_ball(cells)
    lowered = ball.x_rest - torch.tensor([0.0, 0.0, ABOVE - LANDING_GAP], dtype=torch.float64)
    body = rubber(type(ball)(lowered, ball.hexes), 8e-3, 100.0)
    body.solver = soft.SolverOptions(**options, rtol=1e-6)
    state = soft.State(*(t.detach() for t in started(body, SPEED)))
    with soft.record_stats() as steps:
        for _ in range(3):
            state = body(state, obstacles=contact.floor(friction=FRICTION))
    return state.x, steps


@pytest.mark.cpu(8)
@pytest.mark.parametrize("cells", [24, 30])
def test_a_landing_does_not_crush_the_body(cells):
    """The third step, in which 24 cells touch and sink in by one, and 30 have touched before.

    From inertial positions, with all nodes lifted out of the ground, elements were inside out and
    it took 2,216 cycles, and 3,476 with 7 factors; now 134 and 76, to where factors lead.
    """
    x, steps = landed(cells, method="newton_pcg", preconditioner="multigrid")
    assert steps[-1].num_contacts.item() > 10
    assert max(s.num_solves.item() for s in steps) < 250
    by_factors, _ = landed(cells, method="newton_cholesky")
    # forces within 1e-6 of the step's, along a body 0.2 m wide
    torch.testing.assert_close(x, by_factors, rtol=0, atol=1e-8)
