"""Half spaces in boxes: exact volume and area, zero components, gradients."""

import itertools

import pytest
import torch

from benchmarks.thesis_stokes.cut_volume import Plane, cut_area, cut_volume, fit_plane
from diffsim.stokes import Grid, cut_cells

F64 = torch.float64
# Which components of the slope vanish.
ZEROS = {2: [(), (0,), (1,)], 3: [(), (0,), (2,), (0, 1), (1, 2)]}
CASES = [(dim, zeros) for dim, all_zeros in ZEROS.items() for zeros in all_zeros]


def planes(dim: int, zeros: tuple[int, ...], count: int = 60, seed: int = 0) -> Plane:
    """Random planes through points of the cell, slopes over three decades."""
    generator = torch.Generator().manual_seed(seed)
    slope = torch.randn(count, dim, generator=generator, dtype=F64)
    slope = slope * 10.0 ** (3.0 * torch.rand(count, dim, generator=generator, dtype=F64) - 2.0)
    slope[:, list(zeros)] = 0.0
    at = torch.rand(count, dim, generator=generator, dtype=F64)
    return Plane(slope, -(slope * at).sum(-1))


@pytest.mark.reference
@pytest.mark.parametrize(("dim", "zeros"), CASES)
def test_volume_area_and_gradients_are_those_of_the_librarys_cells(dim, zeros):
    """Of one cell; tests/stokes/test_cut_cells.py holds the library to the thesis."""
    plane, grid = planes(dim, zeros, count=20), Grid((1,) * dim, 1.0)
    slope, offset = (part.clone().requires_grad_() for part in plane)
    for k in range(20):
        cell = cut_cells(grid, grid.nodes @ slope[k] + offset[k])
        for own, its in zip((cut_volume, cut_area), (cell.volume, cell.area), strict=True):
            both = own(Plane(slope, offset))[k], its.sum()
            torch.testing.assert_close(*both, rtol=1e-9, atol=1e-9)
            grads = [
                torch.autograd.grad(value, (slope, offset), retain_graph=True) for value in both
            ]
            for one, other in zip(*grads, strict=True):
                torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)


def test_a_plane_in_a_face_belongs_to_the_fluid_side():
    up = torch.tensor([[0.0, 1.0], [0.0, 1.0]], dtype=F64)
    plane = Plane(up, torch.tensor([0.0, -1.0], dtype=F64))  # cell above it, cell below it
    assert cut_volume(plane).tolist() == [1.0, 0.0]
    assert cut_area(plane).tolist() == [1.0, 0.0]


def test_flat_level_sets_are_full_or_empty():
    plane = Plane(torch.zeros(2, 3, dtype=F64), torch.tensor([1.0, -1.0], dtype=F64))
    assert cut_volume(plane).tolist() == [1.0, 0.0]
    assert cut_area(plane).tolist() == [0.0, 0.0]


@pytest.mark.property
@pytest.mark.parametrize(("dim", "zeros"), CASES)
def test_volume_keeps_its_digits_beside_tiny_components(dim, zeros):
    """A component of 1e-14 gives what zero gives, to rounding: nothing is divided by it."""
    plane = planes(dim, zeros)
    tiny = plane.slope.clone()
    tiny[:, list(zeros)] = 1e-14
    near = Plane(tiny, plane.offset - 0.5 * (tiny - plane.slope).sum(-1))
    # Over a slope of at least about 1e-3.
    torch.testing.assert_close(cut_volume(near), cut_volume(plane), rtol=0, atol=1e-11)
    torch.testing.assert_close(cut_area(near), cut_area(plane), rtol=0, atol=1e-9)


def test_fit_recovers_planes_and_refuses_other_shapes():
    slope, offset = planes(3, (), count=4)
    bits = torch.tensor(list(itertools.product((0.0, 1.0), repeat=3)), dtype=F64)
    corners = (slope @ bits.T + offset[:, None]).reshape(4, 2, 2, 2)
    fitted = fit_plane(corners)
    torch.testing.assert_close(fitted.slope, slope)
    torch.testing.assert_close(fitted.offset, offset)
    with pytest.raises(ValueError, match="corners must have shape"):
        fit_plane(torch.zeros(4, 3, 2))
