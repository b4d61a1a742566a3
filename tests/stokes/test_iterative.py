"""The iterative solver: the direct one's answers and gradients, and what it does where it fails."""

import math

import pytest
import torch

from diffsim import stokes
from diffsim.core.errors import ConvergenceError, ConvergenceWarning
from diffsim.stokes.flow import MAX_DIRECT_NODES
from tests.stokes.cases import pipe, tensor

pytestmark = pytest.mark.filterwarnings("ignore:the shape is thinner")


def tube(
    wall: str, dim: int, method: str, *, incompressible: bool = False, **options
) -> tuple[stokes.StokesFlow, torch.Tensor]:
    """A bent tube through a box with two inlets and an open face; several levels of multigrid."""
    shape, size = ((48, 40), (1.2, 1.0)) if dim == 2 else ((18, 14, 12), (1.2, 1.0, 0.9))
    grid = stokes.Grid(shape, size=size)
    x = grid.nodes
    center = 0.5 + 0.12 * torch.sin(3.0 * x[..., 0])
    distance = (
        (x[..., 1] - center).abs() if dim == 2 else (x[..., 1:] - center[..., None]).norm(dim=-1)
    )
    branch = (
        (x[..., 0] - 0.55).abs() if dim == 2 else (x[..., ::2] - tensor(0.55, 0.45)).norm(dim=-1)
    )
    phi = torch.maximum(0.31 - distance, torch.minimum(0.2 - branch, 0.5 - x[..., 1]))
    conditions = [stokes.Inlet("x-"), stokes.Inlet("y-"), stokes.Open("x+")]
    solver = stokes.SolverOptions(method=method, **options)
    flow = stokes.StokesFlow(
        grid, conditions, wall=wall, incompressible=incompressible, solver=solver
    )
    return flow, phi


def solve(
    flow: stokes.StokesFlow, phi: torch.Tensor, *, rough: bool = True
) -> dict[str, torch.Tensor]:
    """Outputs for two cases, and gradients of a rough function of them by every input.

    Args:
        rough: Whether single pressures count and the wall's velocity changes from node to node.
    """
    dim = flow.grid.dim
    generator = torch.Generator().manual_seed(3)
    unit = torch.zeros(2, 1, dim, dtype=torch.float64)
    inputs = {
        "phi": phi.clone(),
        "x-": unit.clone().index_fill_(2, torch.tensor([0]), 1.0)[:, :, :]
        * tensor(1.0, 0.3)[:, None, None],
        "y-": unit.clone().index_fill_(2, torch.tensor([1]), 0.7),
        "viscosity": tensor(1.7),
        "wall_velocity": 0.1 * torch.randn((*phi.shape, dim), generator=generator).double(),
        "body_force": torch.randn((*phi.shape, dim), generator=generator).double(),
        "traction": torch.randn((*phi.shape, dim), generator=generator).double(),
    }
    if not rough:
        inputs["wall_velocity"] = 0.1 * flow.grid.nodes.cos()
    for value in inputs.values():
        value.requires_grad_()
    given = dict(inputs)
    field = flow(given.pop("phi"), {f: given.pop(f) for f in ("x-", "y-")}, **given)
    loss = sum(
        (out * torch.randn(out.shape, generator=generator).double()).sum()
        for out in (
            field.velocity,
            0.1 * (field.pressure if rough else field.pressure[:, 0].flatten(1).mean(1)),
            field.flux(0, 5),
        )
    )
    grads = torch.autograd.grad(loss, list(inputs.values()))
    outputs = {"velocity": field.velocity.detach(), "pressure": field.pressure.detach()}
    return outputs | {f"d {k}": g for k, g in zip(inputs, grads, strict=True)}


@pytest.mark.reference
@pytest.mark.parametrize("wall", ["no_slip", "no_separation"])
@pytest.mark.parametrize(
    ("dim", "incompressible"),
    [(2, False), (3, False), (2, True)],
)
def test_same_as_direct(dim, incompressible, wall):
    rtol = 1e-12 if incompressible else 1e-13
    options = {"incompressible": incompressible, "tolerance": 1e-11, "rtol": rtol}
    found, expected = (
        solve(*tube(wall, dim, method, max_iters=1000, **options))
        for method in ("iterative", "direct")
    )
    # Pressures that alternate in sign are held 1e4 times less than others and take as much more of
    # the residual; the gradients of shape and viscosity are products with pressures.
    weak = ("pressure", "d phi", "d viscosity")
    for name, value in expected.items():
        error = float((found[name] - value).norm() / value.norm())
        assert error < (1e-6 if name in weak else 1e-8), (name, error)


