"""A rod at rest, cut into short elements: arc lengths, sections, points on it, paths of tendons."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
FEWEST = 2  # elements between two places where something begins or ends


@dataclass(frozen=True, eq=False)
class RodShape:
    """Elements of a straight rod with a round section.

    Attributes:
        edges: (N + 1,) arc length from the base at the ends of the elements [m].
        radius: (N,) radius at their middles [m].
        area: (N,) mean area of the section [m^2].
        inertia: (N,) harmonic mean of the section's second moment, about one axis [m^4]: what
            counts for bending is the mean of its inverse.
    """

    edges: Tensor
    radius: Tensor
    area: Tensor
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
        count = max(FEWEST, round(cells * (high - low) / (at[-1] - at[0])))
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
    """Where tendons run in the sections.

    Attributes:
        names: Names of the tendons.
        offset: (num_tendons, N, 3) from the axis, in the frame of the section (along, y, z) [m].
        slope: (num_tendons, N, 3) change of the offset per arc length [-].
        end: (num_tendons,) arc length where they are fixed [m].
    """

    names: tuple[str, ...]
    offset: Tensor
    slope: Tensor
    end: Tensor


@dataclass(frozen=True, eq=False)
class RodPoints:
    """Points fixed to sections: markers, and where masses sit.

    Attributes:
        names: Names of the points.
        at: (P,) arc length of their section [m].
        offset: (P, 3) from the axis, in the frame of the section (along, y, z) [m].
        element: (P,) element around each.
    """

    names: tuple[str, ...]
    at: Tensor
    offset: Tensor
    element: Tensor


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


__all__ = ["RodPoints", "RodShape", "TendonPaths", "points_on", "rod_shape"]
