"""Two placed patches become linear constraints (thesis 3.2.2).

Patches that belong together coincide, except along directions in which one may slide over the
other; there the distance is bounded by the patch.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from diffsim.copter.design.constraints import Constraint
from diffsim.copter.design.placement import LinearForm, PlacedPart
from diffsim.copter.vehicle.geometry import frame_of
from diffsim.copter.vehicle.patches import Patch, misalignment
from diffsim.core.arrays import Array

Target = tuple[LinearForm, float]
_ALIGNED = 0.05  # [deg]


@dataclass(frozen=True, eq=False)
class ContactEnd:
    """A patch of a placed part."""

    placed: PlacedPart
    patch_name: str
    # place along the patch's sliding directions [m]; None for its center
    at: tuple[float, ...] | None = None
    slide: bool | None = None  # whether that place is free; None leaves it to the patch

    @property
    def name(self) -> str:
        """part.patch."""
        return f"{self.placed.name}.{self.patch_name}"

    @property
    def patch(self) -> Patch:
        """The patch."""
        return self.placed.patch(self.patch_name)

    def coordinate(self, direction: Array) -> LinearForm:
        """Coordinate of the patch's center along a direction [m]."""
        return self.placed.coordinate(self.patch.center, direction)


@dataclass
class Contact:
    """What a contact adds to a design."""

    constraints: list[Constraint] = field(default_factory=list)  # coincidence and bounds of sliding
    # explicit, defaults: starting values of sliding, given by the author or assumed
    explicit: list[Target] = field(default_factory=list)
    defaults: list[Target] = field(default_factory=list)


def contact_of(host: ContactEnd, guest: ContactEnd) -> Contact:
    """Constrain two patches to coincide, up to where they may slide.

    Raises:
        ValueError: the patches do not face each other, or ``at`` has the wrong length.
    """
    label = f"connection {host.name} - {guest.name}"
    off = misalignment(host.patch, host.placed.rotation, guest.patch, guest.placed.rotation)
    if off > _ALIGNED:
        raise ValueError(
            f"{label}: the patches are {off:.3g} degrees off; turn one part by angle, roll or "
            "rotation"
        )
    contact = Contact()
    sliding: list[Array] = []
    offset = np.zeros(3)
    for end, key, sign in ((host, "at", 1.0), (guest, "guest_at", -1.0)):
        slides = end.patch.slides
        if end.at is not None and len(end.at) != len(slides):
            raise ValueError(
                f"{label}: {key} must hold {len(slides)} numbers for {end.name}, got {len(end.at)}"
            )
        moves = end.patch.slides_by_default if end.slide is None else end.slide
        for k, way in enumerate(slides):
            direction = sign * (end.placed.rotation @ way.direction)
            place = 0.0 if end.at is None else float(end.at[k])
            if not moves:
                offset = offset + place * direction
                continue
            sliding.append(direction)
            gap = guest.coordinate(direction) - host.coordinate(direction)
            reach = end.placed.half_extent(way)
            for form in (gap, -1.0 * gap):
                row = form.at_most(reach, f"{label}: within {end.placed.name}")
                contact.constraints.append(row)
            (contact.defaults if end.at is None else contact.explicit).append((gap, place))
    for direction in _complement(_distinct(sliding), host.placed.rotation @ host.patch.reference):
        gap = guest.coordinate(direction) - host.coordinate(direction)
        contact.constraints.append(gap.equals(float(direction @ offset), label))
    return contact


def _distinct(directions: list[Array]) -> list[Array]:
    """Directions without those that are parallel to an earlier one."""
    result: list[Array] = []
    for direction in directions:
        if all(abs(direction @ other) < 1.0 - 1e-9 for other in result):
            result.append(direction)
    return result


def _complement(directions: list[Array], reference: Array) -> Array:
    """Unit rows that complete orthonormal directions to a basis, (3 - n, 3)."""
    if len(directions) == 0:
        return np.eye(3)
    if len(directions) == 1:
        return frame_of(directions[0], reference)[:, 1:].T
    return np.cross(directions[0], directions[1])[None, :]
