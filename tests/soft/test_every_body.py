"""Whatever a soft body is made of, it keeps this contract: derivatives in both modes are those of
differences; members, threads and copies change no bit; all methods agree.

A body with something new gets a row in ``BODIES``.
"""

import itertools
import pickle
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from diffsim import soft
from tests.covering import covering
from tests.gradients import check_directions
from tests.helpers import check_layer
from tests.soft.cases import (
    SHARP,
    deformed,
    element_of,
    irregular_mesh,
    leaf,
    noise,
    rail_mask,
    recorded_op,
    soft_body,
    two_muscles,
)
from tests.soft.test_chambers import hollow
from tests.soft.test_slack_fibers import fibers_of
from tests.soft.test_step_gradients import INTEGRATORS, METHODS, TOLERANCE

KINDS = ["hex", "tet"]
IMPLICIT = [name for name in INTEGRATORS if name != "semi_implicit_euler"]
SIGNALS = ("activation", "pressure", "external_force", "dirichlet_target")


class Parts(NamedTuple):
    """What a body is made of."""

    mesh: Any  # of a few elements
    options: dict[str, Any]  # arguments of ``soft_body``
    # signals and constants of the material that its motion has gradients to, by name
    inputs: dict[str, Any]


def solid(kind: str) -> Any:
    """Two hexahedra, or the six tetrahedra of one."""
    cells = (2, 1, 1) if kind in ("hex", "assumed_strain") else (1, 1, 1)
    return irregular_mesh(kind, cells, (2.0, 1.0, 1.0))


def spread(count: int, seed: int) -> Tensor:
    """Numbers about one, one of each element or node."""
    return 1.0 + 0.2 * noise(count, seed=seed).tanh()


def muscles(kind: str) -> Parts:
    inputs = {"activation": [0.8, 0.3], "fiber_stiffness": [8.0, 6.0]}
    return Parts(solid(kind), {"muscles": two_muscles()}, inputs)


def slack_fibers(kind: str) -> Parts:
    """Each of three tendons has fibers on both sides of slack."""
    m = irregular_mesh(kind, (3, 2, 1), (3.0, 2.0, 1.0))
    inputs = {"activation": [1.05, 1.15, 1.25], "fiber_stiffness": [20.0, 25.0, 15.0]}
    return Parts(m, {"muscles": fibers_of(m, count=3)}, inputs)


def cable(kind: str) -> Parts:
    m = irregular_mesh(kind, (2, 1, 1))
    path = [[0.4, 0.4, 0.4], [1.0, 0.6, 0.5], [1.6, 0.5, 0.6]]
    own = [soft.Tendon(m, path, axial_stiffness=5.0).muscle]
    return Parts(m, {"muscles": own}, {"activation": [0.7], "fiber_stiffness": [5.0]})


def inflated(shape: str) -> Callable[[str], Parts]:
    def make(kind: str) -> Parts:
        m, chamber = hollow(kind, shape)
        return Parts(m, {"chambers": [chamber]}, {"pressure": [6.0], "youngs_modulus": 30.0})

    return make


def regions(kind: str) -> Parts:
    """Stiffness, Poisson's ratio, density and damping of each element."""
    m = solid(kind)
    values = {"youngs_modulus": 30.0, "poissons_ratio": 0.3, "density": 1.5, "rayleigh_beta": 0.02}
    own = {name: v * spread(m.num_elements, k) for k, (name, v) in enumerate(values.items())}
    return Parts(m, {"rayleigh_beta": own["rayleigh_beta"]}, own)


def weighted_nodes(kind: str) -> Parts:
    m = solid(kind)
    masses = {
        "node_mass": spread(m.num_nodes, 6),
        "attached_mass": 0.2 * spread(m.num_nodes, 7),
        "added_mass": 0.3 * spread(m.num_nodes, 8),
    }
    return Parts(m, masses, masses)


def second_shares(kind: str) -> Parts:
    m = solid(kind)
    inputs = {"second_share": 0.3 * spread(m.num_elements, 3)}
    return Parts(m, {"material": "mooney_rivlin", "rayleigh_beta": 0.02}, inputs)


