"""A rod in space: its skin where it is simulated, its markers where they were measured."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from torch import Tensor

from diffsim.core.arrays import Array, IntArray
from diffsim.identify.shape import MovingShape
from diffsim.systems.rod.layout import RodLayout

_SIDES = 12  # of a section
_BULGE, _STUD = 1.25, 0.35  # radius of a marker in the axis and on the skin, in radii of the rod


def skin_of(layout: RodLayout, frames: Tensor, places: Tensor, thicker: float) -> MovingShape:
    """The rod as it is simulated, one closed tube.

    Args:
        layout: What does not change with a number.
        frames: Of the sections at the ends of the elements, (num_samples, N + 1, 3, 3).
        places: Their places, (num_samples, N + 1, 3) [m].
        thicker: Added to the radius [m].
    """
    radius = _average_radius(layout) + thicker
    angle = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    ring = np.stack([0.0 * angle, np.cos(angle), np.sin(angle)], 1)
    across = np.einsum("sekl,il->seik", frames.numpy(), ring)
    skin = places.numpy()[:, :, None] + radius[:, None, None] * across
    ends = places.numpy()[:, [0, -1]]
    nodes = np.concatenate([skin.reshape(len(skin), -1, 3), ends], 1)
    return MovingShape(
        triangles=_build_tube(len(radius)),
        nodes_m=nodes @ _find_upright(layout).T,
        closed=True,
    )


def dots_of(layout: RodLayout, channels: Tensor) -> MovingShape | None:
    """Markers of which channels show all three coordinates.

    Args:
        layout: Constants of the rod.
        channels: Measured or predicted, (num_samples, num_channels) [m].

    Returns:
        None where no marker is known in space.
    """
    column = {int(c): i for i, c in enumerate(layout.columns)}
    markers = layout.markers
    known = [m for m in range(len(markers.names)) if all(3 * m + k in column for k in range(3))]
    if not known:
        return None
    places = channels[:, [[column[3 * m + k] for k in range(3)] for m in known]].numpy()
    radius = layout.shape.radius[markers.element[known]].numpy()
    beside = markers.offset[known].norm(dim=-1).numpy()
    size = np.maximum(_STUD * radius, _BULGE * radius - beside)
    return MovingShape.of_balls(places @ _find_upright(layout).T, size)


def _average_radius(layout: RodLayout) -> Array:
    shape = layout.shape
    at, radius = shape.middles.numpy(), shape.radius.numpy()
    slope = np.diff(radius)[[0, -1]] / np.diff(at)[[0, -1]]
    edges = shape.edges.numpy()
    out = np.interp(edges, at, radius)
    out[[0, -1]] += slope * (edges[[0, -1]] - at[[0, -1]])
    return np.maximum(out, 0.0)


def _build_tube(count: int) -> IntArray:
    """Triangles of rings one behind the other, then the middles of both ends."""
    here = np.arange(_SIDES)
    beside = (here + 1) % _SIDES
    pieces = []
    for k in range(count - 1):
        a, b = k * _SIDES + here, k * _SIDES + beside
        pieces += [np.stack([a, b, b + _SIDES], 1), np.stack([a, b + _SIDES, a + _SIDES], 1)]
    base, tip, last = count * _SIDES, count * _SIDES + 1, (count - 1) * _SIDES
    pieces.append(np.stack([np.full(_SIDES, base), beside, here], 1))
    pieces.append(np.stack([np.full(_SIDES, tip), last + here, last + beside], 1))
    return np.concatenate(pieces)


def _find_upright(layout: RodLayout) -> Array:
    """From the recorded frame to one in which gravity points down, (3, 3)."""
    down = layout.gravity.numpy()
    if not down.any() or (np.allclose(down[:2], 0.0) and down[2] < 0.0):
        return np.eye(3)
    return Rotation.align_vectors([[0.0, 0.0, -1.0]], [down])[0].as_matrix()
