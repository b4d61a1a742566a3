"""Parts whose geometry comes from the public tool's mesh files (see ``import_xml``)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from diffsim.copter.vehicle.geometry import (
    UP,
    LinearMesh,
    LinearPoints,
    fixed_points,
    scaled_points,
)
from diffsim.copter.vehicle.parts.fittings import motor_of_mesh
from diffsim.copter.vehicle.parts.part import Part
from diffsim.copter.vehicle.parts.rotors import rotor_data
from diffsim.copter.vehicle.parts.structure import rod_of_mesh
from diffsim.copter.vehicle.patches import Patch
from diffsim.mesh.closed_surface import closed_surface

if TYPE_CHECKING:
    from diffsim.core.schema_numbers import KilogramsPerCubicMeter, Meters, Ratio

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