def everything(element: str | None = None, **changes: Any) -> Callable[[str], Parts]:
    """All that claims a gradient at once: on rails, targets that move, numbers of each element."""

    def make(kind: str) -> Parts:
        kind = element or kind
        m = solid(kind)
        inputs = {
            "external_force": 0.2 * noise(m.num_nodes, 3, seed=3),
            "activation": [0.8, 0.3],
            "dirichlet_target": m.x_rest + 0.05 * noise(m.num_nodes, 3, seed=4),
            "youngs_modulus": 30.0 * spread(m.num_elements, 0),
            "poissons_ratio": 0.3 * spread(m.num_elements, 1),
            "density": 1.5 * spread(m.num_nodes, 2),
            "gravity": [0.3, -0.2, -1.0],
            "rayleigh_alpha": 0.4,
            "rayleigh_beta": 0.02 * spread(m.num_elements, 3),
            "attached_mass": 0.2 * spread(m.num_nodes, 7),
            "fiber_stiffness": [8.0, 6.0],
        }
        options = {"element": element_of(kind), "fixed": rail_mask(m), "muscles": two_muscles()}
        return Parts(m, options | changes, inputs)

    return make


BODIES: dict[str, Callable[[str], Parts]] = {
    **{name: everything(material=name) for name in soft.MATERIALS if name != "mooney_rivlin"},
    "second shares": second_shares,
    "thesis weights": everything(volume_weight="thesis"),
    "muscles": muscles,
    "slack fibers": slack_fibers,
    "cable": cable,
    "cavity": inflated("cavity"),
    "pocket": inflated("pocket"),
    "regions": regions,
    "weighted nodes": weighted_nodes,
    "assumed strain": everything("assumed_strain"),
    "quadratic": everything("quadratic"),
}
ONLY_MOVING = ("x", "v", "rayleigh_alpha", "rayleigh_beta")
"""What does not matter at rest."""
NO_ENERGY = ("external_force", "dirichlet_target", "density", "gravity", "node_mass",
             "attached_mass", "added_mass")  # fmt: skip
"""What the energy of a shape does not depend on."""


def made(name: str, kind: str, **changes: Any) -> tuple[soft.SoftBody, dict[str, Tensor]]:
    """A body that is held at one end, and its inputs: a moving, strained state first."""
    parts = BODIES[name](kind)
    held = parts.mesh.x_rest[:, 0] < 0.3
    body = soft_body(parts.mesh, **{"fixed": held, "dt": 0.05, **parts.options, **changes})
    x = torch.where(body.fixed, parts.mesh.x_rest, deformed(parts.mesh, 0.1))
    state = {"x": 0.5 * (x + parts.mesh.x_rest), "v": 0.3 * noise(*x.shape, seed=2)}
    return body, {n: leaf(v) for n, v in (state | parts.inputs).items()}


def loads_of(body: soft.SoftBody, given: dict[str, Tensor]) -> dict[str, Any]:
    """Signals, and the body's constants."""
    constants = {n: v for n, v in given.items() if n not in (*SIGNALS, "x", "v")}
    signals = {n: given[n] for n in SIGNALS if n in given}
    return {"physics": body.physics(**constants), **signals}


def moved(body: soft.SoftBody, given: dict[str, Tensor], num_steps: int = 2) -> soft.State:
    """Where a body is after a few steps."""
    state, loads = soft.State(given["x"], given["v"]), loads_of(body, given)
    for _ in range(num_steps):
        state = body(state, **loads)
    return state


def state_and_gradients(body: soft.SoftBody, given: dict[str, Tensor]) -> list[Tensor]:
    """The state after two steps, and the gradients of a loss of it to all inputs."""
    state = moved(body, given)
    weight = noise(*state.x.shape[-2:], seed=4)
    loss = (weight * (state.x + 0.1 * state.v)).sum()
    return [state.x, state.v, *torch.autograd.grad(loss, list(given.values()))]


@pytest.mark.grad
@covering(
    name=list(BODIES),
    integrator=INTEGRATORS,
    kind=KINDS,
    method=["auto", "quasi_newton", "linearly_implicit", "linear on multigrid"],
)
def test_derivatives_are_those_of_differences(name, integrator, kind, method):
    """Of a motion, by every input, in both modes; BDF2 takes a third step for two old states."""
    chosen = {"method": method}
    if method == "linear on multigrid":
        chosen = {"method": "linearly_implicit", "preconditioner": "multigrid"}
    body, inputs = made(
        name,
        kind,
        integrator=integrator,
        solver=soft.SolverOptions(**chosen, **SHARP),
        **({"dt": 0.01} if integrator == "semi_implicit_euler" else {}),
    )

    def end(*values):
        given = dict(zip(inputs, values, strict=True))
        state = moved(body, given, 3 if integrator == "bdf2" else 2)
        return torch.cat([state.x.flatten(), 0.1 * state.v.flatten()])

    args = tuple(inputs.values())
    out = end(*args)
    grads = torch.autograd.grad(out, args, torch.linspace(1, 2, out.numel()).double())
    for input_name, grad in zip(inputs, grads, strict=True):
        assert grad.abs().max() > 1e-7, f"{input_name} has no gradient"
    check_directions(end, args, **TOLERANCE)


