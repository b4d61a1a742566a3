"""A design's parts to look at and to make: placed meshes, bill of materials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from diffsim.copter.design.placement import PlacedPart
from diffsim.copter.vehicle.geometry import frame_of
from diffsim.core.arrays import Array
from diffsim.core.checked import checked

if TYPE_CHECKING:
    import trimesh


@checked(kinds_only=True)
@dataclass(frozen=True)
class PartEntry:
    """A line of the bill of materials.

    Attributes:
        name, kind: Name and kind of the part.
        source: ``bought``, ``cut`` or ``printed``.
        mass: Mass [kg].
        price: Price [EUR].
        dimensions: Shape parameters by name [m].
    """

    name: str
    kind: str
    source: str
    mass: float
    price: float
    dimensions: Mapping[str, float]


def part_entries(
    parts: Sequence[PlacedPart], values: Mapping[str, float], masses: Sequence[float]
) -> tuple[PartEntry, ...]:
    """Bill of materials of parts with these parameters [m] and masses [kg]."""
    entries = []
    for p, mass in zip(parts, masses, strict=True):
        shape = {n.partition(".")[2]: values[n] for n in p.shape_names}
        rates = zip(p.part.price_per_parameter, shape.values(), strict=False)  # rates may be none
        price = p.part.price + sum(a * b for a, b in rates) + p.part.price_per_mass * mass
        entries.append(PartEntry(p.name, p.part.kind, p.part.source, mass, price, shape))
    return tuple(entries)


def placed_meshes(
    parts: Sequence[PlacedPart], values: Mapping[str, float], directions: Tensor | None
) -> dict[str, trimesh.Trimesh]:
    """Closed surfaces in the design's frame.

    Args:
        values: All parameters by name [m].
        directions: Thrust directions, (n_rotors, 3), by which motors and their propellers are
            turned about the propeller's center; None leaves them as built.
    """
    import trimesh

    tilts = _tilts(parts, directions)
    meshes = {}
    for p in parts:
        shape = np.array([values[n] for n in p.shape_names])
        tilt = tilts.get(p.name.removesuffix("__propeller"), np.eye(3))
        turned = p.part.mesh.vertices.at(shape) @ (tilt @ p.rotation).T
        placed = turned + np.array([values[n] for n in p.position_names])
        meshes[p.name] = trimesh.Trimesh(placed, p.part.mesh.faces, process=False)
    return meshes


def _tilts(parts: Sequence[PlacedPart], directions: Tensor | None) -> dict[str, Array]:
    """Least rotations from the built directions to others, by motor."""
    if directions is None:
        return {}
    motors = [(p.name, p.rotation, m) for p in parts if (m := p.part.rotor_mount) is not None]
    tilts = {}
    for (name, rotation, mount), wanted in zip(motors, directions.detach().numpy(), strict=True):
        built = rotation @ mount.direction
        turn = np.cross(built, wanted)
        if np.linalg.norm(turn) > 1e-12:
            before, after = (frame_of(d, np.cross(turn, d)) for d in (built, wanted))
            tilts[name] = after @ before.T
    return tilts
