"""Points, tangents and closest points of spline surfaces as ops.

A surface is ``homogeneous``, (nu, nv, 4): w x, w y, w z, w, and for both of its parameters u and v
the arrays of a :class:`SplineBasis`, ``NAME_u`` and ``NAME_v``. The range of the parameters is
``low``, ``high``, two each, infinite where periodic.
"""

from __future__ import annotations

import math
from typing import Any

import torch

from diffsim.core.compiled import core
from diffsim.core.ops import Array, Call, Op, array


def _axis_arrays(axis: str) -> dict[str, Array]:
    """Arrays of a spline basis; ``first`` is the first active function of each span."""
    spans, order = f"num_spans_{axis}", f"order_{axis}"
    return {
        f"breaks_{axis}": array(f"num_breaks_{axis}"),
        f"coefficients_{axis}": array(spans, order, order),
        f"first_{axis}": array(spans, dtype=torch.int64),
        f"kinks_{axis}": array(f"num_kinks_{axis}"),
    }


SURFACE = {"homogeneous": array("num_u", "num_v", 4), **_axis_arrays("u"), **_axis_arrays("v")}


def _surface(call: Call, *others: str) -> object:
    """A surface as the kernels take it; it and other inputs must be finite."""
    for name in (*SURFACE, *others):
        if not bool(call[name].isfinite().all()):
            raise ValueError(f"{name} must be finite")
    if not call["homogeneous"].numel():
        raise ValueError("homogeneous must not be empty")
    return core.make_spline_surface(
        homogeneous=call["homogeneous"].data_ptr(), axes=[_axis(call, 0, "u"), _axis(call, 1, "v")]
    )


def _axis(call: Call, k: int, axis: str) -> Any:
    sizes, low, high = call.sizes, call.options["low"][k], call.options["high"][k]
    num, spans, degree = (sizes[f"{n}_{axis}"] for n in ("num", "num_spans", "order"))
    degree -= 1
    if spans < 1 or sizes[f"num_breaks_{axis}"] != spans + 1:
        raise ValueError(f"breaks of {axis} must be one more than its spans, and these one or more")
    if not 1 <= degree <= core.MAX_SPLINE_DEGREE:
        raise ValueError(f"degree must lie in [1, {core.MAX_SPLINE_DEGREE}], got {degree}")
    first = call[f"first_{axis}"]
    if not bool(((first >= 0) & (first < num)).all()):
        raise ValueError(f"first must lie in [0, {num - 1}]")
    if math.isinf(low) != math.isinf(high) or not low < high:
        raise ValueError(f"low must be below high, both or none infinite, got {low}, {high}")
    names = ("breaks", "coefficients", "first", "kinks")
    return core.make_spline_axis(
        **{name: call[f"{name}_{axis}"].data_ptr() for name in names},
        num=num,
        degree=degree,
        num_spans=spans,
        num_kinks=sizes[f"num_kinks_{axis}"],
        low=low,
        high=high,
    )


def _frames(call: Call) -> None:
    places = call.addresses("uv", "frames")
    core.surface_frames(surface=_surface(call, "uv"), num_points=len(call["uv"]), **places)


surface_frames = Op(  # S, S_u and S_v; csrc/kernels/stokes/spline_surface.h
    "stokes_surface_frames",
    inputs={"uv": array("num_points", 2), **SURFACE},
    outputs={"frames": array("num_points", 3, 3)},
    options="float[] low, float[] high",
    kernel=_frames,
)


def _closest(call: Call) -> None:
    sizes = call.sizes
    if not call["sample_uv"].numel():
        raise ValueError("there must be samples of the surface")
    core.closest_on_surface(
        surface=_surface(call, "points", "sample_uv", "sample_points"),
        num_samples=[sizes["samples_u"], sizes["samples_v"]],
        **{name: sizes[name] for name in ("gap", "band", "num_points", "num_threads")},
        **call.addresses("sample_uv", "sample_points", "points", "uv", "slope"),
    )


# Parameters and slopes; csrc/kernels/stokes/closest_surface.h. ``gap`` is the greatest distance of
# two neighbors among the samples, ``band`` that beyond which the nearest sample stands for the
# closest point [m].
closest_on_surface = Op(
    "stokes_closest_on_surface",
    inputs={
        "points": array("num_points", 3),
        **SURFACE,
        "sample_uv": array("samples_u", "samples_v", 2),
        "sample_points": array("samples_u", "samples_v", 3),
    },
    outputs={"uv": array("num_points", 2), "slope": array("num_points")},
    options="float[] low, float[] high, float gap, float band, int num_threads",
    kernel=_closest,
)
