"""Linearly implicit steps: one Newton step from the old positions, and its exact adjoint."""

import pytest
import torch
from torch import Tensor

from diffsim import contact, mesh, soft
from tests.gradients import check_directions
from tests.soft.cases import SHARP, deformed, irregular_mesh, leaf, noise, soft_body
from tests.soft.test_step_gradients import TOLERANCE, layer_of


def linear_body(m, **changes) -> soft.SoftBody:
    solver = soft.SolverOptions(method="linearly_implicit", **SHARP, **changes.pop("options", {}))
    return soft_body(m, solver=solver, **changes)


@pytest.mark.parametrize("material", ["pd", "corotated"])
def test_gradients_at_rest_where_all_stretches_are_equal(material):
    m = irregular_mesh("hex")
    layer = layer_of(linear_body(m, material=material), ("x", "v", "youngs_modulus"))
    args = (leaf(m.x_rest), leaf(0.5 * noise(m.num_nodes, 3, seed=3)), leaf(30.0))
    check_directions(layer, args, **TOLERANCE)


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
    check_directions(f, (x, v), eps=1e-6, atol=1e-5, rtol=1e-5)


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
