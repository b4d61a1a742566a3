"""Multigrid on the tangent: few iterations at any size, contrast and rotation, the same answers."""

import pytest
import torch

from diffsim import mesh, soft
from tests.soft.cases import noise, soft_body

KINDS = ["hex", "tet"]


def beam(cells, kind="hex", contrast=1.0, **changes) -> soft.SoftBody:
    """A beam of four by one by one held at x = 0, its middle third ``contrast`` times stiffer."""
    m = (mesh.hex_box if kind == "hex" else mesh.tet_box)(cells, (4.0, 1.0, 1.0))
    middle = m.x_rest[m.elements].mean(1)[:, 0]
    stiff = (middle > 4.0 / 3.0) & (middle < 8.0 / 3.0)
    arguments = {
        "youngs_modulus": torch.where(stiff, contrast * 1e4, 1e4).double(),
        "poissons_ratio": 0.45,
        "density": 10.0,
        "dt": 0.1,
        "fixed": m.x_rest[:, 0] == 0.0,
        "solver": soft.SolverOptions(preconditioner="multigrid", method="newton_pcg", rtol=1e-6),
    }
    return soft_body(m, **{**arguments, **changes})


def turned(x: torch.Tensor, degrees: float) -> torch.Tensor:
    """The shape twisted about its axis, from 0 at x = 0 to ``degrees`` at the end."""
    angle = torch.deg2rad(torch.tensor(degrees)) * x[:, 0] / 4.0
    y, z = x[:, 1] - 0.5, x[:, 2] - 0.5
    cos, sin = angle.cos(), angle.sin()
    return torch.stack([x[:, 0], 0.5 + y * cos - z * sin, 0.5 + y * sin + z * cos], dim=1)


def adjoint_iterations(body: soft.SoftBody, x: torch.Tensor) -> int:
    """Krylov iterations of the adjoint of a step that starts at ``x``."""
    start = x.clone().requires_grad_()
    with soft.record_stats() as solves:
        end = body(soft.State(start, torch.zeros_like(x)))
        (noise(*x.shape) * end.x).sum().backward()
    assert [s.kind for s in solves] == ["step", "adjoint"]
    return int(solves[1].num_iters)


