"""Motors: where each goes, how it is tilted, which way it turns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffsim.copter.design.design import Design
from diffsim.core.arrays import Array
from diffsim.core.checked import checked

_UPRIGHT = 0.01  # a motor that deviates by less has no azimuth to speak of [deg]


@checked(kinds_only=True)
@dataclass(frozen=True)
class MotorPlan:
    """One motor.

    Attributes:
        number: 1, 2, ...: the flight controller's output, in the design's order.
        name: Name of the part.
        rotor: Name of the rotor's model.
        position: Position of the propeller's center relative to the center of mass,
            front-right-down [m].
        radius: Radius of the propeller [m].
        direction: Direction of the thrust, unit, front-right-down.
        clockwise: Seen from above.
        pusher: Hangs upside down below what carries it.
        clip: Name of the compound-angle clip under it, None if it stands square.
        max_thrust: Largest thrust [N].
    """

    number: int
    name: str
    rotor: str
    position: tuple[float, float, float]
    radius: float
    direction: tuple[float, float, float]
    clockwise: bool
    pusher: bool
    clip: str | None
    max_thrust: float

    @property
    def tilt(self) -> float:
        """Angle between thrust and up [deg] (thesis Table 3.1)."""
        return tilt_and_azimuth(np.array(self.direction))[0]

    @property
    def azimuth(self) -> float:
        """Where it leans, clockwise from the front seen from above; 0 if upright [deg]."""
        return tilt_and_azimuth(np.array(self.direction))[1]

    @property
    def turns(self) -> str:
        """Clockwise or counter-clockwise, seen from above."""
        return "clockwise" if self.clockwise else "counter-clockwise"


def motor_plans(design: Design) -> tuple[MotorPlan, ...]:
    """All motors of a design, in its order."""
    copter = design.multicopter().detach()
    clips = _clips(design)
    rows = []
    for i, (name, mount) in enumerate(zip(design.rotor_names, design.rotors, strict=True)):
        x, y, z = copter.positions[i].tolist()
        a, b, c = copter.directions[i].tolist()
        rows.append(
            MotorPlan(
                number=i + 1,
                name=name,
                rotor=mount.rotor.name,
                position=(x, y, z),
                radius=float(copter.radii[i]),
                direction=(a, b, c),
                clockwise=float(copter.spins[i]) > 0.0,
                pusher=bool(mount.direction[2] > 0.0),
                clip=clips.get(name),
                max_thrust=float(copter.max_thrusts[i]),
            )
        )
    return tuple(rows)


def tilt_and_azimuth(direction: Array) -> tuple[float, float]:
    """Angle from up, and where it leans clockwise from the front seen from above [deg]."""
    x, y, z = direction
    tilt = float(np.rad2deg(np.arctan2(np.hypot(x, y), -z)))
    if tilt < _UPRIGHT:
        return tilt, 0.0
    return tilt, float(np.rad2deg(np.arctan2(y, x)) % 360.0)


def _clips(design: Design) -> dict[str, str]:
    """Names of clips by motor: composition inserts a clip just before the motor that it is for."""
    clips, clip = {}, None
    for p in design.parts:
        if p.part.kind == "compound_angle_clip":
            clip = p.name
        elif p.part.rotor_mount is not None:
            if clip is not None:
                clips[p.name] = clip
            clip = None
    return clips
