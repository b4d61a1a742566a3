"""What happens at the kinks: a node that just touches, a node at the edge of the friction cone.

A node keeps the status that it is found with as long as that is right within the step's tolerance:
the last step's forces decide. The gradient is the one-sided derivative of that status.
"""

import math

import pytest
import torch

from diffsim import contact, soft
from tests.soft.cases import irregular_mesh, leaf, noise, record_calls, soft_body

EPS = 1e-5


@pytest.fixture(scope="module")
def body():
    """One node of an irregular tet mesh may touch; the floor comes up under it."""
    m = irregular_mesh("tet", (1, 1, 1), (1.0, 1.0, 1.0))
    lowest = m.x_rest[:, 2].argmin()
    # Close to sticking, mu r_N / |u| is so stiff that the adjoint's rounding is 1e-10.
    options = soft.SolverOptions(rtol=1e-12, adjoint_rtol=1e-9)
    return soft_body(m, dt=0.05, contact_nodes=lowest[None], solver=options)


def start(body, contact_force=None):
    x = body.x_rest.clone()
    v = torch.tensor([0.4, 0.1, -0.5], dtype=x.dtype) + 0.1 * noise(*x.shape, seed=2)
    return soft.State(x, v, contact_force=contact_force)


def loss_of(body, state, height, friction):
    """A generic loss of a step on a floor, and the node's status: 0 separate, 1 stick, 2 slip."""
    floor = contact.floor(height, friction=friction)
    end, calls = record_calls("contact_step", lambda: body(state, obstacles=floor))
    weights = noise(2, *end.x.shape, seed=6)
    return (end.x * weights[0] + 0.1 * end.v * weights[1]).sum(), int(calls[0][1][2])


def one_sided(loss, at, value) -> list[float]:
    """Difference quotients of ``loss`` from below and from above."""
    return [float((loss(at + s * EPS) - value).detach() / (s * EPS)) for s in (-1.0, 1.0)]


def guess(body, force):
    full = torch.zeros_like(body.x_rest)
    full[body.contact_nodes] = torch.as_tensor(force, dtype=full.dtype)
    return full


@pytest.mark.grad
@pytest.mark.parametrize("known", [False, True])
def test_a_node_that_just_touches(body, known):
    """Both sides hold within the tolerance: the gradient is that of the side the solver ends on.

    In contact before, it still is; else that depends on rounding.
    """
    free = body(start(body))
    node = body.contact_nodes[0]
    height = leaf(free.x[node, 2])
    state = start(body, guess(body, (0.0, 0.0, 1.0)) if known else None)
    value, status = loss_of(body, state, height, 0.0)
    assert status in ((2,) if known else (0, 2))
    (grad,) = torch.autograd.grad(value, height)
    sides = one_sided(lambda h: loss_of(body, state, h, 0.0)[0], height.detach(), value)
    assert sides[0] == pytest.approx(0.0, abs=1e-6) and abs(sides[1]) > 1e-2
    assert float(grad) == pytest.approx(sides[1 if status else 0], rel=1e-3, abs=1e-6)
    again, _ = loss_of(body, state, height, 0.0)
    assert again == value


@pytest.mark.grad
@pytest.mark.parametrize("known", ["nothing", "stick", "slip"])
def test_a_node_at_the_edge_of_the_friction_cone(body, known):
    """It sticks, or slips by rounding: the answer is the same, the gradient that side's."""
    node = body.contact_nodes[0]
    height = body.x_rest[node, 2] + 0.01
    held = body(start(body), obstacles=contact.floor(height, friction=math.inf))
    force = held.contact_force[node]
    mu = leaf((force[:2].norm() / force[2]).detach())
    assert 0.1 < mu.item() < 10.0
    before = {"nothing": None, "stick": (0.0, 0.0, 1.0), "slip": tuple((2.0 * force).tolist())}
    known_force = None if before[known] is None else guess(body, before[known])
    state = start(body, known_force)
    value, status = loss_of(body, state, height, mu)
    torch.testing.assert_close(value, loss_of(body, state, height, math.inf)[0], rtol=0, atol=1e-9)
    (grad,) = torch.autograd.grad(value, mu)
    sides = one_sided(lambda m: loss_of(body, state, height, m)[0], mu.detach(), value)
    assert sides[1] == pytest.approx(0.0, abs=1e-6) and abs(sides[0]) > 1e-2
    # Rounding decides which; the direction of a slip of 1e-14 m is good to a percent.
    side = {1: sides[1], 2: sides[0]}[status]
    assert float(grad) == pytest.approx(side, rel=3e-2, abs=1e-6)
    again, _ = loss_of(body, state, height, mu)
    assert again == value


@pytest.mark.grad
def test_a_node_at_rest_on_a_floor_without_load():
    """Touching, no speed, no gravity: nothing happens, and all gradients are finite."""
    m = irregular_mesh("hex", (1, 1, 1), (1.0, 1.0, 1.0), 0.0)
    body = soft_body(m, gravity=(0.0, 0.0, 0.0))
    x, v, mu = leaf(m.x_rest), leaf(torch.zeros_like(m.x_rest)), leaf(0.5)
    end = body(soft.State(x, v), obstacles=contact.floor(friction=mu))
    torch.testing.assert_close(end.x, m.x_rest, rtol=0, atol=1e-12)
    loss = (end.x * noise(*x.shape)).sum() + end.contact_force.sum()
    for grad in torch.autograd.grad(loss, (x, v, mu), allow_unused=True):
        assert grad is None or bool(grad.isfinite().all())


def test_a_slip_of_a_few_roundings():
    """A belt that has just brought the body to its own speed: |r_T| = mu r_N, slip of 1e-10 m.

    Such a slip has no direction within rounding; steps stopped at max_iters = 500 before friction
    was taken against the holding force there.
    """
    m = irregular_mesh("hex", (2, 2, 1), (1.0, 1.0, 0.5), 0.0)
    body = soft_body(m, youngs_modulus=1e4, gravity=(0, 0, -1.0))
    belt, state = contact.floor(velocity=(0.3, 0.0, 0.0), friction=0.5), body.rest_state()
    with soft.record_stats() as solves:
        for _ in range(6):  # 6 mu g h = 0.3 m/s
            state = body(state, obstacles=belt)
    assert float(state.v[:, 0].mean()) == pytest.approx(0.3, rel=1e-4)
    assert max(int(s.num_iters) for s in solves) <= 50
