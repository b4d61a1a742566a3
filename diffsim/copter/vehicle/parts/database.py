"""The part database: kinds by name (thesis 3.2.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diffsim.copter.vehicle.geometry import (
    UP,
    LinearMesh,
    LinearPoints,
    fixed_points,
    scaled_points,
)
from diffsim.copter.vehicle.parts.fittings import (
    compound_angle_clip,
    motor,
    motor_of_mesh,
    propeller,
    round_connector,
    screw_mount,
    standoff,
)
from diffsim.copter.vehicle.parts.frames import mesh_frame, outline_frame, x_frame
from diffsim.copter.vehicle.parts.part import Part, PartMaker
from diffsim.copter.vehicle.parts.rotors import rotor_data
from diffsim.copter.vehicle.parts.structure import box_part, circular_plate, plate, rod, rod_of_mesh
from diffsim.copter.vehicle.patches import Patch
from diffsim.core.check import require_choice
from diffsim.core.checked import checked
from diffsim.mesh.closed_surface import closed_surface

if TYPE_CHECKING:
    from diffsim.core.schema_numbers import Kilograms, KilogramsPerCubicMeter, Meters, Ratio


X = np.array([1.0, 0.0, 0.0])


def imported_mesh(
    file: str | Path, density: KilogramsPerCubicMeter, scale: Sequence[Ratio] = (1.0, 1.0, 1.0)
) -> Part:
    """A closed surface of constant size.

    Args:
        file: The surface [m].
        density: Density [kg/m^3].
        scale: Factors along x, y, z.
    """
    vertices, faces = closed_surface(file)
    return Part(
        "imported_mesh",
        LinearMesh(fixed_points(vertices * np.asarray(scale, dtype=np.float64)), faces),
        density,
        {"bore": Patch("circular", "mount", fixed_points([0.0] * 3), X, UP)},
        options={"file": str(file), "density": density, "scale": [float(v) for v in scale]},
    )


def imported_rod(file: str | Path, density: KilogramsPerCubicMeter, length: Meters) -> Part:
    """A tube of unit length along x in the file; the length is a parameter [m]."""
    vertices, faces = closed_surface(file)
    radius = float(np.abs(vertices[:, 1:]).max())
    return rod_of_mesh(
        LinearMesh(scaled_points(vertices, [0]), faces),
        length,
        radius,
        density,
        {"file": str(file), "density": density},
        kind="imported_rod",
        lower=0.0,  # the public tool's bounds
        upper=5.0,
    )


def imported_motor(
    file: str | Path,
    density: KilogramsPerCubicMeter,
    rotor: str,
    spin: str = "cw",
    flip_prop: bool = False,
) -> Part:
    """A motor; the public tool lets the thrust act at the origin of the motor's mesh.

    Args:
        file: The surface, frame NED, shaft along z [m].
        density: Density [kg/m^3].
        rotor: Name of the rotor's model.
        spin: "cw" or "ccw".
        flip_prop: The propeller pushes instead of pulling.
    """
    vertices, faces = closed_surface(file)
    return motor_of_mesh(
        LinearMesh(LinearPoints(vertices, np.zeros((*vertices.shape, 0))), faces),
        rotor_data(rotor),
        density,
        {
            "file": str(file),
            "density": density,
            "rotor": rotor,
            "spin": spin,
            "flip_prop": flip_prop,
        },
        base=float(vertices[:, 2].max()),
        spin=spin,
        pusher=flip_prop,
        kind="imported_motor",
    )


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
