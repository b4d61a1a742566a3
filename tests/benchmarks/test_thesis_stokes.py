"""The published formulation: errors on exact flows, compressibility, locking, gradients."""

import pytest
import torch
from torch import Tensor

from benchmarks.stokes_exact import Exact, couette, pipe, rotated_channel
from benchmarks.thesis_stokes import ThesisFlow
from diffsim.stokes import FlowField, Grid, Inlet, Open

F64 = torch.float64
NAMES = ("phi", "inlet", "viscosity", "wall_velocity", "body_force", "traction")


def errors(exact: Exact, poissons_ratio: float, *cells: int) -> list[float]:
    found = []
    for n in cells:
        grid = exact.grid(n)
        flow = ThesisFlow(grid, exact.conditions(), wall=exact.wall, poissons_ratio=poissons_ratio)
        found.append(exact.error(exact.solve(flow, grid)))
    return found


@pytest.mark.reference
def test_pipe_error_ends_at_the_compressibility_error():
    """Published code, nu = 0.49: 2.7e-2 from 32 cells on, however fine the grid.

    The radii of that pipe are not known. Those of ours, 0.12 and 0.9, were picked among 60 pairs
    because they come closest, so the level is no evidence; that refinement does not lower it is.
    """
    coarse, fine = errors(pipe(), 0.49, 32, 64)
    assert coarse == pytest.approx(2.7e-2, rel=0.05)
    assert fine == pytest.approx(2.7e-2, rel=0.05)


@pytest.mark.reference
def test_pipe_locks():
    """Published code, nu = 0.4999: 4.0e-2 and 3.3e-2 at 32 and 64 cells (here 5.7e-2, 5.8e-2).

    The compressibility error would be 100 times below that at nu = 0.49. Other radii looked at gave
    3.7e-2 to 1.3e-1, so the published figures are met to a factor of two only.
    """
    coarse, fine = errors(pipe(), 0.4999, 32, 64)
    assert 2.0e-2 < coarse < 8.0e-2
    assert 1.6e-2 < fine < 6.6e-2
    assert fine > 0.5 * coarse  # a second-order method has a quarter


@pytest.mark.reference
def test_slip_pipe_is_as_published():
    """A rigid rotation, so no compressibility error. Published: 3.3e-2 to 6e-3 at best."""
    for error in errors(pipe("no_separation"), 0.4999, 16, 32, 64):
        assert 4e-3 < error < 3.3e-2


@pytest.mark.order
def test_second_order_far_from_incompressible_where_pressure_vanishes():
    """Couette flow has no dilatation, and nothing locks at nu = 0.3: what is left is the grid."""
    coarse, fine = errors(couette(), 0.3, 32, 128)
    # Order 2 with a margin for cuts that fall differently: 4^1.7 = 10.6.
    assert fine < coarse / 10.6


@pytest.mark.reference
def test_rotated_channel_compressibility_error_follows_poissons_ratio():
    """At a fixed grid the error falls like 1 - 2 nu: 0.1 to 0.02, until the grid's own shows."""
    (soft,), (stiff,) = errors(rotated_channel(), 0.45, 64), errors(rotated_channel(), 0.49, 64)
    # Not 5 times: at nu = 0.45 the pressure itself is already less than in the limit.
    assert 3.0 < soft / stiff < 5.0


def channel(wall: str, poissons_ratio: float, viscosity: float = 1.0) -> FlowField:
    """A straight channel of width 0.6 in a unit box, parabola in, open end."""
    grid = Grid((24, 24), size=1.0)
    offset = (grid.nodes[..., 1] - 0.507).abs()
    flow = ThesisFlow(
        grid,
        [Inlet("x-"), Open("x+")],
        viscosity=viscosity,
        poissons_ratio=poissons_ratio,
        wall=wall,
    )
    profile = 1.0 - (offset[0] / 0.3) ** 2
    return flow(0.3 - offset, torch.stack([profile, torch.zeros_like(profile)], dim=-1))


