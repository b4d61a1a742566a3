"""Geometry of a plane network of straight channels between junctions, as a level set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.core.check import require_choice, require_number
from diffsim.core.checked import checked, checked_methods

MIN_CELLS_ACROSS = 2.0
"""Fewer cells across a channel, and the flow in it means nothing."""


class Segment(NamedTuple):
    """A channel by the names of its ends and its width [m]."""

    name: str
    start: str
    end: str
    width: float


@checked_methods
@checked
@dataclass(frozen=True, kw_only=True)
class NetworkDevice:
    """Channels in a box: one inlet from its left face, outlets on its right one.

    Channels that lie askew in the grid let their walls pass its nodes one after the other, so that
    flows depend on wall positions more smoothly than in channels along the grid.

    Attributes:
        nodes: Positions (x, y) of the channels' ends by name [m].
        segments: The channels; the first is the inlet.
        outlets: Nodes on the right face, in the order of the flow meters.
        tap: Where on the inlet channel a second pressure is read, as a share of the way from its
            start, where the first is read, to its end.
        size: Size of the box along x and y [m].
        cells: Number of grid cells along x and y.
        depth: Out of the plane [m]; plane flows times the depth are flows.
        viscosity: Nominal viscosity of the fluid [Pa s].
        shear_rate: Shear rate beyond which the fluid thins [1/s].
        density: Density of the fluid [kg/m^3].
        throat: Share of a branch's length over which something may lodge in it, a raised cosine.
    """

    nodes: dict[str, tuple[float, float]]
    segments: tuple[Segment, ...]
    outlets: tuple[str, ...]
    tap: float
    size: tuple[float, float]
    cells: tuple[int, int]
    depth: float
    viscosity: float
    shear_rate: float
    density: float = 1000.0
    throat: float = 0.5

    def __post_init__(self) -> None:
        for name in ("depth", "viscosity", "shear_rate", "density"):
            require_number(name, getattr(self, name), above=0.0)
        for segment in self.segments:
            for end in (segment.start, segment.end):
                require_choice(f"segment {segment.name}: end", end, self.nodes)
        for name in self.outlets:
            if len([s for s in self.segments if s.end == name]) != 1:
                raise ValueError(f"outlet {name} must be the end of exactly one segment")
        require_number("tap", self.tap, above=0.0, at_most=1.0)
        spacing = max(s / n for s, n in zip(self.size, self.cells, strict=True))
        narrowest = min(s.width for s in self.segments)
        if narrowest < MIN_CELLS_ACROSS * spacing:
            raise ValueError(
                f"cells {self.cells} leave {narrowest / spacing:.1f} cells across the narrowest "
                f"channel, need {MIN_CELLS_ACROSS:g}; refine them"
            )

    @property
    def branches(self) -> tuple[int, ...]:
        """Index of the segment that ends at each outlet."""
        ends = [s.end for s in self.segments]
        return tuple(ends.index(name) for name in self.outlets)

    @property
    def inlet_slope(self) -> float:
        """Rise of the inlet's axis over its run [-]."""
        (x0, y0), (x1, y1) = (self.nodes[n] for n in self.segments[0][1:3])
        return (y1 - y0) / (x1 - x0)

    @property
    def taps(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Places where pressures are read: at the inlet channel's start and at the tap [m]."""
        (x0, y0), (x1, y1) = (self.nodes[n] for n in self.segments[0][1:3])
        return (x0, y0), (x0 + self.tap * (x1 - x0), y0 + self.tap * (y1 - y0))

    def coordinates(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Distance to every channel's axis [m] and place along it [-], (..., num_segments) each.

        Inlet and outlets go on beyond the box. The place runs from 0 to 1 between the nodes.
        """
        distances, places = [], []
        for segment in self.segments:
            a, b = (torch.tensor(self.nodes[n], dtype=points.dtype) for n in segment[1:3])
            along = b - a
            place = ((points - a) * along).sum(-1) / along.dot(along)
            low = -1.0 if segment is self.segments[0] else 0.0
            high = 2.0 if segment.end in self.outlets else 1.0
            nearest = a + place.clamp(low, high)[..., None] * along
            distances.append((points - nearest).norm(dim=-1))
            places.append(place)
        return torch.stack(distances, -1), torch.stack(places, -1)

    def level_set(self, points: Tensor, offset: float, narrowing: tuple[float, ...]) -> Tensor:
        """phi at points (..., 2) [m], > 0 in the fluid.

        Args:
            points: Points in the box, (..., 2) [m].
            offset: Distance by which all walls move outwards [m].
            narrowing: Narrowing of the middle of the branch to each outlet, relative to its width,
                (num_outlets,) [-].
        """
        return self.level_set_at(*self.coordinates(points), offset, narrowing)

    def level_set_at(
        self, distance: Tensor, place: Tensor, offset: float, narrowing: tuple[float, ...]
    ) -> Tensor:
        """The same from ``coordinates``, which the walls do not move."""
        half = torch.tensor([0.5 * s.width for s in self.segments], dtype=distance.dtype)
        share = torch.zeros(len(self.segments), dtype=distance.dtype)
        for branch, amount in zip(self.branches, narrowing, strict=True):
            share[branch] = amount
        hump = 0.5 + 0.5 * torch.cos(2.0 * torch.pi * (place - 0.5) / self.throat)
        hump = torch.where((place - 0.5).abs() < 0.5 * self.throat, hump, 0.0)
        return (half * (1.0 - share * hump) + offset - distance).amax(-1)

    def owners(self, points: Tensor) -> Tensor:
        """Which channel a point belongs to, (...) int64."""
        distance, _ = self.coordinates(points)
        half = torch.tensor([0.5 * s.width for s in self.segments], dtype=points.dtype)
        return (half - distance).argmax(-1)
