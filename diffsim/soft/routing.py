"""Which elements a polyline crosses, and how much of it lies in each."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from diffsim.core.arrays import Array, IntArray
from diffsim.mesh import HexMesh, TetMesh, shape_gradients
from diffsim.mesh.reference import hex_shape, hex_shape_derivatives

_INSIDE = 1e-9  # slack in local coordinates, so that a path on a face belongs to the element
_OUTSIDE = 1e-6  # share of the path that rounding may leave in no element
_SAMPLES = 33  # per segment and hexahedron, before the crossings are bisected


@dataclass(frozen=True, eq=False)
class Route:
    """Pieces of a path, ordered along it; one per element and segment."""

    elements: IntArray  # element of each piece, (num_pieces,) int64
    direction: Array  # unit vector of the piece, (num_pieces, 3) [-]
    length: Array  # its length [m]; the lengths sum to that of the path


def route(mesh: HexMesh | TetMesh, path: Array) -> Route:
    """Cut the polyline ``path`` (k, 3) [m] at the borders of the mesh's elements.

    Tetrahedra are clipped exactly; borders of hexahedra, which may be curved, are bisected to
    rounding. Where the path runs along a face or edge the adjacent elements share it equally.

    Raises:
        ValueError: part of the path lies outside the mesh.
    """
    inside = _HexLocator(mesh) if isinstance(mesh, HexMesh) else _TetLocator(mesh)
    elements, directions, lengths, outside = [], [], [], []
    for start, end in itertools.pairwise(path):
        size = float(np.linalg.norm(end - start))
        knots = _knots(inside, start, end)
        middles = 0.5 * (knots[1:] + knots[:-1])
        held = inside.contains(start + middles[:, None] * (end - start))  # (pieces, elements)
        sharing = held.sum(axis=1)
        for k in np.flatnonzero(sharing == 0):
            outside.append(((knots[k + 1] - knots[k]) * size, start + middles[k] * (end - start)))
        share = held * (np.diff(knots) * size / np.maximum(sharing, 1))[:, None]
        total = share.sum(axis=0)
        crossed = np.flatnonzero(total > _INSIDE * size)
        order = np.argsort(held[:, crossed].argmax(axis=0), kind="stable")
        elements.append(inside.candidates[crossed[order]])
        directions.append(np.tile((end - start) / size, (len(crossed), 1)))
        lengths.append(total[crossed[order]])
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    _refuse_outside(outside, length)
    pieces = np.concatenate(lengths)
    pieces *= length / pieces.sum()  # what rounding left out
    return Route(np.concatenate(elements), np.concatenate(directions), pieces)


def _refuse_outside(outside: list[tuple[float, Array]], length: float) -> None:
    lost = sum(size for size, _ in outside)
    if lost > _OUTSIDE * length:
        at = ", ".join(f"{c:.4g}" for c in max(outside, key=lambda piece: piece[0])[1])
        raise ValueError(
            f"path must lie inside the mesh at rest, but {lost:.3g} m of its {length:.3g} m "
            f"({lost / length:.1%}) lie outside, around ({at}) m; move it inwards or refine the "
            "mesh there"
        )


def _knots(inside: _HexLocator | _TetLocator, start: Array, end: Array) -> Array:
    """Ascending parameters in [0, 1] of all borders that a segment crosses."""
    inside.near(start, end)
    knots = np.sort(np.concatenate([[0.0, 1.0], inside.crossings(start, end).clip(0.0, 1.0)]))
    kept = np.concatenate([[True], np.diff(knots) > 1e-12])
    knots = knots[kept]
    knots[-1] = 1.0
    return knots


class _Locator:
    def __init__(self, mesh: HexMesh | TetMesh):
        self._x = mesh.x_rest.numpy()[mesh.elements.numpy()]
        self.near(self._x.min(axis=(0, 1)), self._x.max(axis=(0, 1)))

    def near(self, start: Array, end: Array) -> None:
        """Look only at the elements whose bounding box, slightly widened, the segment meets."""
        x = self._x
        pad = 1e-6 * (x.max(axis=(0, 1)) - x.min(axis=(0, 1))).max()
        first, last = _box_range(x.min(axis=1) - pad, x.max(axis=1) + pad, start, end)
        self.candidates = np.flatnonzero(first <= last)


class _TetLocator(_Locator):
    def __init__(self, mesh: TetMesh):
        super().__init__(mesh)
        self._grad = shape_gradients(mesh).grad[:, 0].numpy()

    def contains(self, points: Array) -> np.ndarray:
        """Which candidates hold which points (P, 3), (P, candidates) bool."""
        return self._barycentric(points).min(axis=2) >= -_INSIDE

    def crossings(self, start: Array, end: Array) -> Array:
        """Parameters at which the segment crosses a plane of a candidate's faces."""
        at = self._barycentric(np.stack([start, end]))
        slope = at[1] - at[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -at[0] / slope
        return t[np.isfinite(t) & (t > 0.0) & (t < 1.0)]

    def _barycentric(self, points: Array) -> Array:
        x, grad = self._x[self.candidates], self._grad[self.candidates]
        offset = points[:, None] - x[None, :, 0]
        result = np.einsum("pec,eac->pea", offset, grad)
        result[:, :, 0] += 1.0
        return result


class _HexLocator(_Locator):
    def contains(self, points: Array) -> np.ndarray:
        """Which candidates hold which points (P, 3), (P, candidates) bool."""
        p, e = np.indices((len(points), len(self.candidates))).reshape(2, -1)
        return self._depth(points[p], e).reshape(len(points), -1) >= -_INSIDE

    def crossings(self, start: Array, end: Array) -> Array:
        """Parameters at which the segment enters or leaves a candidate."""
        grid = np.linspace(0.0, 1.0, _SAMPLES)
        count = len(self.candidates)
        x = self._x[self.candidates]  # its box is exact for bricks along the axes
        first, last = _box_range(x.min(axis=1), x.max(axis=1), start, end)
        last = np.maximum(first, last)
        t = first[:, None] + grid * (last - first)[:, None]
        e = np.repeat(np.arange(count), _SAMPLES)
        within = self._depth(start + t.reshape(-1, 1) * (end - start), e).reshape(t.shape) >= 0.0
        row, column = np.nonzero(within[:, 1:] != within[:, :-1])
        low, high = t[row, column], t[row, column + 1]
        held = within[row, column]
        for _ in range(50):
            middle = 0.5 * (low + high)
            same = (self._depth(start + middle[:, None] * (end - start), row) >= 0.0) == held
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        return np.concatenate([first, last, 0.5 * (low + high)])

    def _depth(self, points: Array, e: IntArray) -> Array:
        """min over the six faces of the local coordinate off the face, (P,): < 0 outside."""
        x = self._x[self.candidates[e]]
        local = np.full((len(points), 3), 0.5)
        for _ in range(12):  # Newton; one iteration where the element is a parallelepiped
            residual = np.einsum("pa,pac->pc", hex_shape(local), x) - points
            jacobian = np.einsum("pac,pad->pcd", x, hex_shape_derivatives(local))
            step = np.linalg.solve(jacobian, residual[..., None])[..., 0]
            local = np.clip(local - step, -0.5, 1.5)  # the map may fold far outside the element
            if np.abs(step).max(initial=0.0) < 1e-14:
                break
        return np.minimum(local, 1.0 - local).min(axis=1)


def _box_range(low: Array, high: Array, start: Array, end: Array) -> tuple[Array, Array]:
    """Parameters in [0, 1] between which a segment is in boxes (E, 3); first > last: never."""
    step = np.where(end == start, 1e-300, end - start)
    with np.errstate(over="ignore"):
        sides = np.stack([(low - start) / step, (high - start) / step])
    return sides.min(axis=0).max(axis=1).clip(min=0.0), sides.max(axis=0).min(axis=1).clip(max=1.0)