@pytest.mark.property
def test_mass_is_lost_in_proportion_to_compressibility():
    """div v = -p / lambda: lambda grows 102 times from nu = 0.49 to 0.4999, the loss falls so."""
    lost = [float(channel("no_slip", nu).mass_report()["imbalance"].abs()) for nu in (0.49, 0.4999)]
    # 12 / (lambda / eta) (length / width)^2 / 2 = 0.34 if the loss did not lower the pressure.
    assert 0.2 < lost[0] < 0.34
    # Channels along the grid do not lock; less than 102 as the large loss lowers its own cause.
    assert 70.0 < lost[0] / lost[1] < 102.0


@pytest.mark.reference
@pytest.mark.parametrize("where", [0.5, 0.5 - 1e-12, 0.5 + 1e-12])
@pytest.mark.parametrize("dim", [2, 3])
def test_walls_in_a_layer_of_nodes_hold(dim, where):
    """Zero components of the normal (the published code stops), and rounding on either side."""
    grid = Grid((4,) * dim, size=1.0)
    flow = ThesisFlow(grid, [Inlet("x-"), Open("x+")])
    height = grid.nodes.reshape(-1, dim)[flow.boundary.inlets["x-"], 1]
    inlet = torch.zeros(len(height), dim, dtype=F64)
    inlet[:, 0] = height * (0.5 - height).clamp(min=0.0)
    field = flow(where - grid.nodes[..., 1], inlet)
    speed = field.velocity[0].norm(dim=-1)
    speed = speed if dim == 2 else speed[:, :, 2]  # away from the box's own walls
    speed = speed / speed.max()
    assert float(speed[:, 1].min()) > 0.05
    assert float(speed[:, 2:].max()) < 1e-8  # of the order of 1, were the wall not seen


def small_problem(dim: int, wall: str) -> tuple[ThesisFlow, tuple[Tensor, ...]]:
    """An uneven channel, two cases, every input random."""
    generator = torch.Generator().manual_seed(0)
    shape, spacing = ((5, 5), (0.2, 0.25)) if dim == 2 else ((4, 4, 3), (0.2, 0.25, 0.22))
    grid = Grid(shape, spacing=spacing)
    flow = ThesisFlow(grid, [Inlet("x-"), Open("x+")], wall=wall)

    def normal(*size: int) -> Tensor:
        return torch.randn(*size, generator=generator, dtype=F64)

    x = grid.nodes
    phi = 0.31 - (x[..., 1] - 0.5 * grid.size[1] + 0.1 * x[..., 0]).abs()
    phi = phi + 0.02 * normal(*grid.node_shape)
    inlet = normal(2, len(flow.boundary.inlets["x-"]), dim)
    viscosity = torch.tensor(1.7, dtype=F64)
    wall_velocity = normal(2, *grid.node_shape, dim)
    body_force, traction = normal(*grid.node_shape, dim), normal(2, *grid.node_shape, dim)
    args = (phi, inlet, viscosity, wall_velocity, body_force, traction)
    return flow, tuple(a.requires_grad_() for a in args)


def outputs(flow: ThesisFlow, args: tuple[Tensor, ...]) -> Tensor:
    field = flow(**dict(zip(NAMES, args, strict=True)))
    return torch.cat([field.velocity.flatten(), 0.1 * field.pressure.flatten(), field.flux(0, 2)])


@pytest.mark.grad
@pytest.mark.parametrize("wall", ["no_slip", "no_separation"])
def test_gradcheck(wall):
    """Along a direction of all inputs."""
    flow, (phi, inlet, viscosity, _, force, traction) = small_problem(2, wall)
    moving = torch.tensor([0.3, -0.4], dtype=F64, requires_grad=True)
    traction = traction.detach()[0].requires_grad_()
    args = (phi, inlet.detach()[0].requires_grad_(), viscosity, moving, force, traction)
    grads = torch.autograd.grad(outputs(flow, args).square().sum(), args)
    assert all(float(g.abs().max()) > 0 for g in grads)
    # Central differences of 1e-6 with a KKT matrix of condition about 1e8.
    assert torch.autograd.gradcheck(
        lambda *a: outputs(flow, a), args, eps=1e-6, atol=1e-5, rtol=1e-4, fast_mode=True
    )
