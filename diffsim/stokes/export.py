"""What leaves the simulation: solids to fabricate (.stl) and fields to look at (.vti, .vtu).

Rerun scenes (.rrd) are in ``diffsim.viz.flow_scene``, pictures in ``diffsim.viz.flow``.
"""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import meshio
import numpy as np
from numpy.typing import NDArray

from diffsim.core.check import require_shape
from diffsim.core.files import replacing, write_text_atomic
from diffsim.core.numbers import to_numpy
from diffsim.stokes.fabrication import channel_mesh, fabrication_mesh, wall_mesh
from diffsim.stokes.field import FlowField
from diffsim.stokes.printing import FabricationReport, fabrication_report, write_stl


def write_vtk(path: str | Path, field: FlowField) -> Path:
    """Write all cases of a flow; the file appears whole or not at all.

    At the nodes "velocity" [m/s] and "phi", in the cells "pressure" [Pa] and "volume_fraction" [-];
    with several cases "velocity_0", "velocity_1", ... Two dimensions lie in the plane z = 0. In
    ParaView, a contour of phi at 0 is the wall, a clip by it the fluid.

    Args:
        path: File name; .vti or .vtu chooses the format, folders are made.

    Returns:
        The path.
    """
    path = Path(path)
    if not isinstance(field, FlowField):
        raise TypeError(f"field must be a FlowField, got {type(field).__name__}")
    suffix = path.suffix.lower()
    if suffix == ".vti":
        return write_text_atomic(path, _image(field))
    if suffix == ".vtu":
        return _cells(path, field)
    raise ValueError(f"path must end in .vti or .vtu, got {path.name!r}")


def _data(field: FlowField) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
    """Node and cell arrays by name, grid axes first."""
    shape, cases = field.grid.shape, len(field.velocity)
    require_shape("field.pressure", field.pressure, (cases, *shape))
    require_shape("field.volume_fraction", field.volume_fraction, shape)
    phi, fraction, velocities, pressures = (
        to_numpy(f"field.{name}", getattr(field, name))
        for name in ("phi", "volume_fraction", "velocity", "pressure")
    )
    nodes, cells = {"phi": phi}, {"volume_fraction": fraction}
    for k in range(cases):
        end = f"_{k}" if cases > 1 else ""
        velocity = velocities[k]
        flat = [(0, 0)] * (velocity.ndim - 1)
        nodes["velocity" + end] = np.pad(velocity, [*flat, (0, 3 - field.grid.dim)])
        cells["pressure" + end] = pressures[k]
    return nodes, cells


def _image(field: FlowField) -> str:
    grid = field.grid
    flat = 3 - grid.dim
    extent = " ".join(f"0 {n}" for n in (*grid.shape, *[0] * flat))
    origin = " ".join(map(repr, (*grid.origin, *[0.0] * flat)))
    spacing = " ".join(map(repr, (*grid.spacing, *[min(grid.spacing)] * flat)))
    nodes, cells = _data(field)
    return "\n".join(
        [
            '<?xml version="1.0"?>',
            '<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" '
            'header_type="UInt64">',
            f'<ImageData WholeExtent="{extent}" Origin="{origin}" Spacing="{spacing}">',
            f'<Piece Extent="{extent}">',
            "<PointData>",
            *(_array(name, values, grid.dim) for name, values in nodes.items()),
            "</PointData>",
            "<CellData>",
            *(_array(name, values, grid.dim) for name, values in cells.items()),
            "</CellData>",
            "</Piece>",
            "</ImageData>",
            "</VTKFile>",
            "",
        ]
    )


def _array(name: str, values: NDArray[Any], dim: int) -> str:
    """One array, inline: its length in bytes, then its numbers with x running fastest."""
    components = 1 if values.ndim == dim else values.shape[-1]
    ordered = values.transpose(*reversed(range(dim)), *range(dim, values.ndim))
    content = np.ascontiguousarray(ordered, dtype="<f8").tobytes()
    text = base64.b64encode(np.uint64(len(content)).tobytes() + content).decode("ascii")
    return (
        f'<DataArray type="Float64" Name={quoteattr(name)} NumberOfComponents="{components}" '
        f'format="binary">{text}</DataArray>'
    )


def _cells(path: Path, field: FlowField) -> Path:
    grid = field.grid
    points = grid.nodes.reshape(-1, grid.dim).numpy()
    points = np.pad(points, [(0, 0), (0, 3 - grid.dim)])
    index = np.arange(grid.num_nodes).reshape(grid.node_shape)
    square = [(0, 0), (1, 0), (1, 1), (0, 1)]
    corners = square if grid.dim == 2 else [(*c, k) for k in (0, 1) for c in square]
    elements = np.stack(
        [
            index[tuple(slice(b, n + b) for b, n in zip(c, grid.shape, strict=True))].ravel()
            for c in corners
        ],
        axis=-1,
    )
    nodes, cells = _data(field)
    content = meshio.Mesh(
        points,
        [("quad" if grid.dim == 2 else "hexahedron", elements)],
        point_data={k: v.reshape(grid.num_nodes, *v.shape[grid.dim :]) for k, v in nodes.items()},
        cell_data={k: [v.reshape(-1)] for k, v in cells.items()},
    )
    with replacing(path, ".vtu") as partial:
        content.write(partial, file_format="vtu")
    return path


__all__ = [
    "FabricationReport",
    "channel_mesh",
    "fabrication_mesh",
    "fabrication_report",
    "wall_mesh",
    "write_stl",
    "write_vtk",
]
