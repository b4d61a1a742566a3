"""Half spaces in cells: volume, area, normal, moments and their derivatives."""

import itertools
import math

import numpy as np
import pytest
import torch

from diffsim import stokes
from diffsim.stokes import _ops_cut as ops
from tests.helpers import check_layer, with_derivatives


def thesis_volume(a, b):
    """Thesis eq. 4.72: volume of {a.x + b > 0} in the unit cube, no component of a zero."""
    total = 0.0
    for corner in itertools.product([0, 1], repeat=len(a)):
        value = float(np.dot(a, corner) + b)
        if value >= 0.0:
            total += (-1) ** (len(a) - sum(corner)) * value ** len(a)
    return total / math.factorial(len(a)) / float(np.prod(a))


def thesis_area(a, b):
    """Eq. 4.74: the derivative of the volume by b, times |a|."""
    total = 0.0
    for corner in itertools.product([0, 1], repeat=len(a)):
        value = float(np.dot(a, corner) + b)
        if value >= 0.0:
            total += (-1) ** (len(a) - sum(corner)) * value ** (len(a) - 1)
    return total / math.factorial(len(a) - 1) / float(np.prod(a)) * float(np.linalg.norm(a))


def plane(grid, a, b):
    return grid.nodes @ torch.as_tensor(a, dtype=torch.float64) + b


@pytest.mark.reference
@pytest.mark.parametrize("dim", [2, 3])
def test_volume_and_area_are_those_of_the_thesis(dim):
    grid = stokes.Grid((1,) * dim, 1.0)
    rng = np.random.default_rng(0)
    for _ in range(200):
        a = rng.normal(size=dim)
        b = -float(a @ rng.random(dim))
        cells = stokes.cut_cells(grid, plane(grid, a, b))
        # the thesis's sum cancels: rounding grows with 1 / prod |a|
        scale = 1e-14 / float(np.abs(np.prod(a)))
        assert abs(float(cells.volume) - thesis_volume(a, b)) < 10 * scale
        assert abs(float(cells.area) - thesis_area(a, b)) < 30 * scale
        np.testing.assert_allclose(
            cells.normal.flatten().numpy(), -a / np.linalg.norm(a), rtol=0, atol=1e-13
        )


@pytest.mark.reference
@pytest.mark.parametrize("zeros", [(0,), (1,), (2,), (0, 1), (0, 2), (1, 2)])
def test_vanishing_components_reduce_to_fewer_dimensions(zeros):
    grid = stokes.Grid((1, 1, 1), 1.0)
    rng = np.random.default_rng(1)
    for _ in range(20):
        a = rng.normal(size=3)
        a[list(zeros)] = 0.0
        rest = np.delete(a, zeros)
        b = -float(rest @ rng.random(len(rest)))
        cells = stokes.cut_cells(grid, plane(grid, a, b))
        scale = 1e-13 / float(np.abs(np.prod(rest)))
        assert abs(float(cells.volume) - thesis_volume(rest, b)) < scale
        assert abs(float(cells.area) - thesis_area(rest, b)) < 3 * scale


@pytest.mark.reference
def test_anisotropic_cells():
    grid = stokes.Grid((1, 1), (0.5, 2.0))
    cells = stokes.cut_cells(grid, plane(grid, (4.0, 1.0), -2.0))  # diagonal: x / 0.5 + y / 2 > 1
    assert float(cells.volume) == pytest.approx(0.5, abs=1e-14)
    assert float(cells.area) == pytest.approx(math.hypot(0.5, 2.0), abs=1e-14)


@pytest.mark.order
def test_volume_and_area_of_a_sphere_converge_with_second_order():
    errors = []
    for n in (8, 16, 32):
        grid = stokes.Grid((n, n, n), size=1.0)
        phi = 0.37 - (grid.nodes - torch.tensor([0.51, 0.49, 0.503])).norm(dim=-1)
        cells = stokes.cut_cells(grid, phi)
        volume, area = 4 / 3 * math.pi * 0.37**3, 4 * math.pi * 0.37**2
        errors.append([float(cells.volume.sum()) / volume - 1, float(cells.area.sum()) / area - 1])
    orders = np.polyfit(np.log([1 / 8, 1 / 16, 1 / 32]), np.log(np.abs(errors)), 1)[0]
    assert (orders > 1.8).all()


@pytest.mark.property
def test_a_wall_in_the_faces_of_cells_belongs_to_the_fluid_side():
    grid = stokes.Grid((4, 3), 0.25)
    for shift in (-1e-16, 0.0, 1e-16):  # rounding must not lose or double the wall
        cells = stokes.cut_cells(grid, 0.5 - grid.nodes[..., 0] + shift)
        assert float(cells.area.sum()) == pytest.approx(0.75, abs=1e-12)
        assert float(cells.volume.sum()) == pytest.approx(0.375, abs=1e-12)
        assert float(cells.area[1].sum()) == pytest.approx(0.75, abs=1e-12)


@pytest.mark.property
@pytest.mark.parametrize("dim", [2, 3])
def test_volume_and_area_are_continuous_where_the_plane_passes_a_corner(dim):
    grid = stokes.Grid((1,) * dim, 1.0)
    a = torch.tensor([0.3, 0.9, 0.5], dtype=torch.float64)[:dim]
    for corner in itertools.product([0.0, 1.0], repeat=dim):
        b = -float(a @ torch.tensor(corner, dtype=torch.float64))
        here, there = (stokes.cut_cells(grid, plane(grid, a, b + s)) for s in (-1e-8, 1e-8))
        assert abs(float(here.volume - there.volume)) < 1e-7  # slope of the volume is its area
        assert abs(float(here.area - there.area)) < 1e-6


@pytest.mark.grad
@pytest.mark.parametrize("dim", [2, 3])
def test_contract(dim):
    grid = stokes.Grid((3, 2, 2)[:dim], (0.5, 0.4, 0.3)[:dim])
    phi = 0.45 - (grid.nodes - 0.4).norm(dim=-1)
    args = (list(grid.shape), list(grid.spacing), 1)

    def layer(phi):
        return torch.cat([part.flatten() for part in stokes.cut_cells(grid, phi)])

    flat = phi.reshape(-1)
    check_layer(
        layer,
        (phi.clone().requires_grad_(),),
        ops=with_derivatives(ops.cut_cells, flat.clone().requires_grad_(), *args),
    )


@pytest.mark.grad
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_gradient_with_a_vanishing_component(axis):
    grid = stokes.Grid((1, 1, 1), 1.0)
    a = torch.tensor([0.4, -0.7, 0.9], dtype=torch.float64)
    a[axis] = 0.0
    phi = plane(grid, a, 0.05 - 0.5 * float(a.sum())).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: stokes.cut_cells(grid, p).volume, (phi,))
    assert torch.autograd.gradcheck(lambda p: stokes.cut_cells(grid, p).area, (phi,))
