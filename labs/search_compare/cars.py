"""A car on a yard: a law that no library lists and a cause of the library act together.

It understeers: its wheelbase seems longer by a share that grows with the square of the speed
(Gillespie, "Fundamentals of Vehicle Dynamics", 1992, chapter 6). And its steering comes late.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from diffsim.data.study import Channel, Command, Run, Study
from labs.search_compare.rigs import Rig

Array = NDArray[np.float64]
STEP, PARTS, WHEELBASE = 0.05, 10, 2.5  # [s], steps of a sample, [m]
NOISE = np.array([0.02, 0.02, 0.005])  # [m, m, rad]
USES = ("fit", "fit", "select", "test")
MODEL = {
    "system": "ode",
    "states": {"x": 0, "y": 0, "yaw": 0},
    "inputs": [{"name": "speed", "held": True}, {"name": "steer", "held": True}],
    "parameters": {"wheelbase": {"value": f"{WHEELBASE} m", "percent": 1}},
    "rates": {"x": "speed*cos(yaw)", "y": "speed*sin(yaw)", "yaw": "speed*tan(steer)/wheelbase"},
    "readings": {"east": "x", "north": "y", "yaw": "yaw"},
}
LAW, LATE = "law_of_speed_at_wheelbase", "delay"


def car(seed: int, null: bool, hidden: frozenset[str]) -> Study:
    """Four drives with slow sines of speed and steering.

    Args:
        seed: Of all that is drawn.
        null: Whether nothing is hidden.
        hidden: What is, else: ``LAW``, ``LATE``.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, rng.choice([20.0, 25.0, 30.0]), STEP)
    late, grows = rng.uniform(0.08, 0.25), rng.uniform(0.006, 0.03)  # [s], [s^2/m^2]
    late = late if LATE in hidden and not null else 0.0
    grows = grows if LAW in hidden and not null else 0.0
    runs = []
    for name, use in zip("abcd", USES, strict=True):
        pace, turn, quick = rng.uniform((0.15, 0.4, 1.3), (0.3, 0.8, 2.0))
        begin = rng.uniform(0.0, 6.0, 3)
        speed = 4.0 + 2.0 * np.sin(pace * time + begin[0])
        steer = 0.25 * np.sin(turn * time + begin[1]) + 0.1 * np.sin(quick * time + begin[2])
        seen = _drive(time, speed, steer, late, grows)
        seen += NOISE * rng.standard_normal(seen.shape)
        runs.append(Run(name, time, seen, {"speed": speed, "steer": steer}, name, use=use))
    units = (("east", "m", "position"), ("north", "m", "position"), ("yaw", "rad", "angle"))
    channels = tuple(
        Channel(*said, sd=float(sd)) for said, sd in zip(units, NOISE.tolist(), strict=True)
    )
    commands = (Command("speed", "m/s", is_measured=True), Command("steer", "rad"))
    return Study("car", "ode", channels, tuple(runs), commands=commands, model=MODEL)


def _drive(time: Array, speed: Array, steer: Array, late: float, grows: float) -> Array:
    """East, north and yaw at the samples, (T, 3); commands last a sample."""
    place, out, h = np.zeros(3), [], STEP / PARTS
    for k, v in enumerate(speed.tolist()):
        out.append(place)
        for part in range(PARTS):
            ago = time[k] + (part + 0.5) * h - late
            wheel = steer[int(ago / STEP)] if ago >= 0.0 else 0.0
            turning = v * np.tan(wheel) / (WHEELBASE * (1.0 + grows * v**2))
            middle = place[2] + 0.5 * h * turning
            place = place + h * np.array([v * np.cos(middle), v * np.sin(middle), turning])
    return np.array(out)


def _rig(*hidden: str) -> Rig:
    return Rig(partial(car, hidden=frozenset(hidden)), frozenset(hidden), with_laws=True)


CARS: Mapping[str, Rig] = {
    "car": _rig(LAW, LATE),
    "car_in_time": _rig(LAW),
    "car_that_grips": _rig(LATE),
}
