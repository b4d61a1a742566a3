"""Tendons: fibers that pull and never push."""

import numpy as np
import pytest
import torch

from diffsim import mesh, soft
from tests.helpers import at_rest
from tests.helpers import numbers as row
from tests.soft.cases import irregular_mesh, leaf, noise, rail_mask, soft_body

METHODS = ["auto", "quasi_newton", "newton_pcg", "newton_jacobi", "newton_cholesky"]
TOLERANCE = {"eps": 1e-6, "atol": 2e-5, "rtol": 2e-5}
DIRECTION = [1.0, 0.2, -0.1]


def fibers_of(m, kind="tendon", count=1, stiffness=20.0):
    """Fibers through all elements, ``count`` muscles over which they are dealt out."""
    every = torch.arange(m.num_elements)
    return [
        soft.Muscle(elements=every[k::count], direction=DIRECTION, stiffness=stiffness, kind=kind)
        for k in range(count)
    ]


def stretches(m, x):
    """|F m| of the linear map closest to x, which is the same everywhere for an affine x."""
    F = torch.linalg.lstsq(m.x_rest - m.x_rest.mean(0), x - x.mean(0)).solution.T
    direction = torch.tensor(DIRECTION, dtype=torch.float64)
    return float((F @ (direction / direction.norm())).norm())


def affine(m):
    """Stretched, sheared and turned, the same in every element."""
    return m.x_rest @ (torch.eye(3).double() + 0.3 * noise(3, 3, seed=1)).T


@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_taut_it_is_a_length_muscle(kind):
    m = irregular_mesh(kind)
    tendon = soft_body(m, muscles=fibers_of(m))
    muscle = soft_body(m, muscles=fibers_of(m, "length"))
    x = affine(m)
    below = row(stretches(m, x) - 0.2)
    results = []
    for body in (tendon, muscle):
        y, activation, stiffness = leaf(x), leaf(below), leaf([20.0])
        physics = body.physics(fiber_stiffness=stiffness)
        force = body.elastic_force(y, activation=activation, physics=physics)
        weights = noise(*x.shape)
        grads = torch.autograd.grad((force * weights).sum(), (y, activation, stiffness))
        energy = body.elastic_energy(y, activation=activation, physics=physics)
        slopes = torch.autograd.grad(energy, (y, activation, stiffness))
        results.append([force, energy, *grads, *slopes, body(at_rest(x), activation=below).x])
    for one, other in zip(*results, strict=True):
        assert one.abs().max() > 1e-6
        torch.testing.assert_close(one, other, rtol=0, atol=0)


@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_slack_it_is_not_there(kind):
    m = irregular_mesh(kind)
    tendon, bare = soft_body(m, muscles=fibers_of(m)), soft_body(m)
    x = affine(m)
    above = row(stretches(m, x) + 1e-9)
    y, activation, stiffness = leaf(x), leaf(above), leaf([20.0])
    physics = tendon.physics(fiber_stiffness=stiffness)
    force = tendon.elastic_force(y, activation=activation, physics=physics)
    weights = noise(*x.shape)
    grads = torch.autograd.grad((force * weights).sum(), (y, activation, stiffness))
    torch.testing.assert_close(force, bare.elastic_force(x), rtol=0, atol=0)
    energy = tendon.elastic_energy(x, activation=above)
    torch.testing.assert_close(energy, bare.elastic_energy(x), rtol=0, atol=0)
    assert grads[1] == 0.0 and grads[2] == 0.0
    bare_x = leaf(x)
    (expected,) = torch.autograd.grad((bare.elastic_force(bare_x) * weights).sum(), bare_x)
    torch.testing.assert_close(grads[0], expected, rtol=0, atol=0)


