"""What of a described rod does not change with its numbers: elements, points, paths, frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from diffsim.systems.rod.shape import Array, Paths, Points, RodShape, points_on, rod_shape

if TYPE_CHECKING:
    from diffsim.systems.rod.keys import RodKeys, RodTendon

TIP = "tip"


@dataclass(frozen=True, eq=False)
class Layout:
    """Constants of a rod on one set of elements.

    Attributes:
        shape: Elements.
        paths: Where tendons run.
        markers: Points that are seen.
        masses: Points that may weigh something: stated masses, markers and the tip.
        base: (3, 3) columns along, y and z of the first section.
        place: (3,) of the base [m].
        gravity: (3,) acceleration of free fall [m/s^2].
        columns: (num_channels,) of each channel among 3 coordinates of each marker.
    """

    shape: RodShape
    paths: Paths
    markers: Points
    masses: Points
    base: Tensor
    place: Tensor
    gravity: Tensor
    columns: Tensor


def layout_of(given: RodKeys, channels: Sequence[str], finer: float) -> Layout:
    """Cut a described rod into elements.

    Args:
        given: Description.
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

    def points(chosen: dict[str, tuple[float, tuple[float, float, float]]]) -> Points:
        places = list(chosen.values())
        return points_on(shape, list(chosen), [p[0] for p in places], [p[1] for p in places])

    return Layout(
        shape=shape,
        paths=_lay_paths(given.tendons, shape),
        markers=points(seen),
        masses=points(heavy),
        base=torch.from_numpy(frame),
        place=torch.tensor(given.base.place, dtype=torch.float64),
        gravity=torch.tensor(given.gravity, dtype=torch.float64),
        columns=torch.tensor(columns, dtype=torch.int64),
    )


def _lay_paths(tendons: Sequence[RodTendon], shape: RodShape) -> Paths:
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
    return Paths(names, torch.from_numpy(offset), torch.from_numpy(slope), end)


def _interpolate_line(at: Array, points: Array, where: Array) -> tuple[Array, Array]:
    """Places and slopes of a broken line; beyond its end it goes on straight."""
    piece = np.clip(np.searchsorted(at, where) - 1, 0, len(at) - 2)
    rate = (points[piece + 1] - points[piece]) / (at[piece + 1] - at[piece])[:, None]
    return points[piece] + rate * (where - at[piece])[:, None], rate


__all__ = ["TIP", "Layout", "layout_of"]
