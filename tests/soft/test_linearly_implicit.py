"""Linearly implicit steps: one Newton step from the old positions, and its exact adjoint."""

import pytest
import torch
from torch import Tensor

from diffsim import contact, mesh, soft
from tests.soft.cases import (
    KINDS,
    SHARP,
    deformed,
    element_of,
    irregular_mesh,
    leaf,
    noise,
    rail_mask,
    soft_body,
    two_muscles,
)


def linear_body(m, **changes) -> soft.SoftBody:
    solver = soft.SolverOptions(method="linearly_implicit", **SHARP, **changes.pop("options", {}))
    return soft_body(m, solver=solver, **changes)


def require_differences(loss, leaves: list[Tensor], tolerance: float = 1e-6) -> None:
    """Gradients along one direction of each leaf against central differences."""
    grads = torch.autograd.grad(loss(*leaves), leaves)
    for k, grad in enumerate(grads):
        way = noise(*grad.shape, seed=20 + k) if grad.ndim else torch.ones_like(grad)
        h = 1e-5 * max(1.0, float(leaves[k].detach().abs().max()))
        ends = []
        for sign in (1.0, -1.0):
            moved = [leaf.detach() for leaf in leaves]
            moved[k] = moved[k] + sign * h * way
            with torch.no_grad():
                ends.append(loss(*moved))
        difference = float((ends[0] - ends[1]) / (2.0 * h))
        assert float((grad * way).sum()) == pytest.approx(difference, rel=tolerance, abs=1e-8)


def two_steps(body: soft.SoftBody, weight: Tensor, **given):
    """Loss of two steps as a function of state and parameters."""

    def loss(x, v, E, nu, rho, force, *rest):
        physics = body.physics(youngs_modulus=E, poissons_ratio=nu, density=rho)
        loads = dict(zip(given, rest, strict=True))
        state = soft.State(x, v)
        for _ in range(2):
            state = body(state, external_force=force, physics=physics, **loads)
        return (weight * state.x).sum() + 0.1 * (weight * state.v).sum()

    return loss


def leaves_of(m, *more) -> list[Tensor]:
    shape = (m.num_nodes, 3)
    amount = 0.15 if m.num_nodes < 40 else 0.05  # eighths are half as long: none inverted
    start = [deformed(m, amount), noise(*shape, seed=3), 30.0, 0.3, 1.5, noise(*shape, seed=4)]
    return [leaf(value) for value in (*start, *more)]


def require_transposes(loss, leaves: list[Tensor]) -> None:
    """Forward mode along one direction of all leaves against the gradient."""
    ways = [noise(*x.shape, seed=40 + k) if x.ndim else x / 7 for k, x in enumerate(leaves)]
    forward = torch.func.jvp(loss, tuple(leaves), tuple(ways))[1]
    grads = torch.autograd.grad(loss(*leaves), leaves)
    parts = torch.stack([(g * w).sum() for g, w in zip(grads, ways, strict=True)])
    assert (parts.abs() > 1e-6 * parts.abs().max()).all()  # every input takes part
    torch.testing.assert_close(forward, parts.sum(), rtol=0, atol=1e-8 * float(parts.abs().sum()))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("material", soft.MATERIALS)
def test_forward_mode_of_every_material_is_the_transpose_of_the_gradient(material, kind):
    m = irregular_mesh(kind)
    body = linear_body(m, element=element_of(kind), material=material, fixed=rail_mask(m))
    require_transposes(two_steps(body, noise(m.num_nodes, 3, seed=5)), leaves_of(m))


@pytest.mark.parametrize("preconditioner", ["auto", "multigrid"])
@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2", "implicit_midpoint"])
def test_gradients_with_muscles_damping_and_moving_targets(integrator, preconditioner):
    m = irregular_mesh("hex")
    body = linear_body(
        m,
        integrator=integrator,
        fixed=rail_mask(m),
        muscles=two_muscles(),
        rayleigh_alpha=0.1,
        rayleigh_beta=0.05,
        options={"preconditioner": preconditioner},
    )
    target = m.x_rest + 0.1 * noise(m.num_nodes, 3, seed=8)
    loss = two_steps(body, noise(m.num_nodes, 3, seed=5), activation=None, dirichlet_target=None)
    require_differences(loss, leaves_of(m, [0.9, 0.2], target))
    require_transposes(loss, leaves_of(m, [0.9, 0.2], target))


def test_gradients_at_rest_where_all_stretches_are_equal():
    m = irregular_mesh("hex")
    for material in ("pd", "corotated"):
        body = linear_body(m, material=material)
        start = [leaf(v) for v in (m.x_rest, 0.5 * noise(m.num_nodes, 3, seed=3))]
        rest = leaves_of(m)[2:]
        require_differences(two_steps(body, noise(m.num_nodes, 3, seed=5)), start + rest)


