"""Closest points on curves as an op."""

from __future__ import annotations

from diffsim.core.compiled import core
from diffsim.core.ops import Call, Op, array


def _closest(call: Call) -> None:
    places, homogeneous = call.addresses(), call["homogeneous"]
    core.closest_on_curves(
        **places | {"rays": places["rays"] if call["rays"].numel() else 0},
        **call.options,
        num_points=call.sizes["num_points"],
        num_curves=len(homogeneous),
        degree=homogeneous.shape[1] - 1,
    )


closest_on_curves = Op(  # parameters and left unit normals; csrc/kernels/stokes/closest_curve.h
    "stokes_closest_on_curves",
    inputs={
        "points": array("num_points", 2),
        "homogeneous": array("num_curves", "order", 3),
        "rays": array(2, 2, optional=True),  # empty where curves end
    },
    outputs={"tau": array("num_points"), "normal": array("num_points", 2)},
    options="bool closed, float size",
    kernel=_closest,
)
