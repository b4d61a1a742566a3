"""Virtual laboratory of a quadcopter, flown by its own controller and tracked by cameras.

World frame NED, body frame forward-right-down, quaternion (w, x, y, z) world from body. Integrated
by the classical Runge-Kutta method at 2 ms on a plain numpy state; rotor commands are held for
10 ms. The flight controller sees the true state and knows the nominal vehicle only, so that it
flies with whatever effect is hidden; the study has the rotor commands that came out. As in any
flight with feedback, the commands of two flights of one maneuver differ a little; they are one
group all the same, for what a model leaves of them is comparable.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from diffsim.data.study import Channel
from labs.virtual.common import Base, Lab, LabEffect, Plan, size_of, vector_of
from labs.virtual.maneuvers import MANEUVERS, Path
from labs.virtual.quaternions import angles, cross, matrix, product

Array = NDArray[np.float64]

GRAVITY = 9.81
RATE_HZ, DURATION_S, SUBSTEPS = 100.0, 4.0, 5
INERTIA = np.array([0.015, 0.016, 0.028])  # [kg m^2], principal
ARM_M, MAX_THRUST_N, RADIUS_M, TORQUE_RATIO_M = 0.20, 8.0, 0.127, 0.0147
ROTORS_M = ARM_M * np.array([[1.0, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]]) / np.sqrt(2.0)
SPINS = np.array([1.0, -1.0, 1.0, -1.0])  # +1: reaction torque along the thrust (upwards)
FULL_V = 12.4
SPEED_PER_ROOT = 284.0  # rotor speed over the root of its thrust [rad/s / N^0.5]

_SENSORS = (
    *((f"{axis}_m", "m", "position", 1e-3) for axis in ("north", "east", "down")),
    *((f"{angle}_rad", "rad", "angle", 2e-3) for angle in ("roll", "pitch", "yaw")),
    *((f"rate_{axis}_rad_s", "rad/s", "angular_velocity", 0.01) for axis in "xyz"),
    *((f"accelerometer_{axis}_m_s2", "m/s2", "specific_force", 0.08) for axis in "xyz"),
)


class CopterLab(Lab):
    """See the module; channels are camera poses, gyroscope and accelerometer."""

    system: ClassVar[str] = "copter"
    channels: ClassVar[tuple[Channel, ...]] = tuple(Channel(*s) for s in _SENSORS)
    base: ClassVar[dict[str, Base]] = {
        "mass": Base(1.4, 0.02, "kg"),
        "thrust_gain": Base(1.0, 0.03, "-"),
        "inertia_scale": Base(1.0, 0.05, "-"),
        "torque_ratio": Base(TORQUE_RATIO_M, 0.05, "m"),
    }
    effects: ClassVar[dict[str, LabEffect]] = {
        "body_drag": LabEffect("N s/m", 0.25, "-D v across the rotor axis, in the body frame"),
        "parasitic_drag": LabEffect("N s^2/m^2", 0.06, "-c |v| v"),
        "wind": LabEffect("N", 0.3, "constant force in the world, north and east", 2),
        "body_tilt": LabEffect("rad", 0.02, "thrust axis turned about body x and y", 2),
        "voltage_exponent": LabEffect("-", 1.0, "thrust times (voltage / 12.4 V)^size"),
        "weak_rotor": LabEffect("-", 0.05, "thrust of one rotor times 1 - size", 4),
        "center_of_mass": LabEffect("m", 0.005, "forward and right of where it should be", 2),
        "ground_effect": LabEffect("-", 1.0, "thrust of a rotor times 1 + size (R / 4 z)^2"),
        "inflow": LabEffect("s/m", 0.03, "thrust times 1 - size (climb speed along the axis)"),
        "thrust_curvature": LabEffect("-", 0.1, "thrust u times 1 + size (u - 3.4 N) / 8 N"),
        "gyroscopic": LabEffect("kg m^2", 4e-5, "spin momentum of rotors, speed ~ sqrt(thrust)"),
        "lag": LabEffect("s", 0.03, "first-order lag of the thrust"),
        "delay": LabEffect("s", 0.02, "thrust late by a dead time"),
        "quantization": LabEffect("N", 0.5, "commands change the thrust in steps of this size"),
        "accelerometer_scale": LabEffect("-", 0.02, "accelerometer times 1 + size"),
        "gyro_offset": LabEffect("rad/s", 0.02, "constant reading added, x, y and z", 3),
        "updraught": LabEffect("N", 0.8, "lift above a place, 0.5 m wide", outside=True),
    }

    def __init__(self, turns: bool = True):
        """A laboratory.

        Args:
            turns: Whether maneuvers turn about the yaw axis; without, what is fixed in the world
                and what is fixed in the body look alike.
        """
        self.turns = turns

    def plans(self, rng: np.random.Generator) -> list[Plan]:
        t = np.arange(round(RATE_HZ * DURATION_S)) / RATE_HZ
        fit = ("hover_yaw", "sprint", "climb")
        return [
            Plan(f"{name}_{flight}", name, "fit", t, {}, _setup(name))
            for flight in "ab"
            for name in fit
        ] + [Plan("figure_eight", "figure_eight", "test", t, {}, _setup("figure_eight"))]

    def nuisances(self, rng: np.random.Generator) -> dict[str, Any]:
        return {
            "camera_to_body_rad": rng.normal(0.0, 3e-3, 3),
            "accelerometer_offset_m_s2": rng.normal(0.0, 0.03, 3),
        }

    def measure(self, plan: Plan, truth: dict[str, Any]) -> tuple[Array, dict[str, Array]]:
        """Readings of cameras and inertial sensors, and the thrusts that were commanded."""
        name = list(MANEUVERS)[int(plan.setup["maneuver"])]
        rows, commands = _Flight(truth, self._path(name)).run(plan.time_s)
        rows[:, 3:6] += truth["nuisances"]["camera_to_body_rad"]
        rows[:, 6:9] += vector_of(truth, "gyro_offset", 3)
        rows[:, 9:12] *= 1.0 + size_of(truth, "accelerometer_scale")
        rows[:, 9:12] += truth["nuisances"]["accelerometer_offset_m_s2"]
        recorded = {f"command_{i}_N": commands[:, i] for i in range(4)}
        return rows, {**recorded, "voltage_V": _voltage(plan.time_s)}

    def _path(self, name: str) -> Path:
        path = MANEUVERS[name]
        return path if self.turns else lambda t: (path(t)[0], 0.0)

    def facts(self) -> dict[str, Any]:
        return {
            "frame": "NED world, forward-right-down body; roll, pitch, yaw: intrinsic z-y-x",
            "vehicle": {
                "inertia_kg_m2": np.diag(INERTIA),
                "positions_m": ROTORS_M,
                "directions": np.tile([0.0, 0.0, -1.0], (4, 1)),
                "spins": SPINS,
                "radii_m": np.full(4, RADIUS_M),
                "max_thrusts_N": np.full(4, MAX_THRUST_N),
            },
            "thrust_coefficient_N_s2": SPEED_PER_ROOT**-2,
            "gravity_m_s2": GRAVITY,
            "command": "thrusts held from one sample to the next",
            "accelerometer": "specific force in the body frame, mean over the sample before",
            "nuisances": {"camera_to_body_sd_rad": 3e-3, "accelerometer_offset_sd_m_s2": 0.03},
            "maneuvers": list(MANEUVERS),
        }


class _Flight:
    """One flight: a controller on the nominal vehicle, the true vehicle below it.

    State: position, quaternion, velocity, body rates, thrusts, (17,).
    """

    def __init__(self, truth: dict[str, Any], path: Path):
        self.truth, self.path = truth, path
        base = truth["base"]
        self.mass = base["mass"]
        self.inertia = INERTIA * base["inertia_scale"]
        self.torque_ratio = base["torque_ratio"]
        weak = 1.0 - vector_of(truth, "weak_rotor", 4)
        self.gains = base["thrust_gain"] * truth["gain"] * weak
        forward, right = vector_of(truth, "center_of_mass", 2)
        self.arms = ROTORS_M - np.array([forward, right, 0.0])
        self.axis = _thrust_axis(vector_of(truth, "body_tilt", 2))
        self.wind = np.array([*vector_of(truth, "wind", 2), 0.0])
        self.lag, self.delay = size_of(truth, "lag"), size_of(truth, "delay")
        nominal = np.vstack([np.ones(4), -ROTORS_M[:, 1], ROTORS_M[:, 0], -TORQUE_RATIO_M * SPINS])
        self.mixer = np.linalg.inv(nominal)

    def start(self) -> Array:
        """State at time zero: level, nearly at rest, rotors at hover."""
        place, _ = self.path(0.0)
        hover = np.full(4, self.mass * GRAVITY / 4.0)
        x = np.concatenate([place, [1.0, 0.0, 0.0, 0.0], np.zeros(6), hover])
        rng = np.random.default_rng(self.truth["seed"])
        x[0:3] += rng.normal(0.0, 0.02, 3)  # nobody starts on the spot
        x[7:10] += rng.normal(0.0, 0.02, 3)
        return x

    def run(self, time_s: Array) -> tuple[Array, Array]:
        """Sensor rows (num_samples, 12) and commands (num_samples, 4)."""
        x = self.start()
        hover = x[13:].copy()
        h = 1.0 / RATE_HZ / SUBSTEPS
        rows, commands = np.empty((len(time_s), 12)), np.empty((len(time_s), 4))
        asked = [hover] * (3 + int(self.delay / h))  # at earlier substeps, newest last
        force = self._rate(x, 0.0, hover)[7:10] - np.array([0.0, 0.0, GRAVITY])
        specific_force = matrix(x[3:7]).T @ force  # as if it had gone on like that before
        for i, now in enumerate(time_s):
            commands[i] = self._control(x, now)
            rows[i] = np.concatenate([x[0:3], angles(x[3:7]), x[10:13], specific_force])
            specific_force = np.zeros(3)
            for k in range(SUBSTEPS):
                asked.append(commands[i])
                late, part = divmod(self.delay / h, 1.0)
                old = -1 - int(late)
                held = (1.0 - part) * asked[old] + part * asked[old - 1]  # mean over the substep
                before = x
                x = self._step(x, held, h, now + k * h)
                change = (x[7:10] - before[7:10]) / h - np.array([0.0, 0.0, GRAVITY])
                half_way = matrix(before[3:7] + x[3:7])
                specific_force += half_way.T @ change / SUBSTEPS
        return rows, commands

    def _step(self, x: Array, asked: Array, h: float, t: float) -> Array:
        x = x.copy()
        if self.lag <= 0.0:
            x[13:] = asked
        k1 = self._rate(x, t, asked)
        k2 = self._rate(x + 0.5 * h * k1, t + 0.5 * h, asked)
        k3 = self._rate(x + 0.5 * h * k2, t + 0.5 * h, asked)
        k4 = self._rate(x + h * k3, t + h, asked)
        x = x + h / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)
        x[3:7] /= np.linalg.norm(x[3:7])
        return x

    def _rate(self, x: Array, t: float, asked: Array) -> Array:
        v, w = x[7:10], x[10:13]
        rot = matrix(x[3:7])
        u = self._thrusts(x, rot, t)
        force = rot @ (self.axis * u.sum()) + self._air(v, rot, x[0:3])
        torque = cross(self.arms.T @ u, self.axis)
        torque += self.torque_ratio * float(SPINS @ u) * self.axis
        # a rotor that is turned one way turns its body the other: reaction up, spin down (+z)
        speeds = SPEED_PER_ROOT * np.sqrt(np.maximum(u, 0.0))
        spin = size_of(self.truth, "gyroscopic") * float(SPINS @ speeds)
        momentum = self.inertia * w + np.array([0.0, 0.0, spin])
        out = np.zeros(17)
        out[0:3] = v
        out[3:7] = 0.5 * product(x[3:7], np.array([0.0, *w]))
        if self.lag > 0.0:
            out[13:] = (asked - x[13:]) / self.lag
        out[7:10] = force / self.mass + np.array([0.0, 0.0, GRAVITY])
        out[10:13] = (torque - cross(w, momentum)) / self.inertia
        return out

    def _thrusts(self, x: Array, rot: Array, t: float) -> Array:
        """Thrusts that the rotors really give [N]."""
        truth, u = self.truth, x[13:]
        if (grain := size_of(truth, "quantization")) > 0.0:
            u = grain * np.round(u / grain)
        u = self.gains * np.clip(u, 0.0, MAX_THRUST_N)
        u = u * (1.0 + size_of(truth, "thrust_curvature") * (u - 3.4) / MAX_THRUST_N)
        u = u * float(_voltage(np.array(t)) / FULL_V) ** size_of(truth, "voltage_exponent")
        u = u * (1.0 - size_of(truth, "inflow") * -float(rot[:, 2] @ x[7:10]))
        height = np.maximum(-x[2] - self.arms @ rot[2], RADIUS_M)
        return u * (1.0 + size_of(truth, "ground_effect") * (RADIUS_M / (4.0 * height)) ** 2)

    def _air(self, v: Array, rot: Array, place: Array) -> Array:
        truth = self.truth
        force = self.wind - size_of(truth, "parasitic_drag") * np.linalg.norm(v) * v
        body = rot.T @ v
        force = force - size_of(truth, "body_drag") * (rot @ np.array([body[0], body[1], 0.0]))
        near = float(np.exp(-0.5 * ((place[0] - 0.8) ** 2 + place[1] ** 2) / 0.5**2))
        return force - np.array([0.0, 0.0, size_of(truth, "updraught") * near])

    def _control(self, x: Array, now: float) -> Array:
        """Thrusts for the nominal vehicle: acceleration, attitude and rate loops."""
        ahead, yaw = self.path(now)
        h = 1e-3
        before, after = self.path(now - h)[0], self.path(now + h)[0]
        wish = (after - 2 * ahead + before) / h**2
        wish = wish + 4.0 * (ahead - x[0:3]) + 3.0 * ((after - before) / (2 * h) - x[7:10])
        lift = np.array([0.0, 0.0, GRAVITY]) - wish  # wanted along body z (down): minus the thrust
        lift = lift * min(1.0, 2.0 * GRAVITY / float(np.linalg.norm(lift)))
        z = lift / np.linalg.norm(lift)
        y = cross(z, np.array([np.cos(yaw), np.sin(yaw), 0.0]))
        y /= np.linalg.norm(y)
        aim = np.column_stack([cross(y, z), y, z])
        rot = matrix(x[3:7])
        twist = 0.5 * (aim.T @ rot - rot.T @ aim)
        error = np.array([twist[2, 1], twist[0, 2], twist[1, 0]])
        gain = np.array([120.0, 120.0, 30.0])
        turn = INERTIA * (-gain * error - np.array([20.0, 20.0, 8.0]) * x[10:13])
        total = CopterLab.base["mass"].value * float(lift @ rot[:, 2])
        return np.clip(self.mixer @ np.array([total, *turn]), 0.2, MAX_THRUST_N)


def _setup(name: str) -> dict[str, float]:
    return {"maneuver": float(list(MANEUVERS).index(name))}


def _voltage(t: Array) -> Array:
    """Measured battery voltage over a flight [V]."""
    return FULL_V - 0.25 * t


def _thrust_axis(tilt: Array) -> Array:
    """Unit thrust, up, turned about body x and then y."""
    a, b = tilt
    about_x = np.array([0.0, np.sin(a), -np.cos(a)])
    x, y, z = about_x
    return np.array([x * np.cos(b) + z * np.sin(b), y, z * np.cos(b) - x * np.sin(b)])