@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_at_the_kink(kind):
    """|F m| = a: energy and force are continuous and zero there. The tangent jumps from 0 to w; it
    and the gradients are those of the taut side, also within rounding of the kink, so that a
    tendon at rest with activation 1 feels a command to shorten."""
    m = irregular_mesh(kind)
    body = soft_body(m, muscles=fibers_of(m), gravity=(0.0, 0.0, 0.0))
    x = m.x_rest
    assert body.muscles.rest_activation.tolist() == [1.0]
    rest = body.elastic_force(x)
    assert rest.abs().max() < 1e-13 and body.elastic_energy(x).abs() < 1e-26

    weights = noise(*x.shape)

    def slopes(a):
        y, activation = leaf(x), leaf([a])
        force = (body.elastic_force(y, activation=activation) * weights).sum()
        return torch.autograd.grad(force, (y, activation))

    at, taut, slack = slopes(1.0), slopes(1.0 - 1e-9), slopes(1.0 + 1e-9)
    for one, other, zero in zip(at, taut, slack, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-6)
        assert (one - zero).abs().max() > 1e-2
    assert slack[1] == 0.0
    # Continuous: one part in 1e6 beyond the kink the force is w 1e-6, before it zero.
    pull = body.elastic_force(x, activation=row(1.0 - 1e-6))
    push = body.elastic_force(x, activation=row(1.0 + 1e-6))
    assert 1e-7 < pull.abs().max() < 1e-4
    torch.testing.assert_close(push, rest, rtol=0, atol=1e-13)
    # A step from rest agrees with the difference quotient towards taut, not with that to slack.
    activation = leaf([1.0])
    (slope,) = torch.autograd.grad((body(at_rest(x), activation=activation).x * weights).sum(),
                                   activation)  # fmt: skip
    step = 1e-6
    with torch.no_grad():
        here, less, more = (
            (body(at_rest(x), activation=row(a)).x * weights).sum()
            for a in (1.0, 1.0 - step, 1.0 + step)
        )
    torch.testing.assert_close((here - less) / step, slope[0], rtol=1e-4, atol=1e-6)
    assert (more - here).abs() < 1e-12


@pytest.mark.property
def test_it_pulls_and_never_pushes():
    """A bar along its tendon: shortened by a command below 1, left alone by one above."""
    m = mesh.hex_box((6, 1, 1), (3.0, 0.5, 0.5))
    every = torch.arange(m.num_elements)
    tendon = soft.Muscle(elements=every, direction=[1, 0, 0], stiffness=50.0, kind="tendon")
    body = soft_body(
        m, muscles=[tendon], fixed=m.nodes_near_plane("x", 0.0), gravity=(0.0, 0.0, 0.0)
    )
    tip = m.nodes_near_plane("x", 3.0)
    lengths = []
    for a in (0.8, 0.9, 1.0, 1.1, 1.2):
        x = body.static_equilibrium(activation=row(a)).x
        lengths.append(float(x[tip, 0].mean()))
    assert lengths[0] < lengths[1] < lengths[2] - 0.1
    assert np.allclose(lengths[2:], 3.0, rtol=0, atol=1e-12)
    # Pulled at the tip beyond the commanded length it holds against, short of it it does not.
    bare = soft_body(m, fixed=m.nodes_near_plane("x", 0.0), gravity=(0.0, 0.0, 0.0))
    force = torch.zeros_like(m.x_rest)
    force[tip, 0] = 0.4
    free = bare.static_equilibrium(external_force=force).x[tip, 0].mean()
    for a, held in ((1.0, True), (1.5, False)):
        found = body.static_equilibrium(
            external_force=force, activation=row(a)
        ).x[tip, 0].mean()  # fmt: skip
        assert (float(found) < float(free) - 0.1) == held
        assert held or float(found) == pytest.approx(float(free), abs=1e-9)


@pytest.mark.reference
@pytest.mark.parametrize("kind", ["hex", "tet"])
@pytest.mark.parametrize("method", METHODS)
def test_methods_agree_across_the_kink(method, kind):
    """Fibers that go slack and taut during the iteration: curvature jumps, the answer is one."""
    m = irregular_mesh(kind, (4, 2, 2), (4.0, 2.0, 2.0))

    def run(method):
        solver = soft.SolverOptions(method=method, rtol=1e-10, adjoint_rtol=1e-10)
        body = soft_body(
            m, muscles=fibers_of(m, count=2, stiffness=80.0), fixed=rail_mask(m), solver=solver
        )
        x, activation = leaf(m.x_rest), leaf([1.0, 0.8])
        state = soft.State(x, 2.0 * noise(*x.shape, seed=4))
        for _ in range(3):
            state = body(state, activation=activation)
        loss = (state.x * noise(*x.shape)).sum()
        return [state.x, *torch.autograd.grad(loss, (x, activation))]

    for one, other in zip(run(method), run("newton_cholesky"), strict=True):
        # Residuals of 1e-10 of about 1e3 N, masses of about 0.1 kg at h = 0.1 s: 1e-8 m, and the
        # gradients are those of a point so far away.
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)


def test_it_says_what_kinds_there_are():
    with pytest.raises(ValueError, match=r"one of .*'tendon'.*, got 'tendom'; did you"):
        soft.Muscle(elements=torch.tensor([0]), direction=[1, 0, 0], stiffness=1.0, kind="tendom")
