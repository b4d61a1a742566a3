"""Forward mode against what it was not written from: differences of rollouts, and the adjoint."""

import pytest
import torch

from diffsim import mesh, soft
from tests.soft.cases import noise, soft_body
from tests.soft.test_every_body import (
    assert_close,
    directions_of,
    loads_of,
    made,
    moved,
    rates_of,
)

STEPS = 5  # BDF2 takes its first two with less history


def moving(name="pd", **changes):
    """A body under everything, and the values of all that may move."""
    body, inputs = made(name, "hex", **{"integrator": "bdf2", **changes})
    return body, {n: v.detach() for n, v in inputs.items()}


def tangents(body, values, rates):
    start, directions = soft.State(values["x"], values["v"]), directions_of(body, values, rates)
    return soft.rollout_tangents(body, start, STEPS, 1, directions, **loads_of(body, values))


@pytest.mark.parametrize("name", ["pd", "assumed strain"])
def test_damping_that_starts_to_act(name):
    """A body without damping, along a direction that gives it some."""
    body, values = moving(name)
    values["rayleigh_beta"] = torch.zeros_like(values["rayleigh_beta"])
    rates = {n: torch.zeros_like(r) for n, r in rates_of(values).items()}
    rates["rayleigh_beta"] = noise(*rates["rayleigh_beta"].shape, seed=20).abs()
    found = tangents(body, values, rates)
    h = 1e-4

    def at(offset):
        return moved(body, {n: v + offset * rates[n][0] for n, v in values.items()}, STEPS).x

    one_sided = (-3.0 * at(0.0) + 4.0 * at(h) - at(2.0 * h)) / (2.0 * h)
    assert_close(found.tangent[-1, 0], one_sided, 1e-5)


def test_signals_of_time_and_state():
    """A spring to the ground (force of the state) and a command that rises."""
    body, values = moving()
    stiffness, rise = 2.0, torch.tensor([0.05, 0.02], dtype=torch.float64)

    def simulated(stiffness, rise):
        return soft.rollout(
            body,
            soft.State(values["x"], values["v"]),
            STEPS,
            external_force=lambda k, s: -stiffness * (s.x - body.x_rest),
            activation=lambda k, s: 0.5 + k * rise,
        ).x

    def moving_force(k, state, moving):
        pull = torch.stack([state.x - body.x_rest, torch.zeros_like(state.x)])
        return -stiffness * moving.x - pull

    def moving_activation(k, state, moving):
        return torch.stack([torch.zeros_like(rise), k * torch.ones_like(rise)])

    found = soft.rollout_tangents(
        body,
        soft.State(values["x"], values["v"]),
        STEPS,
        2,
        soft.Directions(external_force=moving_force, activation=moving_activation),
        external_force=lambda k, s: -stiffness * (s.x - body.x_rest),
        activation=lambda k, s: 0.5 + k * rise,
        keep=lambda s, t: (s.x[-1].square(), 2.0 * s.x[-1] * t.x[:, -1]),
    )
    h = 1e-4
    for k, (a, b) in enumerate([(h, 0.0), (0.0, h)]):
        ends = [simulated(stiffness + s * a, rise + s * b)[:, -1].square() for s in (1, -1)]
        assert_close(found.tangent[:, k], (ends[0] - ends[1]) / (2.0 * h), 1e-6)


def test_one_factor_serves_all_directions():
    body, values = moving()
    with soft.record_stats() as solves:
        tangents(body, values, rates_of(values))
    tangent = [s for s in solves if s.kind == "tangent"]
    assert len(tangent) == STEPS
    assert all(int(s.num_factorizations) == 1 and int(s.num_iters) == 0 for s in tangent)
    assert all(float(s.residual_norm) < 1e-12 for s in tangent)


def test_indefinite_tangents_are_solved_too():
    """A bar compressed far beyond buckling: K dx = f with a K that has negative eigenvalues."""
    m = mesh.hex_box((6, 1, 1), (6.0, 1.0, 1.0))
    ends = torch.cat([m.nodes_near_plane("x", 0.0), m.nodes_near_plane("x", 6.0)])
    body = soft_body(m, fixed=ends, gravity=(0.0, 0.0, 0.0))
    x = m.x_rest * torch.tensor([0.7, 1.0, 1.0], dtype=torch.float64)
    force = noise(2, m.num_nodes, 3, seed=1)
    with soft.record_stats() as solves:
        found = soft.static_tangents(body, x, 2, soft.Directions(external_force=force))
    assert int(solves[0].num_iters) > 0  # not by the factor
    stiffness = torch.autograd.functional.jacobian(lambda y: -body.elastic_force(y), x)
    free = ~body.fixed
    stiffness = stiffness[free][:, free]
    assert float(torch.linalg.eigvalsh(stiffness)[0]) < 0.0
    assert_close(found[:, free] @ stiffness.T, force[:, free], 1e-10)
    assert not found[:, body.fixed].any()


def test_refusals():
    explicit, _ = moving(integrator="semi_implicit_euler", dt=0.01)
    with pytest.raises(ValueError, match="semi_implicit_euler"):
        soft.rollout_tangents(explicit, explicit.rest_state(), 1, 1, soft.Directions())
    body, _ = moving()
    with pytest.raises(ValueError, match=r"directions\.x"):
        soft.rollout_tangents(
            body, body.rest_state(), 1, 2, soft.Directions(x=torch.zeros(1, 2, 3).double())
        )
    with pytest.raises(ValueError, match=r"directions\.activation"):
        soft.rollout_tangents(
            body, body.rest_state(), 1, 2, soft.Directions(activation=torch.zeros(3, 2).double())
        )
