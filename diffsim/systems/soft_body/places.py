"""Places of a body as a description states them: regions of nodes, points inside elements."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import torch
from pydantic import BeforeValidator, Field
from torch import Tensor

from diffsim.core.arrays import Array, IntArray, Mask
from diffsim.core.schema import Part
from diffsim.core.units import in_unit
from diffsim.mesh import HexMesh, TetMesh, surface_vertices
from diffsim.mesh.reference import hex_shape, hex_shape_derivatives

AnyMesh = HexMesh | TetMesh

INSIDE = 1e-6  # of an element: how far a point may be outside of it


def _read_vector(given: Any) -> Any:
    if isinstance(given, (list, tuple)):
        return tuple(in_unit(v, "m") for v in given)
    return given


#: A place or a shift: three numbers in meters, or texts with a unit.
Point = Annotated[tuple[float, float, float], BeforeValidator(_read_vector)]


def _parse_bound(given: Any) -> Any:
    if given is None:
        return None
    if not isinstance(given, (list, tuple)):
        return in_unit(given, "m")
    if len(given) != 2:
        raise ValueError(f"must be one number, or [low, high] with ~ for an open end, got {given}")
    return tuple(None if v is None else in_unit(v, "m") for v in given)


#: A coordinate: one number for a plane, [low, high] for a range, each may be ~ (open).
Bound = Annotated[float | tuple[float | None, float | None] | None, BeforeValidator(_parse_bound)]


class Region(Part):
    """Part of the body at rest; what is left out does not limit it."""

    x: Bound = Field(None, description="Along x [m]: a number for a plane, [low, high] for a range")
    y: Bound = Field(None, description="Along y [m], as x")
    z: Bound = Field(None, description="Along z [m], as x")
    surface: bool = Field(False, description="Only what lies on the surface")

    def nodes(self, mesh: AnyMesh) -> Tensor:
        """Indices of the nodes inside, (k,).

        Raises:
            ValueError: there is none.
        """
        inside = torch.from_numpy(self._mark_inside(mesh.x_rest.numpy(), mesh))
        if self.surface:
            outer = torch.zeros_like(inside)
            outer[surface_vertices(mesh)] = True
            inside = inside & outer
        found = torch.nonzero(inside)[:, 0]
        if not len(found):
            raise ValueError(f"no node of the body lies there; {_say_extent(mesh)}")
        return found

    def elements(self, mesh: AnyMesh) -> Tensor:
        """Indices of the elements whose center lies inside, (k,).

        Raises:
            ValueError: there is none.
        """
        center = mesh.x_rest[mesh.elements].mean(1).numpy()
        found = torch.nonzero(torch.from_numpy(self._mark_inside(center, mesh)))[:, 0]
        if not len(found):
            raise ValueError(
                f"no cell of the body has its center there; {_say_extent(mesh)}, cells are about "
                f"{_measure_cell(mesh):.3g} m long"
            )
        return found

    def _mark_inside(self, points: Array, mesh: AnyMesh) -> Mask:
        # of the largest extent: how far nodes may be off a plane
        tolerance = 1e-4 * float((mesh.x_rest.amax(0) - mesh.x_rest.amin(0)).max())
        inside = np.ones(len(points), dtype=bool)
        for axis, bound in enumerate((self.x, self.y, self.z)):
            if bound is None:
                continue
            low, high = bound if isinstance(bound, tuple) else (bound, bound)
            if low is not None:
                inside &= points[:, axis] >= low - tolerance
            if high is not None:
                inside &= points[:, axis] <= high + tolerance
        return inside


def point_weights(mesh: AnyMesh, point: Array) -> tuple[IntArray, Array]:
    """Nodes and weights with place(point) = weights @ place(nodes), by the shape functions.

    Args:
        point: Place inside, (3,) [m].

    Raises:
        ValueError: the point is outside.
    """
    cells = mesh.elements.numpy()
    x = mesh.x_rest.numpy()[cells]
    margin = 1e-3 * _measure_cell(mesh)
    near = ((x.min(1) - margin <= point) & (point <= x.max(1) + margin)).all(1)
    best, where, weights = -np.inf, 0, np.zeros(0)
    for e in np.flatnonzero(near):
        found, depth = _find_in_element(x[e], point)
        if depth > best:
            best, where, weights = depth, int(e), found
    if best < -INSIDE:
        raise ValueError(
            f"({', '.join(f'{c:.4g}' for c in point)}) m lies outside of the body; "
            f"{_say_extent(mesh)}. A marker on a stub needs carried_by, the region that holds it"
        )
    return cells[where], weights


def _find_in_element(x: Array, point: Array) -> tuple[Array, float]:
    """Weights of one element's nodes and how deep inside the point is (below 0: outside)."""
    if len(x) == 4:
        weights = np.linalg.solve(np.vstack([x.T, np.ones(4)]), np.append(point, 1.0))
        return weights, float(weights.min())
    local = np.full((1, 3), 0.5)
    for _ in range(20):
        jacobian = np.einsum("ac,ad->cd", x, hex_shape_derivatives(local)[0])
        step = np.linalg.solve(jacobian, hex_shape(local)[0] @ x - point)
        local = np.clip(local - step, -0.5, 1.5)
        if np.abs(step).max() < 1e-14:
            break
    return hex_shape(local)[0], float(np.minimum(local, 1.0 - local).min())


def carried_weights(places: Array, points: Array) -> Array:
    """Weights (num_points, n) of points that n nodes carry along by their best affine map.

    Directions in which the nodes do not spread are left out, so points should lie in their plane.

    Args:
        places: Nodes at rest, (n, 3) [m].
        points: Points, (num_points, 3) [m].
    """
    middle = places.mean(0)
    spread = np.linalg.svd(places - middle, full_matrices=False)
    kept = 1e-6 * spread.S[0] < spread.S
    along = spread.Vh[kept]
    basis = np.column_stack([np.ones(len(places)), (places - middle) @ along.T])
    at = np.column_stack([np.ones(len(points)), (points - middle) @ along.T])
    return np.asarray(at @ np.linalg.pinv(basis))


def spread_evenly(volume: Tensor, nodes: Tensor) -> Tensor:
    """(num_nodes,) shares of some nodes by the volume they stand for; they sum to 1."""
    out = torch.zeros_like(volume)
    out[nodes] = volume[nodes] / volume[nodes].sum()
    return out


def _say_extent(mesh: AnyMesh) -> str:
    low, high = mesh.x_rest.amin(0).tolist(), mesh.x_rest.amax(0).tolist()
    spans = (f"{n} {a:.4g} to {b:.4g}" for n, a, b in zip("xyz", low, high, strict=True))
    return f"it spans {', '.join(spans)} m"


def _measure_cell(mesh: AnyMesh) -> float:
    x = mesh.x_rest[mesh.elements]
    return float((x.amax(1) - x.amin(1)).mean())
