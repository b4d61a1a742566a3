"""Scripted missions: take off, hover, fly to, yaw, land; as YAML files.

    name: there_and_back
    steps:                                    # one after the other; heights are up from the ground
      - take_off: {height: 1.5, speed: 0.8}   # speed: greatest on the way [m/s]
      - hover: {seconds: 3}
      - fly_to: {north: 3, east: 1, height: 2, speed: 1.5}   # those left out stay
      - yaw: {degrees: 90, rate: 45}          # heading from north, clockwise seen from above; the
                                              #   short way round; rate: greatest [degrees/s]
      - land: {speed: 0.5}

A way from rest to rest has the polynomial of least jerk (Flash and Hogan 1985).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.copter._shipped import read_named, shipped
from diffsim.copter.simulator.controllers import Setpoint
from diffsim.core.arrays import Array
from diffsim.core.check import require_entries
from diffsim.core.checked import checked
from diffsim.core.yaml_text import load_yaml

_PEAK_SPEED = 15.0 / 8.0  # of the least-jerk polynomial, per mean speed
_PEAK_ACCELERATION = 10.0 / math.sqrt(3.0)  # per way and squared duration
MAX_ACCELERATION = 1.5  # [m/s^2]
MAX_YAW_ACCELERATION = math.radians(90.0)  # [rad/s^2]


@checked
@dataclass(frozen=True, kw_only=True)
class Leg:
    """A way from rest to rest.

    Attributes:
        name: Name of the step.
        start: Time [s].
        duration: Duration [s].
        pose: North, east, down, yaw at its start, (4,) [m, rad].
        move: By the end, (4,) [m, rad].
    """

    name: str
    start: float
    duration: float
    pose: Array
    move: Array

    def at(self, time: float) -> Setpoint:
        """Targets at a time [s]."""
        t = min(max((time - self.start) / self.duration, 0.0), 1.0)
        way = t**3 * (10.0 - 15.0 * t + 6.0 * t**2)
        rate = 30.0 * t**2 * (1.0 - t) ** 2 / self.duration
        push = 60.0 * t * (1.0 - t) * (1.0 - 2.0 * t) / self.duration**2
        x, y, z, yaw = (self.pose + way * self.move).tolist()
        vx, vy, vz, yaw_rate = (rate * self.move).tolist()
        ax, ay, az, _ = (push * self.move).tolist()
        return Setpoint(
            position=(x, y, z),
            velocity=(vx, vy, vz),
            acceleration=(ax, ay, az),
            yaw=yaw,
            yaw_rate=yaw_rate,
        )


@checked
@dataclass(frozen=True)
class Mission:
    """Legs one after the other; a ``Pilot``. After a last ``land`` the motors stand.

    Attributes:
        name: Name of the mission.
        legs: Legs, at least one; the first from the ground at the origin, heading north.
    """

    name: str
    legs: tuple[Leg, ...]

    def __post_init__(self) -> None:
        require_entries("legs", self.legs, Leg)

    @property
    def duration(self) -> float:
        """[s]"""
        return self.legs[-1].start + self.legs[-1].duration

    def setpoint(self, time: float) -> Setpoint:
        """Targets at a time since the start [s]."""
        leg = next((leg for leg in reversed(self.legs) if time >= leg.start), self.legs[0])
        target = leg.at(time)
        if leg.name == "land" and time >= self.duration:
            return Setpoint(position=target.position, yaw=target.yaw, motors_on=False)
        return target


def shipped_missions() -> tuple[str, ...]:
    """Names of the missions that come with the package."""
    return shipped("simulator/flights")


@checked
def load_mission(name: str | Path) -> Mission:
    """Read a mission.

    Args:
        name: Name of a shipped mission, such as ``hover``, or the path of a YAML file.

    Raises:
        FileNotFoundError: a path without a file.
        ValueError: unknown name, step or value; names file and key.
    """
    text, source, _ = read_named("simulator/flights", "mission", name)
    return mission_from_text(text, source)


@checked
def mission_from_text(text: str, source: str = "mission") -> Mission:
    """Read a mission from YAML text; ``source`` is what error messages call it."""
    # pydantic takes a third of a second: only for those who read a file
    from diffsim.copter.simulator.mission_keys import MissionKeys
    from diffsim.core.schema import read_part

    said = read_part(MissionKeys, load_yaml(text, source), f"{source}: ")
    pose, time, legs = np.zeros(4), 0.0, []
    for k, step in enumerate(said.steps):
        name, keys = step.said
        try:
            _require_order(name, flying=bool(pose[2] < 0.0))
        except ValueError as error:
            raise ValueError(f"{source}: steps[{k}]: {error}") from None
        leg = _leg(name, dict(keys), time, pose)
        pose, time = pose + leg.move, time + leg.duration
        legs.append(leg)
    return Mission(said.name or Path(source).stem, tuple(legs))


def _require_order(name: str, *, flying: bool) -> None:
    if name == "take_off" and flying:
        raise ValueError("take_off while flying; use fly_to with another height")
    if name != "take_off" and not flying:
        raise ValueError(f"{name} on the ground; put a take_off before it")


def _leg(name: str, values: dict[str, Any], time: float, pose: Array) -> Leg:
    end = pose.copy()
    if name == "hover":
        return Leg(name=name, start=time, duration=values["seconds"], pose=pose, move=0.0 * pose)
    if name == "yaw":
        turn = math.radians(values["degrees"]) - pose[3]
        end[3] = pose[3] + (turn + math.pi) % (2.0 * math.pi) - math.pi
        rate, most = math.radians(values["rate"]), MAX_YAW_ACCELERATION
    else:
        rate, most = values["speed"], MAX_ACCELERATION
        if name == "land":
            end[2] = 0.0
        for axis, key, sign in ((0, "north", 1.0), (1, "east", 1.0), (2, "height", -1.0)):
            if values.get(key) is not None:
                end[axis] = sign * values[key]
    way = float(np.linalg.norm(end - pose))
    duration = max(_PEAK_SPEED * way / rate, math.sqrt(_PEAK_ACCELERATION * way / most), 0.5)
    return Leg(name=name, start=time, duration=duration, pose=pose, move=end - pose)
