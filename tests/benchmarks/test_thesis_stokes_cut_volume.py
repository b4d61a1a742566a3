"""Half spaces in boxes: exact volume and area, zero components, gradients."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from torch import Tensor

from benchmarks.thesis_stokes.cut_volume import Plane, cut_area, cut_volume, fit_plane

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


def published(slope: Tensor, offset: Tensor) -> float:
    """Thesis eq. 4.72 as it stands."""
    dim, total = len(slope), 0.0
    for corner in itertools.product((0.0, 1.0), repeat=dim):
        height = float((slope * torch.tensor(corner, dtype=F64)).sum() + offset)
        if height >= 0.0:
            total += (-1.0) ** (dim - sum(corner)) * height**dim
    return total / (math.factorial(dim) * float(slope.prod()))


@pytest.mark.reference
@pytest.mark.parametrize("dim", [2, 3])
def test_volume_is_that_of_the_published_formula(dim):
    plane = planes(dim, ())
    wanted = torch.tensor([published(*p) for p in zip(*plane, strict=True)], dtype=F64)
    # The published sum loses up to six digits to cancellation for slopes 1 : 1000.
    torch.testing.assert_close(cut_volume(plane), wanted, rtol=0, atol=1e-9)


@pytest.mark.reference
@pytest.mark.parametrize(("dim", "zeros"), CASES)
def test_volume_is_the_share_of_points(dim, zeros):
    plane = planes(dim, zeros, count=20)
    generator = torch.Generator().manual_seed(1)
    points = torch.quasirandom.SobolEngine(dim, scramble=True, seed=1).draw(1 << 16, dtype=F64)
    points = points + 1e-9 * torch.rand(points.shape, generator=generator, dtype=F64)
    share = (points @ plane.slope.T + plane.offset >= 0).double().mean(0)
    # Quasi Monte Carlo: 65536 points, error about N^(-3/4).
    torch.testing.assert_close(cut_volume(plane), share, rtol=0, atol=1e-3)


@pytest.mark.reference
@pytest.mark.parametrize(("dim", "zeros"), CASES)
def test_area_is_that_of_a_thin_layer(dim, zeros):
    """Volume between two planes a small distance apart, divided by that distance."""
    plane = planes(dim, zeros)
    sizes = torch.tensor([0.5, 0.3, 0.7][:dim], dtype=F64)
    thickness = 1e-6
    step = 0.5 * thickness * (plane.slope / sizes).norm(dim=-1)
    layer = cut_volume(Plane(plane.slope, plane.offset + step)) - cut_volume(
        Plane(plane.slope, plane.offset - step)
    )
    area = cut_area(plane, sizes.tolist())
    # The layer's rounding is 1e-16 / 1e-6; its curvature 1e-6 over the smallest slope's share 1e-3.
    torch.testing.assert_close(area, layer * sizes.prod() / thickness, rtol=0, atol=2e-4)
    assert float(area.min()) > 0.0


@pytest.mark.reference
def test_areas_known_from_geometry():
    def area(slope, offset):
        return float(
            cut_area(Plane(torch.tensor([slope], dtype=F64), torch.tensor([offset], dtype=F64)))
        )

    assert area([0.0, 1.0], -0.3) == pytest.approx(1.0, abs=1e-15)
    assert area([1.0, -1.0], 0.0) == pytest.approx(math.sqrt(2.0), abs=1e-15)
    assert area([0.0, 0.0, -2.0], 1.0) == pytest.approx(1.0, abs=1e-15)
    assert area([1.0, 1.0, 0.0], -1.0) == pytest.approx(math.sqrt(2.0), abs=1e-15)
    hexagon = 3.0 * math.sqrt(3.0) / 4.0
    assert area([1.0, 1.0, 1.0], -1.5) == pytest.approx(hexagon, abs=1e-15)


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


@pytest.mark.grad
@pytest.mark.parametrize(("dim", "zeros"), CASES)
def test_gradients(dim, zeros):
    generator = torch.Generator().manual_seed(2)
    slope = torch.randn(20, dim, generator=generator, dtype=F64)
    slope[:, list(zeros)] = 0.0
    at = 0.1 + 0.8 * torch.rand(20, dim, generator=generator, dtype=F64)
    args = (slope.requires_grad_(), (-(slope * at).sum(-1)).detach().requires_grad_())
    spacing = [0.5, 0.3, 0.7][:dim]
    assert torch.autograd.gradcheck(lambda a, b: cut_volume(Plane(a, b)), args, eps=1e-7, atol=1e-6)
    assert torch.autograd.gradcheck(
        lambda a, b: cut_area(Plane(a, b), spacing), args, eps=1e-7, atol=1e-6
    )


@pytest.mark.grad
def test_gradient_at_half_volume():
    """The mirror line of the formula: a kink there would show as a zero gradient."""
    offset = torch.tensor([-0.5], dtype=F64, requires_grad=True)
    share = cut_volume(Plane(torch.tensor([[0.0, 1.0]], dtype=F64), offset))
    (slope,) = torch.autograd.grad(share.sum(), offset)
    assert float(slope) == pytest.approx(1.0, abs=1e-15)


def test_fit_recovers_planes_and_refuses_other_shapes():
    slope, offset = planes(3, (), count=4)
    bits = torch.tensor(list(itertools.product((0.0, 1.0), repeat=3)), dtype=F64)
    corners = (slope @ bits.T + offset[:, None]).reshape(4, 2, 2, 2)
    fitted = fit_plane(corners)
    torch.testing.assert_close(fitted.slope, slope)
    torch.testing.assert_close(fitted.offset, offset)
    with pytest.raises(ValueError, match="corners must have shape"):
        fit_plane(torch.zeros(4, 3, 2))
