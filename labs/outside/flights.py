"""Flights of RotorPy's quadrotor with one hidden cause, described by mass, rotors and sensors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.data.study import Channel, Run
from labs.outside.case import Case, Maker, recorded

Array = NDArray[np.float64]
STEP = 0.02  # commands are held so long [s]
COUNT = 101
ARM = 0.17 / np.sqrt(2.0)
PLACES = ((ARM, ARM, 0.0), (ARM, -ARM, 0.0), (-ARM, -ARM, 0.0), (-ARM, ARM, 0.0))
SPINS = ("cw", "ccw", "cw", "ccw")
THRUST, RATIO, MASS = 5.57e-6, 1.36e-7 / 5.57e-6, 0.5
MOTOR_LAG = 0.02
INERTIA = (3.65e-3, 3.68e-3, 7.03e-3)
SPEEDS = tuple(f"speed_{i + 1}" for i in range(4))
CHANNELS = (
    *(Channel(n, "m", "position", sd=1e-3) for n in ("x", "y", "z")),
    *(Channel(n, "-", "attitude", sd=2e-3) for n in ("qx", "qy", "qz", "qw")),
    *(Channel(n, "rad/s", "angular_velocity", sd=1e-2) for n in ("p", "q", "r")),
)


def path(kind: str, t: float, pace: float) -> Array:
    """Where the vehicle should be at a time, and its yaw."""
    s = pace * t
    if kind == "circle":
        return np.array([np.cos(1.5 * s) - 1.0, np.sin(1.5 * s), 1 + 0.2 * np.sin(s), 0.4 * s])
    if kind == "dash":
        return np.array([1.2 * np.sin(2.0 * s), 0.3 * np.sin(2.6 * s), 1.0, 0.4 * np.sin(s)])
    return np.array([0.6 * np.sin(s), 0.6 * np.sin(2.1 * s), 1 + 0.4 * np.sin(1.4 * s), 0.5])


def quadrotor(changes: Mapping[str, Any], weak: tuple[int, float] | None) -> Any:
    """RotorPy's vehicle, the numbers of an AscTec Hummingbird without its aerodynamics.

    Args:
        changes: Numbers that differ from the description.
        weak: Index of a rotor, and the share of thrust that it has lost.
    """
    from rotorpy.vehicles.hummingbird_params import quad_params
    from rotorpy.vehicles.multirotor import Multirotor

    class Vehicle(Multirotor):
        """With a rotor of less thrust."""

        def compute_body_wrench(self, rates: Array, speeds: Array, air: Array) -> Any:
            if weak is not None:
                speeds = np.array(speeds)
                speeds[weak[0]] *= np.sqrt(1.0 - weak[1])
            return super().compute_body_wrench(rates, speeds, air)

    still = dict.fromkeys(("c_Dx", "c_Dy", "c_Dz", "k_d", "k_z", "k_h", "k_flap"), 0.0)
    numbers = {**quad_params, **still, "tau_m": MOTOR_LAG, **changes}
    tight = {"method": "RK45", "rtol": 1e-7, "atol": 1e-9}
    return Vehicle(numbers, aero=True, integrator_kwargs=tight)


def fly(kind: str, vehicle: Any, pace: float) -> tuple[Array, Array]:
    """Records, (num_samples, 10), and commanded speeds, (num_samples, 4), in closed loop."""
    from rotorpy.controllers.quadrotor_control import SE3Control
    from rotorpy.vehicles.hummingbird_params import quad_params

    control = SE3Control(quad_params)
    control.kp_att, control.kd_att = 110.0, 19.0  # smooth at 50 commands per second
    h = 1e-3
    hover = np.full(4, np.sqrt(MASS * 9.81 / 4.0 / THRUST))
    start = path(kind, 0.0, pace)[:3]
    zero = np.zeros(3)
    state = {"x": start, "v": zero, "q": np.array([0.0, 0, 0, 1]), "w": zero}
    state |= {"wind": zero, "rotor_speeds": hover}
    rows, speeds = [], []
    for k in range(COUNT):
        t = k * STEP
        back, here, ahead = (path(kind, t + d, pace) for d in (-h, 0.0, h))
        wish = {"x": here[:3], "x_dot": (ahead - back)[:3] / (2 * h), "yaw": here[3]}
        wish |= {"x_ddot": (ahead - 2 * here + back)[:3] / h**2, "yaw_dot": 0.0, "yaw_ddot": 0.0}
        wish |= {"x_dddot": zero, "x_ddddot": zero}
        asked = np.clip(control.update(t, state, wish)["cmd_motor_speeds"], 100.0, 1400.0)
        rows.append(np.concatenate([state["x"], state["q"], state["w"]]))
        speeds.append(asked)
        state = vehicle.step(state, {"cmd_motor_speeds": asked}, STEP)
    return np.array(rows), np.array(speeds)


def flight(
    seed: int,
    *,
    changes: Mapping[str, Any] | None = None,
    weak: tuple[int, float] | None = None,
    hidden: Mapping[str, float | None] | None = None,
    described: Mapping[str, Any] | None = None,
    camera_steps: int = 0,
) -> Case:
    """Circles and dashes, flown twice; a third path for the test.

    Args:
        seed: Of the pace and of the noise.
        changes: Numbers of RotorPy that differ from the description.
        weak: Rotor that has lost a share of its thrust.
        hidden: What is hidden, with its size in the library's unit.
        described: Keys of the description that differ.
        camera_steps: Samples by which positions and attitudes are late.
    """
    rng = np.random.default_rng(seed)
    vehicle, paces = quadrotor(changes or {}, weak), 1.0 + 0.1 * rng.random(5)
    runs, flown = [], {}
    plan = (("circle", "a"), ("dash", "a"), ("circle", "b"), ("dash", "b"), ("weave", "a"))
    for order, (kind, tail) in enumerate(plan):
        name = f"{kind}_{tail}"
        record, speeds = fly(kind, vehicle, float(paces[order]))
        late = np.maximum(np.arange(COUNT) - camera_steps, 0)
        record[:, :7] = record[late, :7]
        flown[name] = record
        command = dict(zip(SPEEDS, speeds.T, strict=True))
        use = "test" if kind == "weave" else "fit"
        time: Array = STEP * np.arange(float(COUNT))
        # no repeats: each flight has its own pace
        runs.append(Run(name, time, np.zeros((COUNT, 10)), command, name, order, use))
    model = {
        "system": "multicopter",
        "frames": {"world": "ENU", "body": "FLU"},
        "mass": {"value": MASS, "percent": 1},
        "inertia": list(INERTIA),
        "rotors": [
            {"at": [float(v) for v in p], "spin": s} for p, s in zip(PLACES, SPINS, strict=True)
        ],
        "thrust": {"coefficient": THRUST},
        "torque_ratio": RATIO,
        "motor_lag": MOTOR_LAG,
        "commands": {"columns": list(SPEEDS), "as": "speed"},
        "sensors": {
            "position": ["x", "y", "z"],
            "quaternion": {"columns": ["qx", "qy", "qz", "qw"], "order": "xyzw"},
            "body_rates": ["p", "q", "r"],
        },
        **(described or {}),
    }
    model = {k: v for k, v in model.items() if v is not None}
    of: Callable[[Run], Array] = lambda run: flown[run.name]  # noqa: E731
    study, clean = recorded("flight", CHANNELS, runs, of, model, rng)
    return Case(study, clean, "single" if hidden else "null", hidden or {})


def _moved(x: float) -> dict[str, Any]:
    """Rotors as seen from a center of mass that lies forward by x [m]."""
    return {
        "rotor_pos": {f"r{i + 1}": np.array(p) - np.array([x, 0, 0]) for i, p in enumerate(PLACES)}
    }


FLIGHTS: dict[str, Maker] = {
    "flight_as_described": flight,
    "flight_body_in_still_air": partial(
        flight,
        changes={"c_Dx": 0.04, "c_Dy": 0.04, "c_Dz": 0.04},
        hidden={"parasitic_drag": 0.04},
    ),
    "flight_weak_rotor": partial(flight, weak=(1, 0.06), hidden={"weak_rotor_2": 0.06}),
    "flight_slow_motors": partial(flight, described={"motor_lag": None}, hidden={"lag": 0.02}),
    "flight_rotor_drag": partial(
        flight, changes={"k_d": 1.2e-4}, hidden={"rotor_speed_drag": None}
    ),
    "flight_heavy_nose": partial(flight, changes=_moved(0.004), hidden={"center_of_mass": None}),
}
