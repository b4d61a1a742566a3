"""What of a described rod does not change with its numbers: elements, points, paths, frames."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from diffsim.core.arrays import Array

if TYPE_CHECKING:
    from diffsim.systems.rod.keys import RodKeys, RodTendon

TIP = "tip"  # name of the free end, before its mass


@dataclass(frozen=True, eq=False)
class RodShape:
    """Elements of a straight rod with a round section."""

    edges: Tensor  # (N + 1,) arc length from the base at the ends of the elements [m]
    radius: Tensor  # (N,) radius at their middles [m]
    area: Tensor  # (N,) mean area of the section [m^2]
    # (N,) harmonic mean of the section's second moment, about one axis [m^4]: what counts for
    # bending is the mean of its inverse
    inertia: Tensor

    @property
    def lengths(self) -> Tensor:
        """(N,) lengths of the elements [m]."""
        return self.edges[1:] - self.edges[:-1]

    @property
    def middles(self) -> Tensor:
        """(N,) arc length of the middles [m]."""
        return 0.5 * (self.edges[1:] + self.edges[:-1])

    @property
    def length(self) -> Tensor:
        """Length of the rod [m]."""
        return self.edges[-1]

    def element_of(self, at: float) -> int:
        """Index of the element around an arc length [m]; at an edge the one before it."""
        i = int(torch.searchsorted(self.edges, torch.tensor(at, dtype=torch.float64))) - 1
        return max(0, min(i, len(self.radius) - 1))


def rod_shape(at: Array, radius: Array, cells: int, breaks: Sequence[float]) -> RodShape:
    """A rod whose radius is linear between stations.

    Args:
        at: Arc length of the stations, from 0 on, (n,) [m].
        radius: Radius there, (n,) [m].
        cells: Number of elements, about; each part between breaks gets its share.
        breaks: Further arc lengths where elements must end, such as the end of a tendon [m].
    """
    inner = [b for b in breaks if at[0] < b < at[-1]]
    knots = np.unique(np.round([*at, *inner], 9))
    parts = [np.zeros(1)]
    for low, high in itertools.pairwise(knots):
        # two elements at least between places where something begins or ends
        count = max(2, round(cells * (high - low) / (at[-1] - at[0])))
        parts.append(np.linspace(low, high, count + 1)[1:])
    edges = np.concatenate(parts)
    middles = 0.5 * (edges[1:] + edges[:-1])
    ends = np.interp(edges, at, radius)
    middle = np.interp(middles, at, radius)

    def mean(power: float) -> Array:  # Simpson's rule
        return (ends[:-1] ** power + 4.0 * middle**power + ends[1:] ** power) / 6.0

    made = (edges, middle, np.pi * mean(2.0), 0.25 * np.pi / mean(-4.0))
    return RodShape(*(torch.from_numpy(np.ascontiguousarray(a)) for a in made))


@dataclass(frozen=True, eq=False)
class TendonPaths:
    """Where tendons run in the sections."""

    names: tuple[str, ...]
    # (num_tendons, N, 3) from the axis, in the frame of the section (along, y, z) [m]
    offset: Tensor
    slope: Tensor  # (num_tendons, N, 3) change of the offset per arc length [-]
    end: Tensor  # (num_tendons,) arc length where they are fixed [m]


@dataclass(frozen=True, eq=False)
class RodPoints:
    """Points fixed to sections: markers, and where masses sit."""

    names: tuple[str, ...]
    at: Tensor  # (P,) arc length of their section [m]
    offset: Tensor  # (P, 3) from the axis, in the frame of the section (along, y, z) [m]
    element: Tensor  # (P,) element around each


def points_on(
    shape: RodShape, names: Sequence[str], at: Sequence[float], offset: Sequence[Sequence[float]]
) -> RodPoints:
    """Points by name, arc length [m] and offset from the axis (along, y, z) [m]."""
    return RodPoints(
        tuple(names),
        torch.tensor(list(at), dtype=torch.float64),
        torch.tensor([list(o) for o in offset], dtype=torch.float64).reshape(-1, 3),
        torch.tensor([shape.element_of(a) for a in at], dtype=torch.int64),
    )


@dataclass(frozen=True, eq=False)
class RodLayout:
    """Constants of a rod on one set of elements."""

    shape: RodShape
    paths: TendonPaths  # where tendons run
    markers: RodPoints  # points that are seen
    masses: RodPoints  # points that may weigh something: stated masses, markers and the tip
    base: Tensor  # (3, 3) columns along, y and z of the first section
    place: Tensor  # (3,) of the base [m]
    gravity: Tensor  # (3,) acceleration of free fall [m/s^2]
    columns: Tensor  # (num_channels,) of each channel among 3 coordinates of each marker


def layout_of(given: RodKeys, channels: Sequence[str], finer: float) -> RodLayout:
    """Cut a described rod into elements.

    Args:
        channels: Names of the channels, in the order of the study.
        finer: Factor on the number of elements.
    """
    at = np.array([s.at for s in given.stations])
    radius = np.array([s.radius for s in given.stations])
    breaks = [p.at for t in given.tendons for p in t.path]
    shape = rod_shape(at, radius, max(4, round(given.numerics.cells * finer)), breaks)
    seen = {name: (m.at, m.offset) for name, m in given.markers.items()}
    heavy = {m.name: (m.at, m.offset) for m in given.masses} | seen
    heavy[TIP] = (float(at[-1]), (0.0, 0.0, 0.0))
    along = np.array(given.base.along) / np.linalg.norm(given.base.along)
    across = np.array(given.base.across) / np.linalg.norm(given.base.across)
    frame = np.stack([along, across, np.cross(along, across)], 1)
    columns = []
    for channel in channels:
        reading = given.reading(channel)
        assert reading is not None
        columns.append(3 * list(seen).index(reading.marker) + "xyz".index(reading.axis))

    def points(chosen: dict[str, tuple[float, tuple[float, float, float]]]) -> RodPoints:
        places = list(chosen.values())
        return points_on(shape, list(chosen), [p[0] for p in places], [p[1] for p in places])

    return RodLayout(
        shape=shape,
        paths=_lay_paths(given.tendons, shape),
        markers=points(seen),
        masses=points(heavy),
        base=torch.from_numpy(frame),
        place=torch.tensor(given.base.place, dtype=torch.float64),
        gravity=torch.tensor(given.gravity, dtype=torch.float64),
        columns=torch.tensor(columns, dtype=torch.int64),
    )


def _lay_paths(tendons: Sequence[RodTendon], shape: RodShape) -> TendonPaths:
    middles = shape.middles.numpy()
    offset = np.zeros((len(tendons), len(middles), 3))
    slope = np.zeros_like(offset)
    for k, tendon in enumerate(tendons):
        at = np.array([p.at for p in tendon.path])
        polar = [(np.cos(p.angle), np.sin(p.angle)) for p in tendon.path]
        across = np.array([p.distance for p in tendon.path])[:, None] * np.array(polar)
        offset[k, :, 1:], slope[k, :, 1:] = _interpolate_line(at, across, middles)
    end = torch.tensor([t.path[-1].at for t in tendons], dtype=torch.float64)
    names = tuple(t.name for t in tendons)
    return TendonPaths(names, torch.from_numpy(offset), torch.from_numpy(slope), end)


def _interpolate_line(at: Array, points: Array, where: Array) -> tuple[Array, Array]:
    """Places and slopes of a broken line; beyond its end it goes on straight."""
    piece = np.clip(np.searchsorted(at, where) - 1, 0, len(at) - 2)
    rate = (points[piece + 1] - points[piece]) / (at[piece + 1] - at[piece])[:, None]
    return points[piece] + rate * (where - at[piece])[:, None], rate
