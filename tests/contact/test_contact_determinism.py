"""A step in contact: the same bits whatever the threads, and how many iterations it costs."""

import math

import pytest
import torch

from diffsim import contact, mesh, soft
from tests.contact.scenes import moving, slab
from tests.soft.cases import leaf

pytestmark = pytest.mark.property


def run(batch=(0, 1, 2), threads=1, method="auto", cells=(4, 3, 2)):
    """Two steps of several slabs that land, slip and spin differently; answers and gradients."""
    options = soft.SolverOptions(method=method, rtol=1e-8, num_threads=threads)
    body = slab("hex", cells, (1.0, 0.8, 0.5), solver=options)
    states = [
        moving(body, (0.3 * k, 0.2, -1.0), spin=(0.1, 0.2 * k, 1.0), wobble=0.2, seed=k)
        for k in batch
    ]
    x = leaf(torch.stack([s.x for s in states]))
    v = leaf(torch.stack([s.v for s in states]))
    mu = leaf(0.3)
    state = soft.State(x, v)
    obstacles = [contact.floor(friction=mu), contact.plane((-1, 0, 0), -0.55, friction=0.1)]
    for _ in range(2):
        state = body(state, obstacles=obstacles)
    loss = (state.x * state.v).sum((1, 2)) + state.contact_force.square().sum((1, 2))
    grads = torch.autograd.grad(loss.sum(), (x, v))
    return [state.x.detach(), state.v.detach(), state.contact_force.detach(), *grads]


@pytest.mark.parametrize("method", ["auto", "newton_pcg", "newton_cholesky"])
def test_threads_and_repetition(method):
    first = run(method=method)
    for other in (run(method=method), run(method=method, threads=2)):
        assert all(torch.equal(a, b) for a, b in zip(first, other, strict=True))


def test_threads_on_one_item_of_many_nodes():
    """One item uses all threads inside its kernels; 600 nodes are several tasks."""
    first, second = (run((1,), threads, cells=(9, 9, 5)) for threads in (1, 2))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_batch_and_single():
    """Also from a cold start: what one step caches must not change the next one's bits."""
    whole = run()
    for k in range(3):
        single = run((k,))
        assert all(torch.equal(a[k], b[0]) for a, b in zip(whole, single, strict=True))


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