@pytest.mark.reference
@pytest.mark.parametrize("wall", ["no_slip", pytest.param("no_separation", marks=pytest.mark.slow)])
def test_incompressible_in_three_dimensions(wall):
    """The answer of the factor's iteration, though next to nothing holds some pressures."""
    made = {"incompressible": True, "max_iters": 1000}
    exact = solve(*tube(wall, 3, "direct", tolerance=1e-11, **made), rough=False)
    found = solve(*tube(wall, 3, "iterative", tolerance=1e-8, rtol=1e-9, **made), rough=False)
    for name, value in exact.items():
        error = float((found[name] - value).norm() / value.norm())
        assert error < (1e-6 if name in ("pressure", "d phi") else 1e-7), (name, error)


@pytest.mark.reference
def test_a_closed_incompressible_part_has_the_direct_solver_s_level():
    """The level of the pressure takes part where cells' planes do not meet (closed_regions.h)."""
    grid = stokes.Grid((7, 6, 5), spacing=0.2)
    phi = (grid.nodes - tensor(0.71, 0.62, 0.53)).norm(dim=-1) - 0.27
    lid = torch.zeros(7 * 6, 3, dtype=torch.float64)
    found = []
    for method in ("direct", "iterative"):
        options = stokes.SolverOptions(method=method, tolerance=1e-12, rtol=1e-12, max_iters=500)
        flow = stokes.StokesFlow(
            grid, [stokes.Inlet("z+")], wall="no_slip", incompressible=True, solver=options
        )
        at = flow.inlet_positions()
        inner = ((at[:, :2] > 0.1) & (at[:, :2] < tensor(1.3, 1.1))).all(-1)
        lid = torch.stack([inner.double(), *torch.zeros(2, len(at)).double()], dim=-1)
        shape = phi.clone().requires_grad_()
        field = flow(shape, lid)
        (slope,) = torch.autograd.grad((field.velocity * grid.nodes.cos()).sum(), shape)
        found.append((field.velocity.detach(), slope))
    for direct, iterative in zip(*found, strict=True):
        assert float((iterative - direct).norm()) < 1e-6 * float(direct.norm())


def test_auto_falls_back_on_the_factor():
    inlets = {"x-": tensor(1.0, 0.0, 0.0), "y-": tensor(0.0, 1.0, 0.0)}
    expected, _ = tube("no_slip", 3, "direct")
    flow, phi = tube("no_slip", 3, "auto", max_iters=5)
    flow._context.options.max_direct_nodes = 100
    assert flow.report(phi)["solver"] == "iterative"
    shapes = [phi.clone().requires_grad_() for _ in range(2)]
    fields = [flow(shapes[0], inlets), expected(shapes[1], inlets)]
    assert flow.report(phi)["solver"] == "direct"
    torch.testing.assert_close(fields[0].velocity, fields[1].velocity, rtol=0.0, atol=1e-12)
    for field in fields:
        field.velocity.square().sum().backward()
    torch.testing.assert_close(shapes[0].grad, shapes[1].grad)


