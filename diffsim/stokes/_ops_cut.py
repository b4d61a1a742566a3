"""Cut cells and fluxes through grid planes as torch custom ops.

Everything is float64 with nodes and cells flattened, the last axis fastest.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.ops import Call, Kernel, Op, array

SIZES = (1e-100, 1e100)
"""Of a level set: its slopes are squared, for which float64 has no room beyond."""


def require_squares(phi: Tensor) -> None:
    """Here rather than at the boundary, so that it is checked in compiled and mapped calls, too."""
    largest = float(phi.abs().max())
    if not (largest == 0.0 or SIZES[0] <= largest <= SIZES[1]):
        raise ValueError(
            f"phi must have values between {SIZES[0]:g} and {SIZES[1]:g} in size, where float64 "
            f"has room for their squares, got at most {largest:g}; scale it, such as to a signed "
            "distance [m]: the wall stays where it is"
        )


def _sizes(call: Call) -> dict[str, int]:
    cells = call.options["cells"]
    nodes = math.prod(n + 1 for n in cells)
    return {"num_nodes": nodes, "num_cells": math.prod(cells), "dim": len(cells)}


def _shape(call: Call) -> object:
    return core.make_grid_shape(tuple(call.options["cells"]), tuple(call.options["spacing"]))


def _run_cells(kernel: Callable[..., None]) -> Kernel:
    def run(call: Call) -> None:
        require_squares(call["phi"])
        kernel(shape=_shape(call), **call.addresses(), num_threads=call.sizes["num_threads"])

    return run


cut_cells = Op(  # csrc/kernels/stokes/cut_cells.h
    "stokes_cut_cells",
    inputs={"phi": array("num_nodes")},
    outputs={
        "volume": array("num_cells"),
        "area": array("num_cells"),
        "normal": array("num_cells", "dim"),
    },
    options="int[] cells, float[] spacing, int num_threads",
    sizes=_sizes,
    kernel=_run_cells(core.cut_cells),
    adjoint=_run_cells(core.cut_cells_vjp),
    tangent=_run_cells(core.cut_cells_jvp),
)


def _run_flux(kernel: Callable[..., None]) -> Kernel:
    def run(call: Call) -> None:
        axis, index, cells = (call.options[name] for name in ("axis", "index", "cells"))
        if not (0 <= axis < len(cells) and 0 <= index <= cells[axis]):
            raise ValueError(f"no grid plane {index} on axis {axis}")
        cases = call.sizes["cases"]
        kernel(shape=_shape(call), **call.addresses(), num_cases=cases, axis=axis, index=index)

    return run


plane_flux = Op(  # volume flow through the fluid part of a grid plane
    "stokes_plane_flux",
    inputs={"phi": array("num_nodes"), "velocity": array("cases", "num_nodes", "dim")},
    outputs={"flux": array("cases")},
    options="int[] cells, float[] spacing, int axis, int index",
    sizes=_sizes,
    kernel=_run_flux(core.plane_flux),
    adjoint=_run_flux(core.plane_flux_vjp),
    tangent=_run_flux(core.plane_flux_jvp),
)
