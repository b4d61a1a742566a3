"""Mend arrays that `HexMesh` or `TetMesh` refuses: each function returns new ``(x, elements)``.

They work on positions (V, 3) [m] and node indices (E, 8) or (E, 4); the width tells the kind.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffsim.core.arrays import IntArray
from diffsim.core.check import require, require_number
from diffsim.core.numbers import to_numpy, values_of
from diffsim.mesh.components import connected_parts
from diffsim.mesh.core import HexMesh, TetMesh
from diffsim.mesh.reference import HEX_MIRROR
from diffsim.mesh.validate import (
    COINCIDENT,
    DEGENERATE,
    bounding_diagonal,
    relative_tet_volume,
    smallest_hex_jacobian,
)

MAX_PLACE = 1e100  # squares of distances must be numbers [m]


def merge_duplicate_nodes(
    x: Tensor, elements: Tensor, tol: float | None = None
) -> tuple[Tensor, Tensor]:
    """Make one node of nodes that are at most ``tol`` apart (the one with the lowest index).

    Args:
        x: Node positions, (V, 3) float64 [m].
        elements: Node indices, (E, 8) or (E, 4) int64.
        tol: Distance [m]; 1e-9 of the diagonal of the bounding box when not given.

    Returns:
        Positions without the merged nodes, and elements that use what is left.
    """
    x, elements = _arrays(x, elements)
    points = to_numpy("x", x)
    if tol is not None:
        tol = require_number("tol", tol, at_least=0.0)
    else:
        tol = COINCIDENT * bounding_diagonal(points)
    from scipy.spatial import cKDTree

    pairs = cKDTree(points).query_pairs(tol, output_type="ndarray")
    group = connected_parts(len(x), pairs[:, 0], pairs[:, 1])
    _, first, inverse = np.unique(group, return_index=True, return_inverse=True)
    keep = np.sort(first)
    new_idx = np.searchsorted(keep, first)[inverse]
    return x[torch.from_numpy(keep)], torch.from_numpy(new_idx.astype(np.int64))[elements]


def remove_unreferenced_nodes(x: Tensor, elements: Tensor) -> tuple[Tensor, Tensor]:
    """Drop nodes that belong to no element; the others keep their order."""
    x, elements = _arrays(x, elements)
    used = torch.zeros(len(x), dtype=torch.bool)
    used[elements.flatten()] = True
    new_idx = torch.cumsum(used, dim=0) - 1
    return x[used], new_idx[elements]


def remove_degenerate(x: Tensor, elements: Tensor) -> tuple[Tensor, Tensor]:
    """Drop elements that repeat a node or are flat, then nodes that nothing uses any more.

    Elements that are only mirrored stay: `flip_inverted` mends those.
    """
    x, elements = _arrays(x, elements)
    ordered = elements.sort(dim=1).values
    elements = elements[(ordered[:, 1:] != ordered[:, :-1]).all(dim=1)]
    good = torch.from_numpy(np.maximum(*_both_ways(x, elements)) > DEGENERATE)
    return remove_unreferenced_nodes(x, elements[good])


def flip_inverted(x: Tensor, elements: Tensor) -> tuple[Tensor, Tensor]:
    """Renumber mirrored elements so that their volume is positive; geometry is unchanged."""
    x, elements = _arrays(x, elements)
    as_is, mirrored = _both_ways(x, elements)
    flip = torch.from_numpy((as_is <= DEGENERATE) & (mirrored > DEGENERATE))
    elements = elements.clone()
    elements[flip] = elements[flip][:, torch.from_numpy(_mirror(elements.shape[1]))]
    return x, elements


def repair(x: Tensor, elements: Tensor) -> HexMesh | TetMesh:
    """All of the above in turn, then the checked mesh.

    Raises:
        MeshError: what is left is still no mesh (tangled elements, none left).
    """
    x, elements = merge_duplicate_nodes(x, elements)
    x, elements = remove_degenerate(x, elements)
    x, elements = flip_inverted(x, elements)
    return HexMesh(x, elements) if elements.shape[1] == 8 else TetMesh(x, elements)


def _arrays(x: Tensor, elements: Tensor) -> tuple[Tensor, Tensor]:
    x = require("x", x, ("num_vertices", 3), torch.float64)
    if x.numel():
        require_number("x", float(values_of(x).abs().max()), at_most=MAX_PLACE, hint="unit is m")
    elements = require("elements", elements, ("num_elements", "8 or 4"), torch.int64)
    if elements.shape[1] not in (4, 8):
        raise ValueError(
            f"elements must have 8 (hex) or 4 (tet) columns, got {tuple(elements.shape)}"
        )
    if elements.numel() and (int(elements.min()) < 0 or int(elements.max()) >= len(x)):
        raise ValueError(
            f"elements must hold indices of x in [0, {len(x)}), got "
            f"[{int(elements.min())}, {int(elements.max())}]; check that numbering starts at 0"
        )
    return x, elements


def _mirror(width: int) -> IntArray:
    return HEX_MIRROR if width == 8 else np.array([0, 1, 3, 2], np.int64)


def _both_ways(x: Tensor, elements: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Relative Jacobian or volume of each element as given and mirrored."""
    measure = smallest_hex_jacobian if elements.shape[1] == 8 else relative_tet_volume
    points, idx = to_numpy("x", x), to_numpy("elements", elements)
    return measure(points, idx), measure(points, idx[:, _mirror(idx.shape[1])])
