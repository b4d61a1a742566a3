"""Value and slope of a flow agree wherever its wall lies in the grid."""

import numpy as np
import pytest
import torch

from benchmarks import stokes_exact
from benchmarks.stokes_accuracy import measure
from benchmarks.stokes_positions import sweep
from diffsim import stokes


@pytest.mark.grad
@pytest.mark.parametrize("wall", ["no_separation", "no_slip"])
def test_slopes_are_those_of_the_smoothed_functional(wall):
    # with the normals of flat facets slopes of slip walls went from -2.6 to 1.8 times the smoothed
    found = sweep(48, wall, 61)
    for name in ("pressure at the inlet", "mean velocity in the gap"):
        assert np.abs(found[name].ratios - 1.0).max() < 0.1
        assert found[name].jump < 3e-4
    for name, each in found.items():
        assert each.ratios.min() > 0.0, name


@pytest.mark.order
def test_second_order_past_a_disk_that_slips():
    errors = [measure(stokes_exact.bubble(), n, "default", None)["error"] for n in (16, 32, 64)]
    assert errors[-1] < 3.7e-4  # 1.0e-3 with the normals of flat facets
    assert np.log2(errors[0] / errors[-1]) / 2 > 1.9  # 1.4


def kinked(amount: torch.Tensor) -> tuple[stokes.Grid, torch.Tensor]:
    """A tilted square with sharp corners, whose walls are straight."""
    grid = stokes.Grid((24, 24), size=1.0)
    a = 0.3
    turn = torch.tensor([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]], dtype=torch.float64)
    return grid, (((grid.nodes - 0.5) @ turn).abs().amax(-1) - 0.21 - amount)


@pytest.mark.grad
def test_sharp_corners_keep_exact_gradients():
    def loss(amount):
        grid, phi = kinked(amount)
        flow = stokes.StokesFlow(
            grid, [stokes.Inlet("x-"), stokes.Open("x+")], wall="no_separation"
        )
        velocity = flow(phi, torch.tensor([1.0, 0.2], dtype=torch.float64)).velocity
        return velocity[0, 18:, :, 1].square().sum()

    s = torch.tensor(0.0013, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(loss(s), s)
    h = 1e-6
    with torch.no_grad():
        difference = (loss(s + h) - loss(s - h)) / (2.0 * h)
    assert slope.item() == pytest.approx(difference.item(), rel=1e-5)


@pytest.mark.grad
@pytest.mark.parametrize("shape", [(1, 9), (2, 9), (9, 9), (3, 3, 9)])
def test_normals_at_the_ends_of_short_grids(shape):
    """A curved slip wall that meets the box, also where a row has two or three nodes only."""
    grid = stokes.Grid(shape, tuple(0.9 / n for n in shape))
    faces = [stokes.Inlet("x-"), *(stokes.Open(f) for f in grid.faces if f != "x-")]
    flow = stokes.StokesFlow(grid, faces, wall="no_separation", bulk_ratio=1e3)
    generator = torch.Generator().manual_seed(1)
    inlet = torch.randn(len(flow.boundary.inlets["x-"]), grid.dim, generator=generator).double()
    weight = torch.randn(*grid.node_shape, grid.dim, generator=generator).double()
    force = torch.randn(*grid.node_shape, grid.dim, generator=generator).double()
    center = torch.full((grid.dim,), -0.2, dtype=torch.float64)

    def loss(radius):
        phi = radius - (grid.nodes - center).norm(dim=-1)
        field = flow(phi, inlet, body_force=force, wall_velocity=force)
        return (field.velocity[0] * weight).sum() + field.pressure.square().sum() * 1e-3

    r = torch.tensor(0.71 if grid.dim == 2 else 0.9, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(loss(r), r)
    h = 1e-6
    with torch.no_grad():
        difference = (loss(r + h) - loss(r - h)) / (2.0 * h)
    assert slope.item() == pytest.approx(difference.item(), rel=1e-5)