@pytest.mark.grad
@covering(name=list(BODIES), kind=KINDS)
def test_energy_force_and_rest_under_load_have_the_derivatives_of_differences(name, kind):
    body, inputs = made(name, kind)
    names = [n for n in inputs if n == "x" or n not in (*ONLY_MOVING, *NO_ENERGY)]

    def energy_and_force(*values):
        given = dict(zip(names, values, strict=True))
        loads = loads_of(body, given)
        energy = body.elastic_energy(given["x"], **loads)
        return energy, body.elastic_force(given["x"], **loads)

    args = tuple(inputs[n] for n in names)
    check_directions(energy_and_force, args, **TOLERANCE)
    energy, force = energy_and_force(*args)
    (slope,) = torch.autograd.grad(energy, args[0])
    torch.testing.assert_close(force.detach(), -slope, rtol=0, atol=1e-13)

    loads = [n for n in inputs if n not in (*ONLY_MOVING, "added_mass")]

    def at_rest(*values):
        return body.static_equilibrium(**loads_of(body, dict(zip(loads, values, strict=True)))).x

    if loads:
        check_directions(at_rest, [inputs[n] for n in loads], **TOLERANCE)


@covering(
    name=list(BODIES), integrator=["implicit_euler", "bdf2", "semi_implicit_euler"], kind=KINDS
)
def test_members_threads_and_copies_have_the_same_bits(name, integrator, kind):
    """Members have states, forces and targets of their own, and share the others; contraction
    muscles are alike in all, so activations are their own without these."""
    own = ["x", "v", "external_force", "dirichlet_target"]
    own += ["activation"] * (name in ("slack fibers", "cable"))
    dt = 0.01 if integrator == "semi_implicit_euler" else 0.05
    body, inputs = made(name, kind, integrator=integrator, dt=dt)
    members = {n: inputs[n].detach().expand(2, 3, *inputs[n].shape) for n in own if n in inputs}
    for seed, (n, value) in enumerate(members.items()):
        members[n] = value + 0.02 * noise(*value.shape, seed=5 + seed)
    members["x"] = torch.where(body.fixed, body.x_rest, members["x"])
    batch = inputs | {n: leaf(value) for n, value in members.items()}
    whole = state_and_gradients(body, batch)
    sums = dict.fromkeys(inputs.keys() - members.keys(), 0.0)
    for i, j in itertools.product(range(2), range(3)):
        one = {n: leaf(value[i, j]) for n, value in members.items()}
        alone = state_and_gradients(body, inputs | one)
        for k, (found, expected) in enumerate(zip(alone, whole, strict=True)):
            name = ["x", "v", *inputs][k]
            if k < 2 or name in members:
                torch.testing.assert_close(found, expected[i, j], rtol=0, atol=0)
            else:
                sums[name] = sums[name] + found
    for name, found in zip(inputs, whole[2:], strict=True):
        if name in sums:  # added in another order
            torch.testing.assert_close(found, sums[name], rtol=1e-11, atol=1e-11)
    twin = pickle.loads(pickle.dumps(body))
    twin.solver = replace(body.solver, num_threads=2)
    for one, other in zip(state_and_gradients(twin, batch), whole, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


@pytest.mark.reference
@covering(name=list(BODIES), method=[m for m in METHODS if m != "newton_cholesky"], kind=KINDS)
def test_methods_agree(name, method, kind):
    """Residuals of 1e-10 of some 1e2 N, over inertias of at least 1 N/m."""
    found = []
    for one in (method, "newton_cholesky"):
        solver = soft.SolverOptions(method=one, rtol=1e-10, adjoint_rtol=1e-10)
        found.append(state_and_gradients(*made(name, kind, solver=solver)))
    for one, other in zip(*found, strict=True):
        assert (one - other).norm() <= 1e-6 * max(1.0, float(other.detach().norm()))


@pytest.mark.grad
@covering(
    name=["pd", "pocket", "weighted nodes", "slack fibers"],
    integrator=INTEGRATORS,
    block=[1, 2, 3, 7],
)
def test_checkpoints_change_nothing(name, integrator, block):
    dt = 0.01 if integrator == "semi_implicit_euler" else 0.05
    body, inputs = made(name, "tet", integrator=integrator, dt=dt)
    found = []
    for every in (None, block):
        start, loads = soft.State(inputs["x"], inputs["v"]), loads_of(body, inputs)
        push = loads.pop("external_force", noise(*body.x_rest.shape, seed=3))
        motion = soft.rollout(
            body,
            start,
            5,
            **loads,
            external_force=lambda k, state, push=push: push * (1 + k) - 0.1 * state.v,
            checkpoint_every=every,
        )
        loss = (noise(*motion.x.shape) * motion.x).sum() + 0.1 * (motion.v**2).sum()
        grads = torch.autograd.grad(loss, list(inputs.values()))
        found.append([motion.x, motion.final.v, *grads])
    for k, (plain, saved) in enumerate(zip(*found, strict=True)):
        # gradients are the same numbers summed in another order: a few roundings
        tolerance = {} if k > 1 else {"rtol": 0, "atol": 0}
        torch.testing.assert_close(saved, plain, **{"rtol": 1e-12, "atol": 1e-12, **tolerance})


@pytest.mark.grad
@pytest.mark.parametrize(
    ("name", "kind", "op"),
    [
        ("pd", "tet", "soft_step"),
        *(
            pytest.param(*case, marks=pytest.mark.story)  # compiled three times each
            for case in (
                ("pocket", "hex", "soft_step"),
                ("pocket", "hex", "elastic_gradient"),
                ("pd", "hex", "elastic_gradient"),
            )
        ),
        ("pd", "tet", "elastic_energy"),
    ],
)
def test_ops_keep_the_layer_contract(name, kind, op):
    body, inputs = made(name, kind)
    names = [
        n for n in inputs if op == "soft_step" or n == "x" or n not in (*ONLY_MOVING, *NO_ENERGY)
    ]

    def layer(*values):
        given = dict(zip(names, values, strict=True))
        if op == "soft_step":
            return moved(body, given, 1).x
        function = body.elastic_force if op == "elastic_gradient" else body.elastic_energy
        return function(given["x"], **loads_of(body, given))

    args = tuple(inputs[n] for n in names)
    ops = recorded_op(op, lambda: layer(*args))
    check_layer(layer, args, ops=ops, fast_mode=True, **TOLERANCE)


@pytest.mark.parametrize(
    ("name", "integrator"),
    [
        ("second shares", "implicit_euler"),
        pytest.param("slack fibers", "bdf2", marks=pytest.mark.story),
        pytest.param("regions", "implicit_midpoint", marks=pytest.mark.story),
        pytest.param("cable", "semi_implicit_euler", marks=pytest.mark.story),
    ],
)
def test_a_step_compiles_whole(name, integrator):
    """With its adjoint; BDF2's second step remembers two states."""
    torch.compiler.reset()  # or sizes of the body before are thought to change
    body, inputs = made(name, "hex", integrator=integrator, dt=0.02)

    def after(*values):
        given = dict(zip(inputs, values, strict=True))
        return moved(body, given, 2 if integrator == "bdf2" else 1).x

    args = tuple(inputs.values())
    results = []
    for function in (after, torch.compile(after, fullgraph=True, backend="aot_eager")):
        out = function(*args)
        results.append((out, *torch.autograd.grad(out, args, noise(*out.shape))))
    torch.testing.assert_close(*results)


@pytest.mark.property
@covering(name=list(BODIES), integrator=INTEGRATORS, kind=KINDS)
def test_a_turned_world_gives_the_turned_motion(name, integrator, kind):
    """Energy is that of the shape alone, forces turn with it, and no part pushes the whole."""
    held = BODIES[name](kind).mesh.x_rest[:, 0] < 0.3  # rails do not turn
    body, inputs = made(name, kind, integrator=integrator, dt=0.02, fixed=held)
    here = {n: v.detach() for n, v in inputs.items()}
    here |= {"gravity": body.gravity, "dirichlet_target": here["x"]}
    turn = torch.linalg.qr(noise(3, 3, seed=3))[0]
    turn, shift = turn * torch.linalg.det(turn), torch.tensor([3.0, -2.0, 1.0])
    vectors = {n: here[n] @ turn.T for n in ("v", "gravity", "external_force") if n in here}
    there = here | vectors | {n: here[n] @ turn.T + shift for n in ("x", "dirichlet_target")}
    one, other = (moved(body, given, 3) for given in (here, there))
    # solves end at 1e-12 of the force scale; velocities are position errors over dt
    torch.testing.assert_close(other.x, one.x @ turn.T + shift, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(other.v, one.v @ turn.T, rtol=1e-7, atol=1e-7)
    loads = {
        n: v
        for n, v in loads_of(body, here).items()
        if n not in ("external_force", "dirichlet_target")
    }
    energies, forces = [], []
    for x in (here["x"], there["x"]):
        energies.append(body.elastic_energy(x, **loads))
        forces.append(body.elastic_force(x, **loads))
    torch.testing.assert_close(energies[1], energies[0], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(forces[1], forces[0] @ turn.T, rtol=1e-10, atol=1e-10)
    if "pressure" not in inputs:  # an open pocket is pushed
        none = torch.zeros(3, dtype=torch.float64)
        torque = torch.linalg.cross(here["x"], forces[0]).sum(0)
        torch.testing.assert_close(forces[0].sum(0), none, rtol=0, atol=1e-10)
        torch.testing.assert_close(torque, none, rtol=0, atol=1e-10)
    if "pressure" not in inputs:  # muscles of activation 1 are as long as at rest
        loads |= {n: torch.ones_like(v) for n, v in loads.items() if n == "activation"}
        assert body.elastic_energy(body.x_rest, **loads).abs() < 1e-20
        assert body.elastic_force(body.x_rest, **loads).abs().max() < 1e-12


def assert_close(found, expected, rtol):
    assert float((found - expected).norm()) < rtol * float(expected.norm())


def central(f, values, rates, h=1e-4):
    """Fourth-order central difference of f along a direction with a leading axis of one."""

    def at(offset):
        return f({n: v + offset * rates[n][0] for n, v in values.items()})

    return (8.0 * (at(h) - at(-h)) - (at(2.0 * h) - at(-2.0 * h))) / (12.0 * h)


def rates_of(values: dict[str, Tensor]) -> dict[str, Tensor]:
    """One direction that moves all values at once, each by a tenth of it, with a leading axis."""
    return {
        n: 0.1 * float(v.abs().max()) * noise(1, *v.shape, seed=30 + k)
        for k, (n, v) in enumerate(values.items())
    }


def directions_of(body: soft.SoftBody, values: dict[str, Tensor], rates: dict[str, Tensor]):
    constants = {n: v for n, v in values.items() if n not in (*SIGNALS, "x", "v")}
    moving = {n: rates[n] for n in constants}
    return soft.Directions(
        **{n: rates[n] for n in ("x", "v", *SIGNALS) if n in rates},
        physics=soft.physics_directions(body, constants, moving) if constants else None,
    )


@pytest.mark.grad
@covering(name=list(BODIES), integrator=IMPLICIT, kind=KINDS, method=["auto", "linearly_implicit"])
def test_tangents_of_a_motion_are_those_of_differences(name, integrator, kind, method):
    """Without a graph."""
    solver = soft.SolverOptions(method=method, **SHARP)
    body, inputs = made(name, kind, integrator=integrator, solver=solver)
    values = {n: v.detach() for n, v in inputs.items()}
    rates = rates_of(values)
    start, directions = soft.State(values["x"], values["v"]), directions_of(body, values, rates)
    found = soft.rollout_tangents(body, start, 3, 1, directions, **loads_of(body, values))
    assert torch.equal(found.x[-1], moved(body, values, 3).x)
    expected = central(lambda given: moved(body, given, 3).x, values, rates)
    assert_close(found.tangent[-1, 0], expected, 1e-6)


@pytest.mark.grad
@covering(name=list(BODIES), kind=KINDS)
def test_tangents_of_rest_under_load_are_those_of_differences(name, kind):
    body, inputs = made(name, kind)
    values = {n: v.detach() for n, v in inputs.items() if n not in ("x", "v")}
    rates = rates_of(values)

    def at_rest(given):
        return body.static_equilibrium(**loads_of(body, given)).x

    given = loads_of(body, values)
    found = soft.static_tangents(
        body, at_rest(values), 1, directions_of(body, values, rates), **given
    )
    assert_close(found[0], central(at_rest, values, rates), 1e-6)
