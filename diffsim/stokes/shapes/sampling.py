"""Level sets on grids: nodes, phi there, and the interface phi = 0 for pictures and files."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from diffsim.core.check import require, require_counts, require_number
from diffsim.core.checked import checked
from diffsim.core.numbers import anywhere, require_unmapped
from diffsim.stokes.shapes.base import LevelSet, Vector, as_shape, vector


@checked
def grid_nodes(num_cells: Sequence[int], spacing: float, origin: Vector | None = None) -> Tensor:
    """Nodes of a Cartesian grid.

    Args:
        num_cells: Cells along each of 2 or 3 axes.
        spacing: Edge of a cell [m].
        origin: Lowest corner, (d,) [m]; zero if None.

    Returns:
        (num_cells[0] + 1, ..., d) [m], indexed x, y(, z).
    """
    cells = require_counts("num_cells", num_cells, (2, 3))
    h = require_number("spacing", spacing, above=0.0)
    low = vector("origin", [0.0] * len(cells) if origin is None else origin, (len(cells),))
    axes = [h * torch.arange(n + 1, dtype=torch.float64) for n in cells]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1) + low


@checked
def sample(shape: LevelSet, nodes: Tensor) -> Tensor:
    """phi of a shape at grid nodes: > 0 in the fluid, < 0 in the solid.

    Args:
        shape: Level set, or a callable as in ``Custom``.
        nodes: Positions of the nodes, (..., d) float64 [m], as from :func:`grid_nodes`.

    Returns:
        phi (...) [m]. Gradients: the shape's parameters and the nodes.

    Raises:
        ValueError: NaN; or no node in the fluid.
    """
    phi = as_shape("shape", shape)(nodes)
    if phi.numel() and not anywhere(phi > 0):
        raise ValueError(
            "the grid is solid everywhere (phi < 0 is solid); check the fluid's side, or use "
            "Complement"
        )
    return phi


@checked
def interface(phi: Tensor, nodes: Tensor) -> tuple[Tensor, Tensor]:
    """The interface phi = 0, phi linear on triangles (2D) or tetrahedra (3D) within the cells.

    Args:
        phi: Level set at the nodes of a grid, (nx + 1, ny + 1(, nz + 1)) [m].
        nodes: Positions of the nodes, (..., d) [m], as from :func:`grid_nodes`.

    Returns:
        Points (P, d) [m] with gradient to phi, and segments (E, 2) or triangles (E, 3), int64,
        their points shared. Fluid is on the left of the segments, and in front of the triangles
        (counter-clockwise seen from the fluid). A surface that does not reach the border of the
        grid is watertight. phi = 0 counts as fluid.
    """
    d = nodes.shape[-1]
    nodes = require("nodes", nodes, ("...", d))
    phi = require("phi", phi, nodes.shape[:-1]).reshape(-1)
    require_unmapped(phi=phi, nodes=nodes)
    simplices = _simplices(nodes.shape[:-1])
    pieces = _cut(phi.detach() >= 0, simplices)
    edges, which = torch.unique(pieces.reshape(-1, 2).sort(1).values, dim=0, return_inverse=True)
    x, a, b = nodes.reshape(-1, d), phi[edges[:, :1]], phi[edges[:, 1:]]
    points = (b * x[edges[:, 0]] - a * x[edges[:, 1]]) / (b - a)
    elements = which.reshape(-1, d)
    return points, _turn_to_fluid(points.detach(), elements, pieces, x.detach(), phi.detach())


def _simplices(shape: Sequence[int]) -> Tensor:
    """Kuhn's triangles or tetrahedra of all cells, (S, d + 1) node indices."""
    d = len(shape)
    index = torch.arange(int(torch.tensor(shape).prod())).reshape(tuple(shape))
    out = []
    for order in itertools.permutations(range(d)):
        corner, path = [0] * d, [[0] * d]
        for axis in order:
            corner[axis] = 1
            path.append(list(corner))
        corners = []
        for c in path:
            where = tuple(slice(o, n - 1 + o) for o, n in zip(c, shape, strict=True))
            corners.append(index[where].reshape(-1))
        out.append(torch.stack(corners, 1))
    return torch.cat(out)


def _cut(fluid: Tensor, simplices: Tensor) -> Tensor:
    """Pieces of the interface: (E, d, 2), the grid edges whose cuts are a piece's corners."""
    inside = fluid[simplices]
    num = simplices.shape[1]
    out = [simplices.new_zeros(0, num - 1, 2)]
    for pattern in itertools.product((False, True), repeat=num):
        ins = [k for k in range(num) if pattern[k]]
        outs = [k for k in range(num) if not pattern[k]]
        if not ins or not outs:
            continue
        hit = simplices[(inside == torch.tensor(pattern)).all(1)]
        ring = [(i, j) for i in ins for j in outs]
        if len(ring) == 4:  # two and two: a quadrilateral, as two triangles
            ring[2], ring[3] = ring[3], ring[2]
            corners = [[ring[0], ring[1], ring[2]], [ring[0], ring[2], ring[3]]]
        else:
            corners = [ring]
        out.extend(hit[:, torch.tensor(c)] for c in corners)
    return torch.cat(out)


def _turn_to_fluid(
    points: Tensor, elements: Tensor, pieces: Tensor, x: Tensor, phi: Tensor
) -> Tensor:
    """Elements turned so that their fronts (left sides) face the fluid."""
    ends = pieces[:, 0]
    swap = phi[ends[:, 0]] < 0  # from solid to fluid
    start = torch.where(swap, ends[:, 0], ends[:, 1])
    end = torch.where(swap, ends[:, 1], ends[:, 0])
    to_fluid = x[end] - x[start]
    corners = points[elements]
    first = corners[:, 1] - corners[:, 0]
    if elements.shape[1] == 2:
        front = torch.stack([-first[:, 1], first[:, 0]], 1)
    else:
        front = torch.linalg.cross(first, corners[:, 2] - corners[:, 0])
    wrong = (front * to_fluid).sum(1) < 0
    return torch.where(wrong[:, None], elements.flip(1), elements)
