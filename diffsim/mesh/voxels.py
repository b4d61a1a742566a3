"""Hexahedra on a regular grid from a solid: the cells whose center is inside."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from diffsim.core.arrays import Array, IntArray
from diffsim.core.check import require_choice, require_number
from diffsim.core.checked import checked
from diffsim.core.errors import MeshError
from diffsim.mesh.box import grid_hexes
from diffsim.mesh.core import HexMesh
from diffsim.mesh.hinges import without_hinges
from diffsim.mesh.repair import remove_unreferenced_nodes

_CHUNK = 1 << 20
LONG = 10.0  # [m], of a body: longer ones are asked for their unit


@checked
def hex_from_sdf(
    sdf: Callable[[Any], Any],
    bounds: Sequence[Sequence[float]],
    spacing: float,
    keep: str = "largest",
) -> HexMesh:
    """Cubes of a regular grid whose center is inside a solid.

    Args:
        sdf: Signed distance (N, 3) -> (N,) [m], negative inside; on torch tensors or NumPy arrays.
        bounds: Lower and upper corner of the grid [m]; the grid starts at the lower corner and
            its last cells may reach beyond the upper one.
        spacing: Edge length of the cubes [m].
        keep: Parts to keep: the "largest" one that hangs together through faces, or "all". Cubes
            that hang on by a mere edge or node are dropped either way.

    Raises:
        MeshError: no center is inside.
    """
    low, counts = grid(bounds, spacing)
    ijk = np.indices(counts.tolist()).reshape(3, -1).T
    values = evaluate(sdf, low + (ijk + 0.5) * spacing)
    return hex_from_mask(values.reshape(counts.tolist()) < 0, low, spacing, keep)


def hex_from_mask(inside: np.ndarray, origin: Array, spacing: float, keep: str) -> HexMesh:
    """Cubes where ``inside`` (nx, ny, nz) is true; nodes and elements in the order of `hex_box`."""
    require_choice("keep", keep, ["largest", "all"])
    if not inside.any():
        raise MeshError(
            f"no cell center of the {' x '.join(map(str, inside.shape))} grid lies inside; make "
            f"spacing smaller than {spacing:g} m, check bounds, and that the distance is negative "
            "inside"
        )
    if keep == "largest":
        from scipy import ndimage

        labels, _ = ndimage.label(inside)  # connected through faces
        sizes = np.bincount(labels.reshape(-1))
        sizes[0] = 0
        inside = labels == sizes.argmax()
    nodes = np.indices([n + 1 for n in inside.shape]).reshape(3, -1).T
    hexes = without_hinges(grid_hexes(np.argwhere(inside), inside.shape), keep == "largest")
    x = torch.from_numpy(origin + nodes * spacing)
    return HexMesh(*remove_unreferenced_nodes(x, torch.from_numpy(hexes)))


def grid(bounds: Sequence[Sequence[float]], spacing: float) -> tuple[Array, IntArray]:
    """Lower corner (3,) [m] and number of cells (3,) of a grid that covers the bounds."""
    spacing = require_number("spacing", spacing, above=0.0)
    corners = np.array(bounds, dtype=np.float64)
    if corners.shape != (2, 3) or not np.isfinite(corners).all():
        raise ValueError(f"bounds must be two corners of three numbers [m], got {bounds}")
    extent = corners[1] - corners[0]
    if not (extent > 0).all():
        raise ValueError(f"bounds must run from the lower to the upper corner, got {bounds}")
    # 1e-9: an extent of 0.3 over a spacing of 0.1 is three cells, not four
    counts = np.maximum(np.ceil(extent / spacing - 1e-9), 1.0)
    if counts.prod() > 2e8:
        raise ValueError(
            f"spacing {spacing:g} m makes {counts.prod():.3g} cells, at most 2e8 are handled; "
            f"increase spacing{ask_for_unit(float(extent.max()))}"
        )
    return corners[0], counts.astype(np.int64)


def ask_for_unit(length: float) -> str:
    """What to say where a body is larger than robots are: most files of parts are in millimeters.

    Args:
        length: Longest side [m].
    """
    return f"; it is {length:.4g} m long: millimeters? scale=1e-3" if length > LONG else ""


def evaluate(sdf: Callable[[Any], Any], points: Array) -> Array:
    """Values of a distance callable written for torch or for NumPy, (N, 3) -> (N,) float64 [m]."""
    parts = []
    for start in range(0, len(points), _CHUNK):
        chunk = torch.from_numpy(np.ascontiguousarray(points[start : start + _CHUNK]))
        try:
            value = sdf(chunk)
        except (TypeError, AttributeError):  # written for NumPy
            value = sdf(chunk.numpy())
        value = value.detach().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)
        if value.shape != (len(chunk),):
            raise ValueError(
                f"sdf must return one value per point, ({len(chunk)},), got {value.shape}"
            )
        parts.append(value.astype(np.float64))
    out = np.concatenate(parts) if parts else np.zeros(0)
    if np.isnan(out).any():
        raise ValueError(f"sdf returned NaN at {int(np.isnan(out).sum())} points")
    return out
