"""A finished device for the workshop and for viewers: STL, VTK, rerun scene, streamlines."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from diffsim.core.check import require_number
from diffsim.stokes.devices.device import Device, quiet
from diffsim.stokes.export import fabrication_mesh, write_stl, write_vtk
from diffsim.stokes.field import FlowField
from diffsim.viz import flow as pictures
from diffsim.viz.flow_scene import write_rerun

_DEPTH = 0.25  # of the channel of a 2D device, per longest side of its box
_FLOOR = 0.05  # thickness of the plate below it, likewise


def export(device: Device, x: Tensor, folder: str | Path, *, size: float = 0.1) -> list[Path]:
    """Write a design, for each of its states.

    * ``NAME.stl``: the solid, closed, in millimeters; a 2D device has a channel a quarter as deep
      as its box is long, and a floor.
    * ``NAME.vti``: velocity and pressure of all inlet cases, for ParaView; lengths and speeds are
      those of the simulation.
    * ``NAME_CASE.rrd``: the flow of each case, for rerun.
    * ``NAME_CASE.png``: its streamlines.

    Args:
        device: Device that was optimized.
        x: Parameters of the device, (num_parameters,) float64.
        folder: Output folder, created if it is missing.
        size: Longest side of the box in the STL file [m], without walls around it.

    Returns:
        The files.

    Raises:
        ValueError: a design that lets no fluid through.
        MeshError: a solid whose surface does not close.
        ImportError: matplotlib or rerun-sdk is not installed.

    Warns:
        UserWarning: solid parts that hang on nothing.
    """
    size = require_number("size", size, above=0.0)
    folder = Path(folder)
    written = []
    for k, state in enumerate(device.states):
        with torch.no_grad(), quiet():
            field = device.solve(x, k)
        name = device.name if len(device.states) == 1 else f"{device.name}_{state.name}"
        written.append(_solid(device, field, folder / f"{name}.stl", size))
        written.append(write_vtk(folder / f"{name}.vti", field))
        for case, title in enumerate(device.cases):
            alone = len(device.cases) == 1
            path = folder / (name if alone else f"{name}_{title.replace(' ', '_')}")
            label = ", ".join([*name.split("_"), *([] if alone else [title])])
            written.append(write_rerun(path.with_suffix(".rrd"), field, title=path.name, case=case))
            if field.grid.dim == 2:
                figure = pictures.speed_map(field, case=case, title=label)
            else:
                flat = field.grid.size[2] < 0.3 * max(field.grid.size)
                figure = pictures.view(
                    [(label, field)], case=case, elevation=50.0 if flat else 24.0
                )
            written.append(pictures.save(figure, path.with_suffix(".png")))
    return written


def _solid(device: Device, field: FlowField, path: Path, size: float) -> Path:
    longest = max(field.grid.size)
    flat = {"height": _DEPTH * longest, "floor": _FLOOR * longest}
    mesh = fabrication_mesh(
        field.grid,
        field.phi,
        openings=device.flow.boundary,
        **(flat if field.grid.dim == 2 else {}),
    )
    mesh.apply_scale(size / longest)
    return write_stl(path, mesh)
