"""Forward mode against what it was not written from: differences of rollouts, and the adjoint."""

import pytest
import torch

from diffsim import mesh, soft
from tests.soft.cases import (
    element_of,
    irregular_mesh,
    noise,
    rail_mask,
    soft_body,
    two_muscles,
)

STEPS = 5  # BDF2 takes its first two with less history
IMPLICIT = ["implicit_euler", "bdf2", "implicit_midpoint"]
STATE, SIGNALS = ("x", "v"), ("external_force", "activation", "dirichlet_target")


def make_body(kind="hex", integrator="bdf2", **changes):
    m = irregular_mesh(
        kind, (2, 1, 1) if kind in ("hex", "assumed_strain") else (1, 1, 1), (1.0, 1.0, 1.0)
    )
    changes["element"] = element_of(kind)
    arguments = {"fixed": rail_mask(m), "muscles": two_muscles(), "integrator": integrator}
    return soft_body(m, **{**arguments, "rayleigh_beta": 0.02, **changes})


def inputs_of(body):
    """Values of everything that may move: moving, strained, per element where that is allowed."""
    m = body.mesh
    return {
        "x": m.x_rest + torch.where(body.fixed, 0.0, 0.05 * noise(m.num_nodes, 3, seed=1)),
        "v": 0.3 * noise(m.num_nodes, 3, seed=2),
        "external_force": 0.2 * noise(m.num_nodes, 3, seed=3),
        "activation": torch.tensor([0.8, 0.3], dtype=torch.float64),
        "dirichlet_target": m.x_rest + 0.05 * noise(m.num_nodes, 3, seed=4),
        "youngs_modulus": 30.0 * (1.0 + 0.2 * noise(m.num_elements, seed=5).tanh()),
        "poissons_ratio": torch.tensor(0.3, dtype=torch.float64),
        "density": 1.5 + 0.1 * noise(m.num_nodes, seed=6).tanh(),
        "gravity": torch.tensor([0.3, -0.2, -1.0], dtype=torch.float64),
        "rayleigh_alpha": torch.tensor(0.4, dtype=torch.float64),
        "rayleigh_beta": 0.02 * (1.0 + 0.2 * noise(m.num_elements, seed=5).tanh()),
        "attached_mass": 0.2 + 0.1 * noise(m.num_nodes, seed=7).tanh(),
        "fiber_stiffness": torch.tensor([8.0, 6.0], dtype=torch.float64),
    }


def rates_of(values, names=None):
    """One direction per name that moves it alone, and a last one that moves them all."""
    names = list(values) if names is None else names
    rows = {n: noise(1, *values[n].shape, seed=20 + k)[0] for k, n in enumerate(names)}
    return {
        n: torch.stack([r if n == m else torch.zeros_like(r) for m in names] + [r])
        for n, r in rows.items()
    }


def simulate(body, values, num_steps=STEPS):
    state = soft.State(values["x"], values["v"])
    physics = body.physics(**{n: v for n, v in values.items() if n not in STATE + SIGNALS})
    signals = {n: values[n] for n in SIGNALS if n in values}
    return soft.rollout(body, state, num_steps, physics=physics, **signals)


def tangents(body, values, rates, num_steps=STEPS, **options):
    physical = {n: v for n, v in values.items() if n not in STATE + SIGNALS}
    moving = {n: rates[n] for n in physical if n in rates}
    directions = soft.Directions(
        **{n: rates[n] for n in STATE + SIGNALS if n in rates},
        physics=soft.physics_directions(body, physical, moving) if moving else None,
    )
    return soft.rollout_tangents(
        body,
        soft.State(values["x"], values["v"]),
        num_steps,
        len(next(iter(rates.values()))),
        directions,
        physics=body.physics(**physical),
        **{n: values[n] for n in SIGNALS if n in values},
        **options,
    )


def central(f, values, rates, k, h=1e-4):
    """Fourth-order central difference of f along direction k."""

    def at(offset):
        return f({n: v + offset * rates[n][k] if n in rates else v for n, v in values.items()})

    return (8.0 * (at(h) - at(-h)) - (at(2.0 * h) - at(-2.0 * h))) / (12.0 * h)


def assert_close(found, expected, rtol):
    assert float((found - expected).norm()) < rtol * float(expected.norm())


@pytest.mark.parametrize("kind", ["hex", "assumed_strain"])
def test_damping_that_starts_to_act(kind):
    """A body without damping, along a direction that gives it some."""
    body = make_body(kind, rayleigh_beta=0.0)
    values = {n: v for n, v in inputs_of(body).items() if n != "rayleigh_beta"}
    given = {**values, "rayleigh_beta": torch.zeros(body.mesh.num_elements, dtype=torch.float64)}
    names = ["rayleigh_beta", "youngs_modulus"]
    rates = {n: r.abs() for n, r in rates_of(given, names).items()}
    found = tangents(body, given, rates)
    h = 1e-4

    def at(offset):
        moved = {n: v + offset * rates[n][0] if n in rates else v for n, v in given.items()}
        return simulate(body, moved).x

    one_sided = (-3.0 * at(0.0) + 4.0 * at(h) - at(2.0 * h)) / (2.0 * h)
    assert_close(found.tangent[:, 0], one_sided, 1e-5)


def test_signals_of_time_and_state():
    """A spring to the ground (force of the state) and a command that rises."""
    body = make_body()
    values = inputs_of(body)
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
    body = make_body()
    values = inputs_of(body)
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
    explicit = make_body(integrator="semi_implicit_euler", dt=0.01)
    with pytest.raises(ValueError, match="semi_implicit_euler"):
        soft.rollout_tangents(explicit, explicit.rest_state(), 1, 1, soft.Directions())
    body = make_body()
    with pytest.raises(ValueError, match=r"directions\.x"):
        soft.rollout_tangents(
            body, body.rest_state(), 1, 2, soft.Directions(x=torch.zeros(1, 2, 3).double())
        )
    with pytest.raises(ValueError, match=r"directions\.activation"):
        soft.rollout_tangents(
            body, body.rest_state(), 1, 2, soft.Directions(activation=torch.zeros(3, 2).double())
        )
