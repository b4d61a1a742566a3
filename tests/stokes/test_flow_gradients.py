"""Gradients of the flow: all inputs, both walls, corners, cells that become cut or empty."""

import pytest
import torch

from diffsim import stokes
from diffsim.stokes import _ops_cut, _ops_flow
from tests.helpers import check_layer, with_derivatives
from tests.stokes.cases import small_flow, small_inputs, tensor

pytestmark = pytest.mark.filterwarnings("ignore:the shape is thinner")


@pytest.mark.grad
@pytest.mark.parametrize("dim", [2, pytest.param(3, marks=pytest.mark.story)])
def test_contract(dim):
    flow = small_flow(dim)
    inputs = small_inputs(flow, cases=2)
    phi, inlet = inputs["phi"], inputs["inlet"]

    def layer(phi, inlet):
        field = flow(phi, inlet)
        return torch.cat([field.velocity.flatten(), field.pressure.flatten()])

    prescribed = torch.zeros(2, flow.grid.num_nodes, dim, dtype=torch.float64)
    prescribed[:, flow.boundary.inlets["x-"]] = inlet.detach()
    flat = phi.detach().reshape(-1)
    empty = dict.fromkeys(_ops_flow.LOADS, torch.zeros(0, dtype=torch.float64))
    given = _ops_flow.FlowInputs(flat, tensor(1.0), prescribed, **empty)
    args = (flow.handle, 1, "raise")
    velocity = _ops_flow.stokes_flow(*given, *args)[0]
    moving = given._replace(phi=flat.clone().requires_grad_())
    flux_args = (list(flow.grid.shape), list(flow.grid.spacing), 0, 2)
    check_layer(
        layer,
        (phi, inlet),
        ops=[
            *with_derivatives(_ops_flow.stokes_flow, *moving, *args),
            *with_derivatives(
                _ops_cut.plane_flux, flat.clone().requires_grad_(), velocity, *flux_args
            ),
        ],
        rtol=1e-5,
        atol=1e-4,  # pressures of about 1e3, of which differences are taken
        eps=2e-7,  # third derivatives of thin cuts: an error of 2e-6 at 1e-6, of its square below
        fast_mode=True,
    )


def plane_loss(dim, wall, normal):
    """Loss as a function of how far a plane wall lies above (0.25, ..), in the fluid's nodes."""
    shape = (8, 8) if dim == 2 else (4, 6, 4)
    grid = stokes.Grid(shape, 1 / 8)
    faces = [stokes.Inlet("x-"), stokes.Open("x+"), stokes.Wall("y-", "slip")]
    if dim == 3:
        faces += [stokes.Wall("z-", "slip"), stokes.Wall("z+", "slip")]
    flow = stokes.StokesFlow(grid, faces, wall=wall)
    x = grid.nodes
    inside = ((x - 0.25) @ normal < 0.02)[..., None]  # those nodes have fluid on the whole path
    weight = torch.cos(3.0 * x.sum(-1))[..., None] * tensor(1.0, 0.7, 0.3)[:dim] * inside
    speed = tensor(1.0, 0.0, 0.0)[:dim]

    def loss(s):
        field = flow(s - (x - 0.25) @ normal, speed)
        return (field.velocity * weight).sum() * grid.cell_volume

    return loss


def slope(loss, s):
    s = torch.tensor(s, dtype=torch.float64, requires_grad=True)
    value = loss(s)
    return float(value.detach()), float(torch.autograd.grad(value, s)[0])


