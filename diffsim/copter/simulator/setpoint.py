"""What a controller is asked for at one time, and who asks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

Vector = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Setpoint:
    """Targets of a controller, NED.

    Attributes:
        position: Position of the center of mass, (3,) [m]; with ``hold_attitude`` only its z
            counts.
        velocity: World frame, (3,) [m/s]; with ``hold_attitude`` only its z counts.
        acceleration: World frame, (3,) [m/s^2]; 0 where it is not known ahead, or holding attitude.
        yaw: Yaw angle that is asked for [rad].
        yaw_rate: Yaw rate [rad/s].
        roll, pitch: Beyond those of the hover [rad]; with ``hold_attitude`` only.
        hold_attitude: Hold roll and pitch instead of the place.
        motors_on: False: all motors stand.
    """

    position: Vector
    velocity: Vector = (0.0, 0.0, 0.0)
    acceleration: Vector = (0.0, 0.0, 0.0)
    yaw: float = 0.0
    yaw_rate: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    hold_attitude: bool = False
    motors_on: bool = True


class Pilot(Protocol):
    """A mission, or somebody at the sticks."""

    @property
    def duration(self) -> float | None:
        """Duration of the flight [s]; None: endless."""

    def setpoint(self, time: float) -> Setpoint:
        """Targets at a time since the start [s]; times do not go back."""