@pytest.mark.reference
def test_pipe_exact():
    _, direct = pipe(16, "no_slip").solve(solver=stokes.SolverOptions(method="direct"))
    error, field = pipe(16, "no_slip").solve(solver=stokes.SolverOptions(method="iterative"))
    assert error < 2e-2
    torch.testing.assert_close(field.velocity, direct.velocity, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("incompressible", [False, True])
def test_threads_agree_bitwise(incompressible):
    made = {"incompressible": incompressible, "max_iters": 200}
    one, phi = tube("no_separation", 3, "iterative", num_threads=1, **made)
    two, _ = tube("no_separation", 3, "iterative", num_threads=3, **made)
    inlets = {"x-": tensor(1.0, 0.0, 0.0), "y-": tensor(0.0, 1.0, 0.0)}
    assert torch.equal(one(phi, inlets).velocity, two(phi, inlets).velocity)


@pytest.mark.property
def test_iterations_hardly_grow():
    counts = []
    for n in (8, 16, 32):
        grid = stokes.Grid((n, n, n // 2), size=(1.0, 1.0, 0.5))
        solver = stokes.SolverOptions(method="iterative", rtol=1e-8)
        flow = stokes.StokesFlow(grid, [stokes.Inlet("x-"), stokes.Open("x+")], solver=solver)
        counts.append(
            float(
                flow(torch.ones(grid.node_shape, dtype=torch.float64), tensor(1.0, 0.0, 0.0)).stats[
                    "num_iters"
                ]
            )
        )
    assert counts[2] < 1.5 * counts[1] and counts[2] < 60, counts


@pytest.mark.property
@pytest.mark.parametrize("incompressible", [False, True])
def test_cells_that_a_wall_enters_through_a_corner_cost_no_iterations(incompressible):
    """Their divergence is tiny, and so is the stiffness of the nodes that none but they have."""
    grid = stokes.Grid((24, 24, 24), size=1.0)
    x, y, z = grid.nodes.unbind(-1)
    phi = 0.3 - torch.hypot(y - 0.5 - 0.1 * torch.sin(torch.pi * x), z - 0.5)
    flow = stokes.StokesFlow(
        grid,
        [stokes.Inlet("x-"), stokes.Open("x+")],
        incompressible=incompressible,
        solver=stokes.SolverOptions(method="iterative", rtol=1e-8),
    )
    field = flow(phi, tensor(1.0, 0.0, 0.0))
    fractions = field.volume_fraction
    assert float(fractions[fractions > 0].min()) < 1e-6
    assert float(field.stats["num_iters"]) < 60


@pytest.mark.property
@pytest.mark.parametrize(("incompressible", "most"), [(False, 30), (True, 51)])
def test_pressures_of_whole_cells_are_weighed_by_all_their_corners(incompressible, most):
    """28 and 48 were measured, 33 and 57 with terms of other corners or axes in diag(L)."""
    grid = stokes.Grid((12, 12, 12), size=1.0)
    flow = stokes.StokesFlow(
        grid,
        [stokes.Inlet("x-"), stokes.Open("x+")],
        incompressible=incompressible,
        solver=stokes.SolverOptions(method="iterative", rtol=1e-8),
    )
    field = flow(torch.ones(grid.node_shape, dtype=torch.float64), tensor(1.0, 0.0, 0.0))
    assert float(field.stats["num_iters"]) <= most


def test_failure_is_reported():
    inlets = {"x-": tensor(1.0, 0.0), "y-": tensor(0.0, 1.0)}
    flow, phi = tube("no_slip", 2, "iterative", max_iters=3)
    with pytest.raises(ConvergenceError, match=r"after 3 iterations at relative residual .*rtol"):
        flow(phi, inlets)
    flow, phi = tube("no_slip", 2, "iterative", max_iters=3, on_failure="warn")
    with pytest.warns(ConvergenceWarning, match="Stokes solve stopped after 3 iterations"):
        field = flow(phi.requires_grad_(), inlets)
    assert float(field.stats["converged"]) == 0.0 and float(field.stats["residual"]) > 1e-9
    with pytest.warns(ConvergenceWarning, match="adjoint of the Stokes solve stopped after 3"):
        field.velocity.square().sum().backward()


def test_equal_rows_are_kept_once():
    cells = (24, 24, 12)
    grid = stokes.Grid(cells, size=(1.0, 1.0, 0.5))
    solver = stokes.SolverOptions(method="iterative")
    flow = stokes.StokesFlow(grid, [stokes.Inlet("x-"), stokes.Open("x+")], solver=solver)
    report = flow.report(torch.ones(grid.node_shape, dtype=torch.float64))
    blocks = math.prod(3 * (n + 1) - 2 for n in cells)  # nodes couple with those beside them
    assert report["solver_bytes"] < blocks * 9 * 8  # what the matrix would take alone


def test_walls_alike_from_plane_to_plane_are_kept_once():
    solver = stokes.SolverOptions(method="iterative")

    def bytes_of(tilt):
        grid = stokes.Grid((16, 16, 32), size=(1.0, 1.0, 2.0))
        flow = stokes.StokesFlow(grid, [stokes.Inlet("x-"), stokes.Open("x+")], solver=solver)
        x, y, z = grid.nodes.unbind(-1)
        report = flow.report(0.31 - (y - 0.5 + 0.1 * torch.sin(3.0 * x) + tilt * z).abs())
        return report["solver_bytes"] / report["num_nodes"]

    assert bytes_of(0.0) < 0.8 * bytes_of(0.02)


def test_choice_is_reported():
    flow, phi = tube("no_slip", 2, "auto")
    assert flow.report(phi)["solver"] == "direct"  # 2D
    flow, phi = tube("no_slip", 2, "iterative")
    report = flow.report(phi)
    assert report["solver"] == "iterative" and report["solver_bytes"] > 0
    with pytest.raises(ValueError, match="method must be one of"):
        tube("no_slip", 2, "iterativ")
    with pytest.raises(ValueError, match="rtol"):
        tube("no_slip", 2, "iterative", rtol=0.0)


@pytest.mark.parametrize(
    ("incompressible", "num_nodes"), [(False, 1.1 * MAX_DIRECT_NODES), (True, 27)]
)
def test_auto_is_iterative(incompressible, num_nodes):
    n = round(num_nodes ** (1 / 3))
    grid = stokes.Grid((n, n, n), size=1.0)
    conditions = [stokes.Inlet("x-"), stokes.Open("x+")]
    flow = stokes.StokesFlow(grid, conditions, incompressible=incompressible)
    phi = torch.ones(grid.node_shape, dtype=torch.float64)
    assert flow.report(phi)["solver"] == "iterative"
