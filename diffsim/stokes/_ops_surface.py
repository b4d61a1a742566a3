"""Points, tangents and closest points of spline surfaces as torch custom ops; all float64.

Surfaces come as lists of two, of u and v, made by :class:`SplineBasis`: ``breaks`` (num_spans + 1),
``coefficients`` (num_spans, degree + 1, degree + 1), ``first`` (num_spans,) int64, the first active
function of each span, and ``kinks``; ``homogeneous`` is (nu, nv, 4): w x, w y, w z, w. The range of
the parameters is ``low``, ``high``, two each, infinite where periodic.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.layer import custom_op, make_first_order


@custom_op("diffsim::stokes_surface_frames")
def surface_frames(
    uv: Tensor,
    homogeneous: Tensor,
    breaks: list[Tensor],
    coefficients: list[Tensor],
    first: list[Tensor],
    kinks: list[Tensor],
    low: list[float],
    high: list[float],
) -> Tensor:
    """S, S_u and S_v, (N, 3, 3), at parameters uv (N, 2); csrc/kernels/stokes/spline_surface.h."""
    if uv.shape[1:] != (2,):
        raise ValueError(f"uv must have shape (N, 2), got {tuple(uv.shape)}")
    uv = _plain("uv", uv)
    surface = _Surface(homogeneous, breaks, coefficients, first, kinks, low, high)
    frames = uv.new_empty(len(uv), 3, 3)
    core.surface_frames(
        surface=surface.of_core, uv=uv.data_ptr(), num_points=len(uv), frames=frames.data_ptr()
    )
    return frames


@surface_frames.register_fake
def _(uv, homogeneous, breaks, coefficients, first, kinks, low, high):  # type: ignore[no-untyped-def]
    return uv.new_empty(len(uv), 3, 3)


@custom_op("diffsim::stokes_closest_on_surface")
def closest_on_surface(
    points: Tensor,
    homogeneous: Tensor,
    breaks: list[Tensor],
    coefficients: list[Tensor],
    first: list[Tensor],
    kinks: list[Tensor],
    low: list[float],
    high: list[float],
    sample_uv: Tensor,
    sample_points: Tensor,
    gap: float,
    band: float,
    num_threads: int,
) -> tuple[Tensor, Tensor]:
    """Parameters (N, 2) and slopes (N,); csrc/kernels/stokes/closest_surface.h.

    Args:
        points: Points whose closest ones are sought, (N, 3) [m].
        homogeneous, breaks, coefficients, first, kinks, low, high: The surface.
        sample_uv: (num_u, num_v, 2), a grid of parameters.
        sample_points: (num_u, num_v, 3), the points there [m].
        gap: Greatest distance of two neighbors among the samples [m].
        band: Distance beyond which the nearest sample stands for the closest point [m].
        num_threads: Worker threads; results do not depend on them.
    """
    shape = sample_uv.shape[:2]
    sizes = points.shape[1:] == (3,), sample_uv.shape[2:] == (2,), sample_uv.numel() > 0
    if not all(sizes) or sample_points.shape != (*shape, 3):
        raise ValueError("points or samples have wrong shapes")
    points, sample_uv = _plain("points", points), _plain("sample_uv", sample_uv)
    sample_points = _plain("sample_points", sample_points)
    surface = _Surface(homogeneous, breaks, coefficients, first, kinks, low, high)
    uv, slope = points.new_empty(len(points), 2), points.new_empty(len(points))
    core.closest_on_surface(
        surface=surface.of_core,
        num_samples=list(shape),
        sample_uv=sample_uv.data_ptr(),
        sample_points=sample_points.data_ptr(),
        gap=gap,
        points=points.data_ptr(),
        num_points=len(points),
        band=band,
        uv=uv.data_ptr(),
        slope=slope.data_ptr(),
        num_threads=num_threads,
    )
    return uv, slope


@closest_on_surface.register_fake
def _(points, *_surface_and_samples):  # type: ignore[no-untyped-def]
    return points.new_empty(len(points), 2), points.new_empty(len(points))


class _Surface:
    """A surface as the kernels take it, and the tensors whose memory they read."""

    def __init__(
        self,
        homogeneous: Tensor,
        breaks: list[Tensor],
        coefficients: list[Tensor],
        first: list[Tensor],
        kinks: list[Tensor],
        low: list[float],
        high: list[float],
    ):
        if homogeneous.ndim != 3 or homogeneous.shape[2] != 4 or homogeneous.numel() == 0:
            raise ValueError(
                f"homogeneous must have shape (nu, nv, 4), got {tuple(homogeneous.shape)}"
            )
        self.kept: list[Any] = [_plain("homogeneous", homogeneous)]
        self.of_core = core.make_spline_surface(
            homogeneous=self.kept[0].data_ptr(),
            axes=[
                self._axis(homogeneous.shape[k], *each)
                for k, each in enumerate(
                    zip(breaks, coefficients, first, kinks, low, high, strict=True)
                )
            ],
        )

    def _axis(
        self,
        num: int,
        breaks: Tensor,
        coefficients: Tensor,
        first: Tensor,
        kinks: Tensor,
        low: float,
        high: float,
    ) -> Any:
        spans, degree = len(breaks) - 1, coefficients.shape[-1] - 1
        if spans < 1 or coefficients.shape != (spans, degree + 1, degree + 1):
            raise ValueError("breaks or coefficients have wrong shapes")
        if not 1 <= degree <= core.MAX_SPLINE_DEGREE:
            raise ValueError(f"degree must lie in [1, {core.MAX_SPLINE_DEGREE}], got {degree}")
        if first.shape != (spans,) or first.dtype != torch.int64 or kinks.ndim != 1:
            raise ValueError("first must be int64, one of each span, and kinks a row")
        if not bool(((first >= 0) & (first < num)).all()):
            raise ValueError(f"first must lie in [0, {num - 1}]")
        if math.isinf(low) != math.isinf(high) or not low < high:
            raise ValueError(f"low must be below high, both or none infinite, got {low}, {high}")
        breaks, coefficients = _plain("breaks", breaks), _plain("coefficients", coefficients)
        kinks, first = _plain("kinks", kinks), first.contiguous()
        self.kept += [breaks, coefficients, kinks, first]
        return core.make_spline_axis(
            num=num,
            degree=degree,
            num_spans=spans,
            breaks=breaks.data_ptr(),
            coefficients=coefficients.data_ptr(),
            first=first.data_ptr(),
            num_kinks=len(kinks),
            kinks=kinks.data_ptr(),
            low=low,
            high=high,
        )


def _plain(name: str, values: Tensor) -> Tensor:
    """The values as the kernels read them, or an error."""
    if values.dtype != torch.float64:
        raise TypeError(f"{name} must be float64, got {values.dtype}")
    if not bool(values.isfinite().all()):
        raise ValueError(f"{name} must be finite")
    return values.contiguous()


surface_frames_layer = make_first_order(surface_frames)
closest_on_surface_layer = make_first_order(closest_on_surface)