@pytest.mark.grad
@pytest.mark.parametrize("wall", ["no_slip", "no_separation"])
@pytest.mark.parametrize("dim", [2, 3])
def test_path_through_corners(dim, wall):
    normal = tensor(0.3, 0.9, 0.2)[:dim]
    normal = normal / normal.norm()
    loss = plane_loss(dim, wall, normal)
    corner = float((tensor(0.25, 0.5, 0.25)[:dim] - 0.25) @ normal)  # exactly through a node
    h = 1e-6
    for offset in (-0.02, -1e-3, 0.0, 1e-3, 0.02):
        s = corner + offset
        value, found = slope(loss, s)
        with torch.no_grad():
            ahead, behind = (float(loss(torch.tensor(s + d, dtype=torch.float64))) for d in (h, -h))
        up, down = (ahead - value) / h, (value - behind) / h
        size = 1e-2 * abs(value) / 0.125  # a wall that moves by a cell
        if offset == 0.0 and dim == 2:
            # The wall's length in a cell has a kink where it passes a corner: the solution is
            # continuous, and the gradient is that of one side, or between the two.
            assert abs(ahead - behind) < 1e-4 * abs(value)
            assert min(up, down) - size < found < max(up, down) + size
        else:
            # in 3D the slope is continuous at a corner, but bends sharply
            bend = abs(up - down) if offset == 0.0 else 0.0
            assert abs(found - 0.5 * (up + down)) < 1e-3 * size + 1e-5 * abs(found) + bend


@pytest.mark.grad
@pytest.mark.parametrize("dim", [2, 3])
def test_a_wall_parallel_to_the_grid_jumps_by_less_than_the_discretization_error(dim):
    # Between layers of nodes the gradient is exact; where the wall passes a layer the flow changes
    # by 0.1 %, the difference of two discretizations of the same wall (8 cells: error about 1 %).
    loss = plane_loss(dim, "no_slip", tensor(0.0, 1.0, 0.0)[:dim])
    below, gradient_below = slope(loss, 0.25 - 1e-9)
    there, gradient_there = slope(loss, 0.25)
    above, _ = slope(loss, 0.25 + 1e-9)
    assert there == pytest.approx(below, rel=1e-6)
    assert gradient_there == pytest.approx(gradient_below, rel=1e-4)
    assert above == pytest.approx(below, rel=2e-3)
    size = abs(below) / 0.125
    for s, h in ((0.25 - 1e-4, 1e-6), (0.25 + 1e-4, 1e-6)):
        with torch.no_grad():
            ahead, behind = (float(loss(torch.tensor(s + d, dtype=torch.float64))) for d in (h, -h))
        assert slope(loss, s)[1] == pytest.approx((ahead - behind) / (2 * h), abs=1e-4 * size)


@pytest.mark.property
def test_the_jump_of_a_parallel_wall_comes_from_its_normal_velocity_and_shrinks():
    """Below a layer of nodes the wall holds v.n weakly; above, it bounds a film of its own pressure
    cell, and that volume's conservation holds the mean of v.n. The two walls differ by v.n."""
    jumps = []
    for n in (8, 16, 32):
        grid = stokes.Grid((n, n), 1 / n)
        faces = [stokes.Inlet("x-"), stokes.Open("x+"), stokes.Wall("y-", "slip")]
        flow = stokes.StokesFlow(grid, faces)
        below, above = (
            flow(0.5 + s - grid.nodes[..., 1], tensor(1.0, 0.0)).velocity[0] for s in (0.0, 1e-9)
        )
        assert float(below[1:, n // 2, 1].abs().max()) > 1e-3
        assert float(above[1:, n // 2, 1].abs().max()) < 1e-5
        fluid = grid.nodes[..., 1] <= 0.5
        jumps.append(float((above - below)[fluid].norm() / below[fluid].norm()))
    assert jumps[0] < 1.2e-2  # measured 1.0e-2, 4.6e-3, 2.2e-3
    assert jumps[2] < jumps[1] / 1.8 < jumps[0] / 1.8**2


@pytest.mark.grad
def test_backward_of_an_older_geometry_uses_its_own_factor():
    flow = small_flow(2)
    inputs = small_inputs(flow)
    inlet = inputs["inlet"].detach()
    first = inputs["phi"].detach().requires_grad_()
    (expected,) = torch.autograd.grad(flow(first, inlet).velocity.square().sum(), first)
    loss = flow(first, inlet).velocity.square().sum()
    flow(first.detach() + 0.03, inlet)  # replaces the kept factor
    (found,) = torch.autograd.grad(loss, first)
    assert torch.equal(found, expected)
