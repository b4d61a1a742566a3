"""Motors with a direction of their own: compound-angle clips (thesis 3.6, Fig. 3-4)."""

from __future__ import annotations

import numpy as np

from diffsim.copter.design.contact import ContactEnd
from diffsim.copter.design.placement import PlacedPart
from diffsim.copter.design.spec import PartSpec
from diffsim.copter.vehicle.geometry import UP
from diffsim.copter.vehicle.parts import Part, make_part
from diffsim.copter.vehicle.patches import aligning_rotation
from diffsim.core.arrays import Array

_CLIP = "compound_angle_clip"
_SQUARE = 0.01  # a motor that deviates by less needs no clip [deg]


def clip_for(spec: PartSpec, motor: Part, host: ContactEnd, degrees: float) -> Part | None:
    """The clip between a flat patch and a motor; None if the motor stands square on it.

    Args:
        spec: Specification of the motor, with a direction.
        motor: The part.
        host: What carries the motor, placed.
        degrees: Turn of the clip about the host's normal.

    Raises:
        ValueError: no motor, or tilted too far; names the part.
    """
    wanted = _carrier_normal(spec, motor)
    if _angle(host.placed.rotation @ host.patch.axis, wanted) <= _SQUARE:
        return None
    bottom = make_part(_CLIP, {"normal": UP.tolist()}).patches["bottom"]
    rotation = aligning_rotation(host.patch, host.placed.rotation, bottom, degrees=degrees)
    try:
        return make_part(_CLIP, {"normal": (rotation.T @ wanted).tolist()})
    except ValueError as error:
        raise ValueError(f"direction of {spec.name!r} on {host.name}: {error}") from error


def require_direction(spec: PartSpec, placed: PlacedPart) -> None:
    """Refuse a direction that no connection could give, instead of dropping it.

    Raises:
        ValueError: the placed motor points elsewhere.
    """
    wanted = _carrier_normal(spec, placed.part)
    off = _angle(-placed.rotation @ placed.patch("base").axis, wanted)
    if off > 2.0 * _SQUARE:
        raise ValueError(
            f"motor {spec.name!r} points {off:.3g} degrees away from its direction; only a "
            "connection to a flat patch can tilt a motor (by a clip), and only if the motor has "
            "no rotation of its own"
        )


def _carrier_normal(spec: PartSpec, motor: Part) -> Array:
    """Normal that what carries the motor must have, unit, design frame."""
    direction = np.asarray(spec.direction, dtype=np.float64)
    mount = motor.rotor_mount
    if mount is None:
        raise ValueError(f"part {spec.name!r} has a direction but is no motor")
    length = float(np.linalg.norm(direction))
    if not length > 0.0:
        raise ValueError(f"direction of {spec.name!r} must not be zero")
    return -(motor.patches["base"].axis @ mount.direction) * direction / length


def _angle(a: Array, b: Array) -> float:
    """Between two vectors [deg]."""
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
