"""Transformations of torch.func on every layer: right, or refused (docs/transformations.md)."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.func import jacfwd, jacrev, jvp, linearize, vjp, vmap

from diffsim import contact, soft, stokes
from diffsim.copter import hover, lqr
from diffsim.linalg import polar3, svd3
from diffsim.ode import Ode
from tests.copter.flight_cases import all_effects, crooked_copter, tumbling
from tests.soft.cases import SHARP, deformed, irregular_mesh, noise, soft_body
from tests.stokes.cases import small_flow, small_inputs

pytestmark = pytest.mark.grad
Layer = Callable[[Tensor], Tensor]


def soft_step() -> tuple[Layer, Tensor]:
    m = irregular_mesh("tet", (1, 1, 1))
    body = soft_body(m, fixed=torch.tensor([0, 1]))
    x, v = deformed(m, 0.1), 0.2 * noise(m.num_nodes, 3, seed=2)
    return lambda u: body(soft.State(x, u)).x, v


def linearly_implicit_step() -> tuple[Layer, Tensor]:
    m = irregular_mesh("hex", (1, 1, 1))
    solver = soft.SolverOptions(method="linearly_implicit", **SHARP)
    body = soft_body(m, fixed=torch.tensor([0, 1]), solver=solver)
    v = 0.2 * noise(m.num_nodes, 3, seed=2)
    return lambda x: body(soft.State(x, v)).x, deformed(m, 0.1)


def soft_rollout() -> tuple[Layer, Tensor]:
    m = irregular_mesh("hex", (1, 1, 1))
    body = soft_body(m, fixed=torch.tensor([0, 1, 2, 3]))
    start = soft.State(body.x_rest, torch.zeros_like(body.x_rest))

    def layer(c: Tensor) -> Tensor:
        physics = body.physics(youngs_modulus=30.0 + c[0], density=1.5 + c[1])
        return soft.rollout(body, start, 3, physics=physics).x[-1]

    return layer, torch.tensor([0.3, 0.1]).double()


def soft_statics() -> tuple[Layer, Tensor]:
    m = irregular_mesh("hex", (1, 1, 1))
    body = soft_body(m, fixed=torch.tensor([0, 1, 2, 3]))
    return lambda f: body.static_equilibrium(external_force=f).x, 0.1 * noise(m.num_nodes, 3)


def soft_contact() -> tuple[Layer, Tensor]:
    m = irregular_mesh("tet", (1, 1, 1))
    body = soft_body(m)
    x = m.x_rest.clone()
    x[:, 2] += 0.02 - x[:, 2].min()
    ground = contact.plane((0.0, 0.0, 1.0), friction=0.2)
    down = torch.tensor([0.8, 0.3, -2.0]).double()

    def layer(v: Tensor) -> Tensor:
        state = soft.step(body, soft.State(x, v), obstacles=ground)
        return torch.cat([state.x, 0.1 * state.contact_force])

    return layer, down + 0.02 * noise(m.num_nodes, 3, seed=2)


def elastic_force() -> tuple[Layer, Tensor]:
    m = irregular_mesh("hex", (1, 1, 1))
    body = soft_body(m)
    return body.elastic_force, deformed(m)


def elastic_energy() -> tuple[Layer, Tensor]:
    m = irregular_mesh("hex", (1, 1, 1))
    body = soft_body(m)
    x = deformed(m)

    def layer(stiffness: Tensor) -> Tensor:
        at = torch.stack([x, 1.01 * x])
        return body.elastic_energy(at, physics=body.physics(youngs_modulus=1e4 * stiffness))

    return layer, 1.0 + 0.1 * noise(m.num_elements, seed=5).abs()


def flight() -> tuple[Layer, Tensor]:
    from diffsim.copter.dynamics.flight import fly

    vehicle, effects = crooked_copter(5), all_effects(5, 2)
    start = tumbling(1, 5)
    commands = 3.0 + 0.3 * noise(1, 2, 5)

    def layer(scale: Tensor) -> Tensor:
        flown = fly(vehicle, start, commands * scale, dt=0.03, effects=effects, substeps=2)
        return torch.cat([flown.state.position, flown.state.body_rates], dim=-1)

    return layer, 1.0 + 0.05 * noise(5, seed=4)


def least_hover() -> tuple[Layer, Tensor]:
    copter = crooked_copter(5)

    def layer(mass: Tensor) -> Tensor:
        return hover(copter.replace(mass=mass[0])).thrusts

    return layer, torch.tensor([0.9]).double() * float(copter.mass)


def gain() -> tuple[Layer, Tensor]:
    A = torch.tensor([[0.0, 1.0], [0.4, -0.3]]).double()
    B = torch.tensor([[0.1], [1.0]]).double()
    Q, R = torch.eye(2).double(), torch.eye(1).double()
    return lambda b: lqr(A, b, Q, R)[0], B


def ode() -> tuple[Layer, Tensor]:
    system = Ode(
        rates={"x": "v", "v": "-k*sin(x) - c*v*abs(v)"},
        readings={"y": "x + 0.1*v**2"},
        parameters=["k", "c"],
    )
    t = torch.linspace(0.0, 1.0, 6, dtype=torch.float64)
    start = torch.tensor([0.4, 0.3]).double()
    return lambda p: system.solve(t, start, None, p)[0], torch.tensor([3.0, 0.4]).double()


def decomposition() -> tuple[Layer, Tensor]:
    def layer(F: Tensor) -> Tensor:
        U, s, V = svd3(F)
        return torch.cat([U @ V.mT, s[..., None, :], polar3(F)], dim=-2)

    return layer, torch.eye(3).double() + 0.4 * noise(2, 3, 3)


def stokes_flow() -> tuple[Layer, Tensor]:
    flow = small_flow(2)
    inlet, x = small_inputs(flow)["inlet"].detach(), flow.grid.nodes

    def layer(shape: Tensor) -> Tensor:
        field = flow((x - shape[:2]).norm(dim=-1) - shape[2], inlet)
        return torch.cat([field.velocity.flatten(), field.pressure.flatten(), field.flux(0, 2)])

    return layer, torch.tensor([0.52, 0.47, 0.21]).double()


def cut_cells() -> tuple[Layer, Tensor]:
    grid = small_flow(2).grid
    phi = 0.3 - (grid.nodes - 0.48).norm(dim=-1)
    return lambda p: torch.cat([part.flatten() for part in stokes.cut_cells(grid, p)]), phi


LAYERS = [
    soft_step, linearly_implicit_step, soft_rollout, soft_statics, soft_contact, elastic_force,
    elastic_energy, flight, least_hover, gain, ode, decomposition, stokes_flow, cut_cells,
]  # fmt: skip


@pytest.mark.parametrize("made", LAYERS, ids=lambda f: f.__name__)
def test_forward_and_reverse_mode_are_each_other_s_transpose(made):
    layer, x = made()
    direction = noise(*x.shape, seed=7)
    out, moved = jvp(layer, (x,), (direction,))
    cotangent = noise(*out.shape, seed=8)
    (gradient,) = vjp(layer, x)[1](cotangent)
    forward, reverse = (cotangent * moved).sum(), (gradient * direction).sum()
    scale = (cotangent * moved).abs().sum()
    assert float(scale) > 0.0
    assert abs(float(forward - reverse)) < 1e-8 * float(scale)


@pytest.mark.parametrize("made", LAYERS, ids=lambda f: f.__name__)
def test_jacobians_and_mapped_axes(made):
    layer, x = made()
    forward, reverse = jacfwd(layer)(x), jacrev(layer)(x)
    torch.testing.assert_close(forward, reverse, rtol=1e-7, atol=1e-8 * float(reverse.abs().max()))
    both = torch.stack([x, x * 1.001])
    torch.testing.assert_close(vmap(layer)(both), torch.stack([layer(b) for b in both]))


@pytest.mark.parametrize("made", LAYERS, ids=lambda f: f.__name__)
def test_gradients_in_a_batch_are_those_of_each(made):
    layer, x = made()
    x = x.detach().requires_grad_()
    out = layer(x)
    cotangents = noise(3, *out.shape, seed=6)
    (batched,) = torch.autograd.grad(out, x, cotangents, retain_graph=True, is_grads_batched=True)
    each = [torch.autograd.grad(out, x, c, retain_graph=True)[0] for c in cotangents]
    assert torch.equal(batched, torch.stack(each))
    directions = noise(2, *x.shape, seed=5)

    def moved(by: Tensor) -> Tensor:
        return layer(x.detach() + (by[:, None] * directions.flatten(1)).sum(0).view_as(x))

    whole = {"vectorize": True, "strategy": "forward-mode"}
    forward = torch.autograd.functional.jacobian(moved, torch.zeros(2).double(), **whole)
    expected = torch.stack([jvp(layer, (x.detach(),), (d,))[1] for d in directions], dim=-1)
    torch.testing.assert_close(forward, expected)


TWICE = (gain, ode)


@pytest.mark.parametrize("made", [f for f in LAYERS if f not in TWICE], ids=lambda f: f.__name__)
def test_second_derivatives_are_refused(made):
    layer, x = made()
    with pytest.raises(RuntimeError, match="second order"):
        jacfwd(jacrev(lambda z: layer(z).square().sum()))(x)
    with pytest.raises(RuntimeError, match="second order"):
        jacrev(jacrev(lambda z: layer(z).square().sum()))(x)


@pytest.mark.parametrize("made", TWICE, ids=lambda f: f.__name__)
def test_second_derivatives(made):
    layer, x = made()
    hessians = [d(jacrev(lambda z: layer(z).square().sum()))(x) for d in (jacfwd, jacrev)]
    torch.testing.assert_close(hessians[0], hessians[1])
    step = 1e-5 * noise(*x.shape)
    slope = jacrev(lambda z: layer(z).square().sum())
    change = (slope(x + step) - slope(x - step)) / 2.0
    moved = (hessians[0] * step).sum(tuple(range(x.ndim, 2 * x.ndim)))
    torch.testing.assert_close(moved, change, rtol=1e-6, atol=1e-13)


@pytest.mark.parametrize("made", LAYERS, ids=lambda f: f.__name__)
@pytest.mark.filterwarnings("ignore:Attempted to insert a get_attr Node")
def test_linearize_gives_what_jvp_does_or_is_refused(made):
    layer, x = made()
    direction = noise(*x.shape, seed=7)
    try:
        moved = linearize(layer, x)[1](direction)
    except NotImplementedError as error:
        assert "torch.func.jvp" in str(error)
    else:
        torch.testing.assert_close(moved, jvp(layer, (x,), (direction,))[1], rtol=1e-12, atol=0.0)