CONSTANT = soft.SolverOptions(preconditioner="constant", method="newton_pcg", rtol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_iterations_do_not_grow_with_size(kind):
    found = []
    for width in (4, 8):
        body = beam((4 * width, width, width), kind)
        found.append(adjoint_iterations(body, body.x_rest))
    assert max(found) <= 18


@pytest.mark.parametrize("contrast", [100.0, 1e4])
def test_iterations_hardly_grow_with_contrast(contrast):
    body = beam((16, 4, 4), contrast=contrast)
    other = beam((16, 4, 4), contrast=contrast, solver=CONSTANT)
    found = adjoint_iterations(body, body.x_rest)
    assert found <= 22
    assert adjoint_iterations(other, body.x_rest) > 4 * found


def test_iterations_do_not_grow_with_rotation():
    """A quarter turn: a hierarchy that was made at rest would no longer hold the rigid modes."""
    body = beam((16, 4, 4))
    assert adjoint_iterations(body, turned(body.x_rest, 90.0)) <= 18


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rtol", [1e-4, 1e-8])
def test_preconditioners_agree_within_the_tolerance(kind, rtol):
    """States, adjoints and derivatives in forward mode of a stiff middle, against a factor."""
    found = []
    exact = soft.SolverOptions(method="newton_cholesky", rtol=1e-10)
    for solver in (
        exact,
        soft.SolverOptions(method="newton_pcg", preconditioner="constant", rtol=rtol),
        soft.SolverOptions(method="newton_pcg", preconditioner="multigrid", rtol=rtol),
    ):
        body = beam((8, 2, 2), kind, contrast=100.0, solver=solver)
        modulus = body.youngs_modulus.clone().requires_grad_()
        start = soft.State(turned(body.x_rest, 20.0), torch.zeros_like(body.x_rest))
        end = body(start, physics=body.physics(youngs_modulus=modulus))
        (gradient,) = torch.autograd.grad((noise(*end.x.shape) * end.x).sum(), modulus)
        value = {"youngs_modulus": modulus.detach()}
        rates = soft.physics_directions(body, value, {"youngs_modulus": noise(1, len(modulus))})
        directions = soft.Directions(physics=rates)
        tangent = soft.rollout_tangents(
            body, start, 1, 1, directions, physics=body.physics(**value)
        ).tangent[-1]
        found.append([end.x.detach(), 1e4 * gradient, tangent])
    # Residuals are rtol of the force scale, about 1e3 N; masses over dt^2 are at least 1 N/m.
    for other in found[1:]:
        for one, right in zip(other, found[0], strict=True):
            assert (one - right).norm() <= 30 * rtol * max(1.0, float(right.norm()))


def chosen(body: soft.SoftBody) -> str:
    """What the plan of the body's last system preconditions with."""
    body(body.rest_state())
    return next(reversed(body._context._systems.values())).preconditioner.name


def test_auto_takes_the_factor_for_small_bodies_and_multigrid_for_others():
    auto = soft.SolverOptions(rtol=1e-6)
    assert chosen(beam((4, 2, 2), solver=auto)) == "constant"
    assert chosen(beam((16, 4, 4), solver=auto)) == "multigrid"
    fixed = soft.SolverOptions(rtol=1e-6, preconditioner="constant")
    assert chosen(beam((16, 4, 4), solver=fixed)) == "constant"
    for method in ("quasi_newton", "newton_pcg"):
        textbook = soft.SolverOptions(rtol=1e-4, method=method)
        assert chosen(beam((16, 4, 4), solver=textbook)) == "constant"


def test_nodes_that_are_fixed_in_part_and_bodies_of_parts():
    """A rail, a node held in one axis, and a second piece that nothing touches."""
    one = mesh.hex_box((6, 3, 3), (2.0, 1.0, 1.0))
    apart = one.x_rest + torch.tensor([0.0, 5.0, 0.0], dtype=torch.float64)
    m = mesh.HexMesh(
        torch.cat([one.x_rest, apart]), torch.cat([one.elements, one.elements + one.num_nodes])
    )
    fixed = torch.zeros(m.num_nodes, 3, dtype=torch.bool)
    fixed[0] = True
    fixed[1, 1:] = True
    fixed[5, 2] = True
    ends = []
    for name in ("multigrid", "constant"):
        solver = soft.SolverOptions(method="newton_pcg", preconditioner=name, rtol=1e-9)
        body = soft_body(m, fixed=fixed, solver=solver, youngs_modulus=3e3)
        ends.append(body(soft.State(m.x_rest, 0.3 * noise(*m.x_rest.shape))).x)
    torch.testing.assert_close(*ends, rtol=0, atol=1e-7)
    torch.testing.assert_close(ends[0][fixed], m.x_rest[fixed], rtol=0, atol=0)


def test_a_part_that_nothing_holds_is_refused_at_rest():
    one = mesh.hex_box((4, 1, 1), (2.0, 1.0, 1.0))
    apart = one.x_rest + torch.tensor([0.0, 5.0, 0.0], dtype=torch.float64)
    m = mesh.HexMesh(
        torch.cat([one.x_rest, apart]), torch.cat([one.elements, one.elements + one.num_nodes])
    )
    body = soft_body(m, fixed=torch.tensor([0, 1, 2, 3]))
    with pytest.raises(Exception, match="needs Dirichlet nodes on every axis"):
        body.static_equilibrium()


def test_options_say_what_does_not_go_together():
    with pytest.raises(ValueError, match=r"preconditioner must be one of .*got 'amg'"):
        soft.SolverOptions(preconditioner="amg")
    with pytest.raises(ValueError, match=r"'constant' for method='quasi_newton', got 'multigrid'"):
        soft.SolverOptions(method="quasi_newton", preconditioner="multigrid")
