"""The part database: kinds by name (thesis 3.2.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from diffsim.copter.vehicle.parts.fittings import (
    compound_angle_clip,
    motor,
    propeller,
    round_connector,
    screw_mount,
    standoff,
)
from diffsim.copter.vehicle.parts.frames import mesh_frame, outline_frame, x_frame
from diffsim.copter.vehicle.parts.imported import imported_mesh, imported_motor, imported_rod
from diffsim.copter.vehicle.parts.part import Part, PartMaker
from diffsim.copter.vehicle.parts.structure import box_part, circular_plate, plate, rod
from diffsim.core.check import require_choice
from diffsim.core.checked import checked

if TYPE_CHECKING:
    from diffsim.core.schema_numbers import Kilograms, Meters


def battery(size: Sequence[Meters] = (0.1008, 0.0336, 0.0224), mass: Kilograms = 0.2127) -> Part:
    """A three-cell pack of 2200 mAh by default; size (3,) [m], mass [kg]."""
    return box_part("battery", size, mass, 25.0)


def electronics(size: Sequence[Meters] = (0.0815, 0.05, 0.0155), mass: Kilograms = 0.0359) -> Part:
    """Flight controller and receiver; size (3,) [m], mass [kg]."""
    return box_part("electronics", size, mass, 200.0)


def payload(size: Sequence[Meters] = (0.08, 0.08, 0.05), mass: Kilograms = 0.5) -> Part:
    """Something carried; size (3,) [m], mass [kg]."""
    return box_part("payload", size, mass, 0.0)


PART_KINDS: dict[str, PartMaker] = {
    maker.__name__: maker
    for maker in (
        rod,
        plate,
        circular_plate,
        x_frame,
        outline_frame,
        mesh_frame,
        battery,
        electronics,
        payload,
        motor,
        propeller,
        round_connector,
        screw_mount,
        standoff,
        compound_angle_clip,
        imported_mesh,
        imported_rod,
        imported_motor,
    )
}


@checked
def make_part(kind: str, options: Mapping[str, Any] | None = None) -> Part:
    """A part from the database.

    Args:
        kind: A key of ``PART_KINDS``.
        options: Arguments of its maker: starting values of parameters and constant sizes.

    Raises:
        ValueError: unknown kind or option, with the closest names; what cannot be read; sizes that
            make no part.
    """
    from diffsim.copter.vehicle.option_keys import option_keys  # pydantic comes with it
    from diffsim.core.schema import read_part

    maker = PART_KINDS[require_choice("kind", kind, PART_KINDS)]
    return maker(**dict(read_part(option_keys(maker), dict(options or {}), kind)))