def test_step_and_gradient_are_those_of_torch_on_the_energy_written_out():
    """Newton's step by torch's Hessian of a St. Venant-Kirchhoff energy, and its gradient."""
    m = irregular_mesh("tet", cells=(1, 1, 1), size=(1.0, 1.0, 1.0))
    body = linear_body(m, material="stvk", gravity=(0.0, 0.0, 0.0))
    E, nu, h = 30.0, 0.3, body.dt
    rest = m.x_rest[m.elements]
    edges = (rest[:, 1:] - rest[:, :1]).mT
    inverse, volume = torch.linalg.inv(edges), torch.linalg.det(edges).abs() / 6.0

    def energy(x: Tensor, modulus: Tensor) -> Tensor:
        mu, lame = modulus / (2.0 * (1 + nu)), modulus * nu / ((1 + nu) * (1 - 2 * nu))
        corner = x.reshape(-1, 3)[m.elements]
        F = (corner[:, 1:] - corner[:, :1]).mT @ inverse
        G = 0.5 * (F.mT @ F - torch.eye(3, dtype=torch.float64))
        trace = G.diagonal(dim1=1, dim2=2).sum(1)
        return (volume * (mu * G.square().sum((1, 2)) + 0.5 * lame * trace**2)).sum()

    def newton(x: Tensor, v: Tensor, modulus: Tensor) -> Tensor:
        mass = body.physics().mass.repeat_interleave(3) / h**2
        slope = torch.func.grad(energy)(x.flatten(), modulus) - mass * h * v.flatten()
        H = torch.func.hessian(energy)(x.flatten(), modulus) + torch.diag(mass)
        return x - torch.linalg.solve(H, slope).reshape(-1, 3)

    x, v, modulus = leaf(deformed(m, 0.1)), leaf(noise(m.num_nodes, 3, seed=2)), leaf(E)
    weight = noise(m.num_nodes, 3, seed=6)
    found = body(soft.State(x, v), physics=body.physics(youngs_modulus=modulus)).x
    wanted = newton(x, v, modulus)
    torch.testing.assert_close(found, wanted, rtol=1e-11, atol=1e-11)
    ours = torch.autograd.grad((weight * found).sum(), (x, v, modulus))
    theirs = torch.autograd.grad((weight * wanted).sum(), (x, v, modulus))
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize(
    ("integrator", "order"), [("implicit_euler", 1.0), ("bdf2", 2.0), ("implicit_midpoint", 2.0)]
)
def test_order_is_that_of_the_integrator(integrator, order):
    m = mesh.hex_box((2, 1, 1), (1.0, 0.5, 0.5))

    def end(num_steps: int, method: str = "linearly_implicit") -> Tensor:
        body = soft_body(
            m,
            dt=0.4 / num_steps,
            youngs_modulus=100.0,
            fixed=m.nodes_near_plane("x", 0.0),
            integrator=integrator,
            solver=soft.SolverOptions(method=method, **SHARP),
        )
        return soft.rollout(body, body.rest_state(), num_steps).x[-1]

    exact = end(800, "auto")
    if order == 1.0:
        exact = 2.0 * exact - end(400, "auto")  # extrapolated to a step of zero
    coarse, fine = ((end(n) - exact).norm() for n in (40, 80))
    assert float(torch.log2(coarse / fine)) == pytest.approx(order, abs=0.25)


def test_a_tangent_that_is_not_definite_is_solved_all_the_same():
    m = irregular_mesh("hex")
    body = linear_body(m, youngs_modulus=3000.0)
    x = leaf(m.x_rest * torch.tensor([0.55, 1.0, 1.0]))  # compressed far beyond buckling
    v = leaf(torch.zeros_like(x))
    with soft.record_stats() as solves:
        loss = (body(soft.State(x, v)).x * noise(m.num_nodes, 3, seed=5)).sum()
    assert float(solves[0].num_factorizations[0]) > 1  # the first one broke down
    assert float(solves[0].converged[0]) == 1.0
    body = linear_body(m, youngs_modulus=3000.0)

    def f(x, v):
        return (body(soft.State(x, v)).x * noise(m.num_nodes, 3, seed=5)).sum()

    assert torch.isfinite(loss)
    require_differences(f, [x, v], tolerance=1e-5)


def test_what_has_no_linearly_implicit_step_is_refused():
    m = irregular_mesh("hex")
    body = linear_body(m)
    floor = contact.plane((0.0, 0.0, 1.0), -5.0)
    with pytest.raises(ValueError, match="need a solver that iterates"):
        body(body.rest_state(), obstacles=floor)
    x = leaf(m.x_rest)
    grad = torch.autograd.grad(
        body(soft.State(x, torch.zeros_like(x))).x.square().sum(), x, create_graph=True
    )[0]
    with pytest.raises(NotImplementedError, match="second order"):
        grad.sum().backward()


def test_statics_of_such_a_body_are_those_of_auto():
    m = irregular_mesh("hex")
    held = {"fixed": m.nodes_near_plane("x", float(m.x_rest[:, 0].min()), 0.3)}
    plain = soft_body(m, **held).static_equilibrium().x
    assert torch.equal(linear_body(m, **held).static_equilibrium().x, plain)
