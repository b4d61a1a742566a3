"""Transmitters: sticks of a pilot, recorded or live, and what they ask of the controller.

A recorded file is CSV with the columns ``time_s, roll, pitch, yaw, throttle``, sticks from -1 to 1,
in the middle 0. They are held from row to row by straight lines.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Protocol

import numpy as np

from diffsim.copter.simulator.controllers import Setpoint
from diffsim.core.arrays import Array
from diffsim.core.check import require_choice, require_number
from diffsim.core.checked import checked
from diffsim.data.table import is_number, open_table

NAMES = ("roll", "pitch", "yaw", "throttle")
MODES = ("position", "attitude")


@checked
@dataclass(frozen=True)
class Sticks:
    """Deflections, -1 to 1.

    Attributes:
        roll: Right is positive.
        pitch: Forward is positive.
        yaw: Clockwise seen from above is positive.
        throttle: Up is positive.
    """

    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    throttle: float = 0.0


class Transmitter(Protocol):
    """A source of stick positions."""

    @property
    def duration(self) -> float | None:
        """Duration of the recording [s]; None: endless."""

    def sticks(self, time: float) -> Sticks:
        """Deflections at a time since the start [s]."""


@checked(kinds_only=True)
@dataclass(frozen=True)
class RecordedSticks:
    """Sticks from a file.

    Attributes:
        time_s: (T,) increasing, the first 0 [s].
        values: Roll, pitch, yaw, throttle, (T, 4).
    """

    time_s: Array
    values: Array

    @property
    def duration(self) -> float:
        """Time of the last row [s]."""
        return float(self.time_s[-1])

    def sticks(self, time: float) -> Sticks:
        """Deflections at a time; those of the last row after the end."""
        return Sticks(*(float(np.interp(time, self.time_s, column)) for column in self.values.T))


@dataclass(frozen=True, kw_only=True)
class StickScale:
    """What full deflection means, and where the sticks may lead.

    Attributes:
        speed: Over ground, mode "position" [m/s].
        tilt: Roll and pitch, mode "attitude" [rad].
        climb: Climb rate of a full stick [m/s].
        yaw_rate: Yaw rate of a full stick [rad/s].
        max_height: Up from the ground [m].
    """

    speed: float = 2.0
    tilt: float = math.radians(15.0)
    climb: float = 1.0
    yaw_rate: float = math.radians(60.0)
    max_height: float = 30.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            require_number(name, value, above=0.0)


class StickPilot:
    """Turns sticks into targets; a ``Pilot``.

    Starts on the ground with the motors standing; throttle up starts them. In mode "position"
    roll and pitch move the target over ground in the direction of the heading, in mode "attitude"
    they tilt the vehicle and nothing holds its place. Throttle moves the target height, yaw the
    heading. With the target on the ground and throttle down the motors stop.

    Args:
        transmitter: Source of the stick positions.
        mode: "position" or "attitude".
        scale: ``StickScale()`` by default.
    """

    @checked
    def __init__(
        self, transmitter: Transmitter, *, mode: str = "position", scale: StickScale | None = None
    ):
        self.transmitter = transmitter
        self.mode = require_choice("mode", mode, MODES)
        self.scale = StickScale() if scale is None else scale
        self._position = np.zeros(3)
        self._yaw = 0.0
        self._time = 0.0
        self._motors_on = False

    @property
    def duration(self) -> float | None:
        """That of the transmitter."""
        return self.transmitter.duration

    def setpoint(self, time: float) -> Setpoint:
        """Targets at a time [s]; moves them on from the last time asked for."""
        sticks, s, dt = self.transmitter.sticks(time), self.scale, time - self._time
        self._time = time
        on_ground = self._position[2] >= 0.0
        self._motors_on = sticks.throttle > 0.0 or (
            self._motors_on and not (on_ground and sticks.throttle < 0.0)
        )
        velocity, yaw_rate = np.zeros(3), 0.0
        if self._motors_on:
            yaw_rate = s.yaw_rate * sticks.yaw
            velocity[2] = -s.climb * sticks.throttle
            if self.mode == "position" and not on_ground:
                c, n = math.cos(self._yaw), math.sin(self._yaw)
                forward, right = s.speed * sticks.pitch, s.speed * sticks.roll
                velocity[:2] = c * forward - n * right, n * forward + c * right
        wanted = self._position + velocity * dt
        self._position = np.array([*wanted[:2], min(max(wanted[2], -s.max_height), 0.0)])
        if self._position[2] != wanted[2]:  # at the ground or the ceiling
            velocity[2] = 0.0
        self._yaw += yaw_rate * dt
        x, y, z = self._position.tolist()
        vx, vy, vz = velocity.tolist()
        attitude = self.mode == "attitude"
        return Setpoint(
            position=(x, y, z),
            velocity=(vx, vy, vz),
            yaw=self._yaw,
            yaw_rate=yaw_rate,
            roll=s.tilt * sticks.roll if attitude else 0.0,
            pitch=-s.tilt * sticks.pitch if attitude else 0.0,
            hold_attitude=attitude,
            motors_on=self._motors_on,
        )


def example_sticks() -> Path:
    """The recorded flight that comes with the package: up, a square over ground, down."""
    return Path(str(resources.files("diffsim.copter.simulator.flights") / "square_sticks.csv"))


@checked
def load_sticks(path: str | Path) -> RecordedSticks:
    """Read recorded sticks.

    Raises:
        FileNotFoundError: no such file.
        ValueError: columns are missing, a cell is no number between -1 and 1, time does not
            increase from 0; names file and line.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no stick file {path}; an example is {example_sticks()}")
    with open_table(path, "stick file") as (header, rows):
        missing = [name for name in ("time_s", *NAMES) if name not in header]
        if missing:
            raise ValueError(
                f"{path}: column {missing[0]} is missing; needed are time_s, {', '.join(NAMES)}, "
                f"the file has {', '.join(header)}"
            )
        table: list[list[float]] = []
        for line, row in rows:
            cells = dict(zip(header, row, strict=True))
            table.append([_number(path, line, n, cells[n]) for n in ("time_s", *NAMES)])
            now = table[-1][0]
            if len(table) == 1 and now != 0.0:
                raise ValueError(f"{path}, line {line}: time_s must start at 0, got {now:g}")
            if len(table) > 1 and now <= table[-2][0]:
                raise ValueError(
                    f"{path}, line {line}: time_s must increase, got {now:g} after "
                    f"{table[-2][0]:g}; sort the rows or remove the repeated one"
                )
    if len(table) < 2:
        raise ValueError(f"{path}: two rows or more are needed, got {len(table)}")
    array = np.array(table)
    return RecordedSticks(array[:, 0], array[:, 1:])


def _number(path: Path, line: int, name: str, cell: str) -> float:
    """A cell; the position of a stick must lie between -1 and 1."""
    value = float(cell) if is_number(cell) else math.nan
    if not math.isfinite(value):
        raise ValueError(f"{path}, line {line}: {name} must be a number, got {cell!r}")
    if name in NAMES and abs(value) > 1.0:
        raise ValueError(
            f"{path}, line {line}: {name} must lie in [-1, 1], got {value:g}; pulses in "
            "microseconds become (pulse - 1500) / 500"
        )
    return value
