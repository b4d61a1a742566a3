"""Watertight surfaces of the solid part of a flow device, to print or to mill."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from diffsim.core.arrays import Array, Mask
from diffsim.core.check import require, require_number
from diffsim.core.errors import MeshError
from diffsim.core.record import warn
from diffsim.stokes.boundary import Boundary
from diffsim.stokes.cells import cut_cells
from diffsim.stokes.grid import Grid
from diffsim.stokes.isosurface import negative_part, wall
from diffsim.stokes.printing import FabricationReport, fabrication_report

if TYPE_CHECKING:
    import trimesh


_SKIN = 0.02  # thickness of the layer in which a closed face turns from fluid to solid [cells]
_MISMATCH = 0.1  # of the fluid's volume between surface and cells, above which to warn [-]


def fabrication_mesh(
    grid: Grid,
    phi: Tensor,
    *,
    wall_thickness: float | None = None,
    openings: Boundary | Sequence[str] | None = None,
    margin: float | None = None,
    height: float | None = None,
    floor: float = 0.0,
    lid: float = 0.0,
) -> trimesh.Trimesh:
    """Surface of the solid part of a device: its block without the channel, or a shell around it.

    The channel is open where fluid meets an opening of the box; elsewhere the box's faces are
    walls, and material is added outside of them. A 2D design is extruded along z from 0 to
    ``height``.

    Args:
        phi: Level set at the nodes, (*node_shape,) float64, > 0 in the fluid [m].
        wall_thickness: None: the whole box but the fluid. Otherwise only the solid within this
            distance of the fluid [m], at least two cells; it reaches beyond the box where no
            channel leaves it.
        openings: Faces through which the channel leaves the box ("x-", ...), or the flow's
            ``boundary``: its inlets and open faces. None: wherever fluid meets the box. A slip
            face is closed: mirror a symmetric design before.
        margin: Least material outside of a closed face [m]; default four cells. A shell has its
            thickness there.
        height: Height of the channel of a 2D design [m]; required there.
        floor: Thickness of a plate below a 2D design [m]; 0 leaves the channel open below.
        lid: Thickness of the lid above the channel [m]; 0: open.

    Returns:
        Closed surface [m], outward normals. Fluid volumes of surface and cut cells agree to
        second order in the cell size.

    Raises:
        TypeError, ValueError: wrong shapes or faces, no fluid, no solid, too thin a shell.
        MeshError: the surface does not close (openings that touch in a single edge).

    Warns:
        UserWarning: loose parts (islands) and closed cavities, with count and volume; a shape that
            is thinner than a cell.
    """
    import trimesh

    phi = require("phi", phi.detach() if isinstance(phi, Tensor) else phi, grid.node_shape)
    values = phi.numpy()
    _check_two_phases(values)
    coords = _coords(grid)
    cell = max(grid.spacing)
    shell = wall_thickness is not None
    if wall_thickness is not None:
        margin = require_number("wall_thickness", wall_thickness, at_least=2.0 * cell,
                                hint="a shell needs two cells")  # fmt: skip
    else:
        margin = require_number("margin", 4.0 * cell if margin is None else margin, above=0.0)
    height = _check_height(grid, height, floor, lid)
    _warn_if_thin(grid, phi)
    values = values / _slope(grid, values)
    masks = _open_nodes(grid, values, openings)
    for axis in range(grid.dim):
        for side in (0, 1):
            if _needs_wall(
                masks[2 * axis + side], np.take(values, -side, axis=axis), margin, shell
            ):
                layers = math.ceil(margin / cell) + 1 if shell else 1
                step = cell if shell else margin
                coords, values, masks = _pad(
                    coords,
                    values,
                    masks,
                    axis,
                    side,
                    [_SKIN * cell, *step * np.arange(1, layers + 1)],
                )
    coords, values = _extrude_grid(coords, values, cell)
    level = values
    if shell:
        level = _shell(coords, values, margin)
    if grid.dim == 2:
        coords[2] = np.array([0.0, height])
        for side, thickness in ((0, floor), (1, lid)):
            if thickness > 0.0:
                plate = np.where(values[..., 0] > 0.0, -np.abs(values[..., 0]), level[..., 0])
                skin = min(_SKIN * cell, 0.5 * thickness)
                level = _stack(level, [plate, plate], side)
                coords[2] = _extend(coords[2], [skin, thickness], side)
    vertices, faces = negative_part(coords, level)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    report = fabrication_report(mesh)
    if not report.is_watertight:
        raise MeshError("the solid's surface does not close: its parts touch in single edges; "
                        "refine the grid, or move the openings apart")  # fmt: skip
    _warn_of_parts(report, grid.dim)
    return mesh


def channel_mesh(grid: Grid, phi: Tensor, *, height: float | None = None) -> trimesh.Trimesh:
    """Closed surface of the fluid within the box: a casting core, or the domain of another solver.

    Args:
        phi: Level set at the nodes, (*node_shape,) float64, > 0 in the fluid.
        height: Height of the extrusion of a 2D design [m]; required there.

    Raises:
        TypeError, ValueError: wrong shapes, no fluid at all.
    """
    import trimesh

    phi = require("phi", phi.detach() if isinstance(phi, Tensor) else phi, grid.node_shape)
    values = phi.numpy()
    if not (values > 0.0).any():
        raise ValueError("phi must be positive somewhere: the box is solid everywhere")
    height = _check_height(grid, height, 0.0, 0.0)
    coords, values = _extrude_grid(_coords(grid), values, height)
    vertices, faces = negative_part(coords, -values)
    return trimesh.Trimesh(vertices, faces, process=False)


def wall_mesh(grid: Grid, phi: Tensor, *, height: float | None = None) -> trimesh.Trimesh:
    """The wall phi = 0 alone, an open surface for pictures; arguments as for ``channel_mesh``."""
    import trimesh

    phi = require("phi", phi.detach() if isinstance(phi, Tensor) else phi, grid.node_shape)
    values = phi.numpy()
    height = _check_height(grid, height, 0.0, 0.0)
    coords, values = _extrude_grid(_coords(grid), values, height)
    vertices, faces = wall(coords, values)
    return trimesh.Trimesh(vertices, faces, process=False)


def _coords(grid: Grid) -> list[Array]:
    axes = zip(grid.origin, grid.spacing, grid.node_shape, strict=True)
    return [o + h * np.arange(n, dtype=np.float64) for o, h, n in axes]


def _extrude_grid(coords: list[Array], values: Array, height: float) -> tuple[list[Array], Array]:
    """Three axes: those of a 2D grid get z from 0 to ``height``."""
    if len(coords) == 3:
        return coords, values
    return [*coords, np.array([0.0, height])], np.repeat(values[..., None], 2, axis=-1)


def _check_two_phases(values: Array) -> None:
    if not (values > 0.0).any():
        raise ValueError("phi must be positive somewhere: the box is solid everywhere")
    if not (values < 0.0).any():
        raise ValueError("phi must be negative somewhere: the box is fluid everywhere")


def _check_height(grid: Grid, height: float | None, floor: float, lid: float) -> float:
    require_number("floor", floor, at_least=0.0)
    require_number("lid", lid, at_least=0.0)
    if grid.dim == 3:
        if height is not None or floor or lid:
            raise ValueError("height, floor and lid are for 2D designs; this grid has three axes")
        return 0.0
    if height is None:
        raise ValueError("height must be given for a 2D design: the depth of the channel [m]")
    return require_number("height", height, above=0.0)


def _slope(grid: Grid, values: Array) -> float:
    """Median slope of the level set across the wall [-]: what makes it a distance there."""
    slopes = []
    for axis, h in enumerate(grid.spacing):
        low = np.take(values, range(grid.shape[axis]), axis=axis)
        step = np.diff(values, axis=axis)
        slopes.append(np.abs(step[(low > 0.0) != (low + step > 0.0)]) / h)
    return max(float(np.median(np.concatenate(slopes))), np.finfo(float).tiny)


def _open_nodes(grid: Grid, values: Array, openings: Boundary | Sequence[str] | None) -> list[Mask]:
    """For every face of the box, at which of its nodes the channel may leave."""
    faces = grid.faces
    if isinstance(openings, str) or not isinstance(openings, (Boundary, Sequence, type(None))):
        raise TypeError(
            f"openings must be a Boundary or a list of faces, got {type(openings).__name__}"
        )
    if openings is None:
        openings = list(faces)
    named = openings.open_faces if isinstance(openings, Boundary) else openings
    for face in named:
        grid.face_axis(face)  # refuses unknown faces
    if isinstance(openings, Boundary) and openings.grid.node_shape != grid.node_shape:
        raise ValueError("openings was made for another grid")
    masks = []
    for face in faces:
        axis, side = grid.face_axis(face)
        own = np.full(grid.num_nodes, face in named)
        if isinstance(openings, Boundary):
            for nodes in openings.inlets.values():
                if bool(torch.isin(nodes, grid.face_nodes(face)).all()):  # not another face's edge
                    own[nodes.numpy()] = True
        masks.append(np.take(own.reshape(grid.node_shape), -side, axis=axis))
    if not any((mask & (np.take(values, -(k % 2), axis=k // 2) > 0)).any()
               for k, mask in enumerate(masks)):  # fmt: skip
        raise ValueError("openings touch no fluid: the channel would be closed")
    return masks


def _needs_wall(mask: Mask, face: Array, margin: float, shell: bool) -> bool:
    """Whether material must be added outside of a face with these openings and level set."""
    fluid = face > 0.0
    if shell and not fluid.any():
        return True
    if mask.all() or (fluid.any() and mask[fluid].all()):
        return False
    return shell or bool((~mask & (face > -margin)).any())


def _pad(
    coords: list[Array],
    values: Array,
    masks: list[Mask],
    axis: int,
    side: int,
    steps: list[float],
) -> tuple[list[Array], Array, list[Mask]]:
    """Layers outside of a face: solid, but for the channel at open nodes, which runs on."""
    face = np.take(values, -side, axis=axis)
    beyond = np.where(masks[2 * axis + side], face, -np.abs(face))
    values = np.moveaxis(
        _stack(np.moveaxis(values, axis, -1), [beyond] * len(steps), side), -1, axis
    )
    coords = list(coords)
    coords[axis] = _extend(coords[axis], steps, side)
    masks = list(masks)
    for k, mask in enumerate(masks):
        other = k // 2
        if other == axis:
            continue
        at = axis if axis < other else axis - 1
        width = [(0, 0)] * mask.ndim
        width[at] = (0, len(steps)) if side else (len(steps), 0)
        whole = bool(mask.all())  # an open face stays open over the new layers
        masks[k] = np.pad(mask, width, constant_values=whole)
    return coords, values, masks


def _stack(values: Array, layers: list[Array], side: int) -> Array:
    """Layers, the nearest first, before or behind the last axis."""
    extra = np.stack(layers if side else layers[::-1], axis=-1)
    return np.concatenate([values, extra] if side else [extra, values], axis=-1)


def _extend(coords: Array, steps: Sequence[float], side: int) -> Array:
    extra = np.asarray(steps)
    return np.concatenate(
        [coords, coords[-1] + extra] if side else [coords[0] - extra[::-1], coords]
    )


def _shell(coords: list[Array], values: Array, thickness: float) -> Array:
    """Level set that is negative in the solid within ``thickness`` of the fluid.

    Next to the fluid it is phi (the channel's wall does not move), elsewhere distance - thickness.
    """
    import trimesh

    fluid = values > 0.0
    near = ndimage.binary_dilation(fluid, np.ones((3, 3, 3)))
    vertices, faces = wall(coords, values)
    triangles = vertices[faces]
    level = np.where(fluid, values, thickness)
    nodes = np.stack(np.meshgrid(*coords, indexing="ij"), axis=-1)[~near]
    tree = cKDTree(triangles.mean(1))
    reach = np.linalg.norm(triangles - triangles.mean(1)[:, None], axis=-1).max()
    diagonal = np.linalg.norm([np.diff(c).max() for c in coords])
    rough, _ = tree.query(nodes, distance_upper_bound=thickness + diagonal + reach)
    distance = rough.copy()  # to centroids: enough but for nodes next to the shell's outside
    close = np.flatnonzero((rough > thickness - diagonal) & np.isfinite(rough))
    if len(close):
        _, index = tree.query(nodes[close], k=min(8, len(triangles)))
        for candidate in np.atleast_2d(index.T):
            foot = trimesh.triangles.closest_point(triangles[candidate], nodes[close])
            gap = np.linalg.norm(foot - nodes[close], axis=-1)
            distance[close] = np.minimum(distance[close], gap)
    level[~near] = np.minimum(distance - thickness, thickness)
    level[near & ~fluid] = values[near & ~fluid]
    return level


def _warn_if_thin(grid: Grid, phi: Tensor) -> None:
    channel = channel_mesh(grid, phi, height=1.0 if grid.dim == 2 else None).volume
    cells = float(cut_cells(grid, phi).volume.sum())
    if abs(channel - cells) > _MISMATCH * max(cells, channel):
        warn(
            f"the fluid has {channel:.3g} m^{grid.dim} within the surface and {cells:.3g} in the "
            "cells: parts are thinner than a cell; refine the grid, or thicken the shape",
            stacklevel=3,
        )


def _warn_of_parts(report: FabricationReport, dim: int) -> None:
    if report.num_parts > 1:
        hint = "give floor= or lid= to hold them" if dim == 2 else "connect them to the rest"
        warn(
            f"{report.num_parts - 1} of {report.num_parts} solid parts are loose, "
            f"{report.loose_volume:.3g} of {report.volume:.3g} m^3; {hint}",
            stacklevel=3,
        )
    if report.cavity_volumes:
        warn(
            f"{len(report.cavity_volumes)} cavities have no way out, "
            f"{sum(report.cavity_volumes):.3g} m^3; what fills them in fabrication stays there",
            stacklevel=3,
        )
