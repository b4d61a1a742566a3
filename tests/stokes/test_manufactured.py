"""Manufactured solutions of both formulations: body force, varying traction, moving wall."""

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.thesis_stokes import ThesisFlow
from diffsim import stokes
from tests.stokes.cases import tensor

ETA = 1.3
SIZES = (16, 32, 64)


def velocity(x: Tensor) -> Tensor:
    """(x^2 - y^2, -2 x y) + (sin cos, -cos sin)(pi x, pi y): no divergence, no pressure needed."""
    (sx, sy), (cx, cy) = torch.sin(torch.pi * x).unbind(-1), torch.cos(torch.pi * x).unbind(-1)
    a, b = x.unbind(-1)
    return torch.stack([a**2 - b**2 + sx * cy, -2.0 * a * b - cx * sy], dim=-1)


def body_force(x: Tensor) -> Tensor:
    """-eta times the Laplacian: the polynomial is harmonic."""
    (sx, sy), (cx, cy) = torch.sin(torch.pi * x).unbind(-1), torch.cos(torch.pi * x).unbind(-1)
    return ETA * 2.0 * torch.pi**2 * torch.stack([sx * cy, -cx * sy], dim=-1)


def traction(x: Tensor) -> Tensor:
    """2 eta D(v) n on x+, n = (1, 0)."""
    a, b = x.unbind(-1)
    cx, cy = torch.cos(torch.pi * x).unbind(-1)
    return ETA * torch.stack([4.0 * a + 2.0 * torch.pi * cx * cy, -4.0 * b], dim=-1)


def error(n: int, layer=stokes.StokesFlow, **options) -> float:
    """A disk that the open face x+ cuts; the wall moves with the exact velocity."""
    grid = stokes.Grid((n, n), size=1.0)
    flow = layer(grid, [stokes.Open("x+")], viscosity=ETA, **options)
    x = grid.nodes
    phi = 0.4 - (x - tensor(0.84, 0.497)).norm(dim=-1)
    field = flow(phi, wall_velocity=velocity(x), body_force=body_force(x), traction=traction(x))
    inside = phi > 0
    return float((field.velocity[0] - velocity(x))[inside].norm() / velocity(x)[inside].norm())


def test_the_solution_is_one():
    """Divergence, momentum balance and traction by automatic differentiation."""
    points = torch.rand(20, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    slopes = torch.func.vmap(torch.func.jacrev(velocity))(points)
    assert float(slopes.diagonal(dim1=1, dim2=2).sum(-1).abs().max()) < 1e-12

    def stress(x: Tensor) -> Tensor:
        gradient = torch.func.jacrev(velocity)(x)
        return ETA * (gradient + gradient.T)

    balance = torch.func.vmap(torch.func.jacrev(stress))(points).diagonal(dim1=2, dim2=3).sum(-1)
    torch.testing.assert_close(-balance, body_force(points), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(torch.func.vmap(stress)(points)[:, 0], traction(points))


@pytest.mark.order
@pytest.mark.parametrize(
    ("options", "limit", "least_order"),
    [
        ({}, 2.4e-4, 1.9),  # measured 2.0e-4
        ({"incompressible": True}, 2.4e-4, 1.9),
        # no pressure, so no compressibility error; far from locking
        ({"layer": ThesisFlow, "poissons_ratio": 0.3}, 4.2e-4, 1.8),
    ],
    ids=["default", "incompressible", "thesis"],
)
def test_second_order_with_body_force_and_traction(options, limit, least_order):
    found = [error(n, **options) for n in SIZES]
    assert found[-1] < limit
    assert -np.polyfit(np.log(SIZES), np.log(found), 1)[0] > least_order


@pytest.mark.reference
@pytest.mark.parametrize("load", ["body_force", "traction"])
def test_each_load_counts(load):
    """Without one of the loads the error is not small: each test above needs both."""
    grid = stokes.Grid((16, 16), size=1.0)
    x = grid.nodes
    phi = 0.4 - (x - tensor(0.84, 0.497)).norm(dim=-1)
    loads = {"body_force": body_force(x), "traction": traction(x)}
    del loads[load]
    for layer in (stokes.StokesFlow, ThesisFlow):
        flow = layer(grid, [stokes.Open("x+")], viscosity=ETA)
        found = flow(phi, wall_velocity=velocity(x), **loads).velocity[0]
        assert float((found - velocity(x))[phi > 0].norm() / velocity(x)[phi > 0].norm()) > 0.05
