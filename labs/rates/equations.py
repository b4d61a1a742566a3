"""Rigs whose equations stand in their study; recordings are made by scipy at a tight tolerance.

What makes a recording shares nothing with what is fitted to it: steps are chosen by the error,
friction is sharp, and what a drive or an instrument does is computed on a grid of a millisecond.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import integrate

from diffsim.data.study import Channel, Run, Study
from labs.outside.mechanisms import PENDULUM_MODEL
from labs.rates.rig import Cause, Recorded, Size
from labs.rates.troubles import TROUBLES, sample_times, with_noise

Array = NDArray[np.float64]
Course = Callable[[Array], Array]  # between -1 and 1
Force = Callable[[int, float, float], float]  # place, position, velocity -> force
#: Time, state, input, numbers, what acts besides -> rates.
Rates = Callable[[Array, float, Mapping[str, float], Force], list[float]]
FINE_STEPS = 2000  # of the grid of drives and instruments, per recording
RTOL, ATOL = 1e-8, 1e-10
SHARPNESS = 1e-3  # of the usual speed, below which dry friction of a recording fades
DRAWN_SD = 1.5  # prior sd within which true numbers are drawn

DRIVE, FORCE, READING = "drive", "force", "reading"


@dataclass(frozen=True)
class Acts:
    """Where a cause acts, and what it may be called."""

    on: str  # drive, force at a place, or reading of a channel
    form: str  # what it does, a key of the tables below
    cause: Cause  # what libraries call it, and how large it may be
    at: int = 0  # number of the place or the channel


@dataclass(frozen=True)
class EquationRig:
    """A rig of ordinary differential equations with one input."""

    name: str  # of the rig
    model: Mapping[str, Any]  # description that goes into its study, with the data sheet
    rates: Rates  # the same equations for scipy
    shown: Callable[[Array, Mapping[str, float]], Array]  # state, numbers -> what the channels show
    channels: tuple[Channel, ...]  # channels with the noise of their sensors
    start: tuple[float, ...]  # state at rest
    step_s: float  # time between samples
    count: int  # number of samples of a run
    reach: float  # largest command
    acts: Mapping[str, Acts]  # causes by the library's names
    speed: float = 1.0  # usual velocity of the places
    # whether commands are around a level above zero, as of a pump, instead of around it
    lifted: bool = False
    places: tuple[tuple[int, int], ...] = ((0, 1),)
    setup_file: Path | None = None  # model of its own; none
    disturbances: tuple[str, ...] = field(default=TROUBLES)  # troubles of its recordings

    @property
    def causes(self) -> Mapping[str, Cause]:
        """What it can hide."""
        return {name: act.cause for name, act in self.acts.items()}

    def record(self, seed: int, hidden: Mapping[str, Size], disturbance: str) -> Recorded:
        """Two runs of each command, and one of another kind for the test."""
        truth, paces, noise = (
            np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3)
        )
        base = {name: _drawn(truth, said) for name, said in self.model["parameters"].items()}
        duration = self.step_s * (self.count - 1)
        planned = []
        for group, tail, use, course in _plan(paces, duration):
            time = sample_times(noise, self.count, self.step_s, disturbance)
            planned.append((group, tail, use, time, self._command(course, time)))
        # shares of the largest command are those of the runs that a diagnosis fits
        reach = max(float(np.abs(u).max()) for _, _, use, _, u in planned if use == "fit")
        runs, clean = [], []
        for order, (group, tail, use, time, command) in enumerate(planned):
            seen = self._seen(time, command, base, hidden, reach)
            run = Run(group + tail, time, seen, {self._input: command}, group, order, use)
            noisy, exact = with_noise(noise, run, self.channels, disturbance)
            runs.append(noisy)
            clean.append(exact)
        study = Study(self.name, "ode", self.channels, tuple(runs), model=self.model)
        whole = Study(self.name, "ode", self.channels, tuple(clean), model=self.model)
        return Recorded(study, whole, base)

    def _command(self, course: Course, time: Array) -> Array:
        """A course as a command, which begins at rest."""
        middle = 0.5 * self.reach if self.lifted else 0.0
        share = 0.45 if self.lifted else 1.0
        ramp = np.minimum(time / (0.05 * self.step_s * (self.count - 1)), 1.0)
        return middle + share * self.reach * ramp * course(time)

    @property
    def _input(self) -> str:
        return str(self.model["inputs"][0])

    def _seen(
        self,
        time: Array,
        command: Array,
        base: Mapping[str, float],
        hidden: Mapping[str, Size],
        reach: float,
    ) -> Array:
        """What the channels show, (num_samples, num_channels)."""
        acts = [(self.acts[name], size[0]) for name, size in hidden.items()]
        fine = np.linspace(0.0, time[-1], FINE_STEPS)
        drive = np.interp(fine, time, command)
        for act, size in acts:
            if act.on == DRIVE:
                drive = DRIVES[act.form](fine, drive, size, reach)
        forces = [(a.at, FORCES[a.form], size) for a, size in acts if a.on == FORCE]

        def push(place: int, x: float, v: float) -> float:
            return sum(f(x, v, size, self.speed) for at, f, size in forces if at == place)

        scale = (FINE_STEPS - 1) / fine[-1]

        def slope(t: float, y: Array) -> list[float]:
            at = min(max(t * scale, 0.0), FINE_STEPS - 1.000001)
            k = int(at)
            u = float(drive[k] + (at - k) * (drive[k + 1] - drive[k]))
            return self.rates(y, u, base, push)

        is_sharp = any(a.form in SHARP for a, _ in acts)
        found = integrate.solve_ivp(
            slope,
            (0.0, fine[-1]),
            self._settled(base),
            method="LSODA" if is_sharp else "DOP853",
            t_eval=fine,
            rtol=RTOL,
            atol=ATOL,
            max_step=fine[-1] / 50.0,
        )
        if not found.success:
            raise RuntimeError(f"{self.name}: {found.message} with {dict(hidden)}")
        shown = self.shown(found.y.T, base)
        for act, size in acts:
            if act.on == READING:
                column = READINGS[act.form](fine, shown[:, act.at], size)
                shown[:, act.at] = column
        return np.column_stack([_at(time, fine, column) for column in shown.T])

    def _settled(self, base: Mapping[str, float]) -> Array:
        """State at rest under the first command."""
        start = np.array(self.start)
        if not self.lifted:
            return start
        u, still = 0.5 * self.reach, lambda *_: 0.0
        ended = integrate.solve_ivp(
            lambda t, y: self.rates(y, u, base, still),
            (0.0, 1e4 * self.step_s),
            start,
            method="LSODA",
            rtol=1e-10,
            atol=1e-12,
        )
        settled: Array = ended.y[:, -1]
        return settled


def _at(time: Array, fine: Array, column: Array) -> Array:
    from scipy.interpolate import CubicSpline

    values: Array = CubicSpline(fine, column)(time)
    return values


def _drawn(rng: np.random.Generator, said: Mapping[str, Any]) -> float:
    """A true number near its data sheet."""
    z = float(np.clip(rng.standard_normal(), -DRAWN_SD, DRAWN_SD))
    value = float(said["value"])
    return (
        value * float(np.exp(z * said["percent"] / 100.0))
        if "percent" in said
        else (value + z * float(said["sd"]))
    )


def _plan(rng: np.random.Generator, duration: float) -> list[tuple[str, str, str, Course]]:
    """Group, tail, use and course of each run, the courses between -1 and 1."""
    a, b = 1.0 + 0.25 * rng.random(2)
    w = 2.0 * np.pi / duration
    corners = duration * np.array([0.0, 0.06, 0.09, 0.4, 0.46, 0.72, 0.76, 1.0])
    levels = [0.0, 0.0, 0.85, 0.85, -0.7, -0.7, 0.1, 0.1]

    def sine(t: Array) -> Array:
        return np.asarray(0.9 * np.sin(2.0 * a * w * t))

    def steps(t: Array) -> Array:
        return np.interp(t, corners, levels)

    def chirp(t: Array) -> Array:
        return np.asarray(np.sin(w * (1.2 + 2.5 * b * t / duration) * t))

    def mixed(t: Array) -> Array:
        return np.asarray(0.5 * (np.sin(1.6 * w * t) + np.sin(4.1 * w * t + 0.4)))

    return [
        *((name, tail, "fit", course)
          for tail in ("_a", "_b")
          for name, course in (("sine", sine), ("steps", steps), ("chirp", chirp))),
        ("mixed", "", "test", mixed),
    ]  # fmt: skip


# What a drive does on a fine grid: (time, command, size, reach) -> command ------------------------


def _lagged(time: Array, u: Array, size: float) -> Array:
    """Exactly, for straight lines between the places of the grid."""
    from scipy.signal import lfilter

    if size <= 0.0:
        return u
    h = time[1] - time[0]
    decay = np.exp(-h / size)
    ahead = 1.0 - size / h * (1.0 - decay)
    gain = np.array([ahead, 1.0 - decay - ahead])
    out: Array = lfilter(gain, [1.0, -decay], u - u[0]) + u[0]
    return out


def _late(time: Array, u: Array, size: float) -> Array:
    return np.interp(time - size, time, u)


def _play(u: Array, half: float) -> Array:
    """Play of ``half`` on either side, which rests until it is taken up."""
    out = np.empty_like(u)
    at = u[0]
    for k, value in enumerate(u):
        at = min(max(at, value - half), value + half)
        out[k] = at
    return out


def _slow(time: Array, u: Array, size: float) -> Array:
    """No faster than 1/size."""
    if size <= 0.0:
        return u
    most = (time[1] - time[0]) / size
    out = np.empty_like(u)
    at = u[0]
    for k, value in enumerate(u):
        at += min(max(value - at, -most), most)
        out[k] = at
    return out


Drive = Callable[[Array, Array, float, float], Array]
DRIVES: Mapping[str, Drive] = {
    "lag": lambda t, u, size, reach: _lagged(t, u, size),
    "delay": lambda t, u, size, reach: _late(t, u, size),
    "command_offset": lambda t, u, size, reach: u + size,
    "dead_band": lambda t, u, size, reach: np.sign(u) * np.maximum(np.abs(u) - size, 0.0),
    "backlash": lambda t, u, size, reach: _play(u, size),
    "saturation": lambda t, u, size, reach: np.clip(u, -(1 - size) * reach, (1 - size) * reach),
    "gain_slope": lambda t, u, size, reach: u * (1.0 + size * np.abs(u)),
    "rate_limit": lambda t, u, size, reach: _slow(t, u, size),
}
# What acts at a place: (position, velocity, size, usual speed) -> force ---------------------------
FORCES: Mapping[str, Callable[[float, float, float, float], float]] = {
    "dry_friction": lambda x, v, size, speed: -size * float(np.tanh(v / (SHARPNESS * speed))),
    "square_drag": lambda x, v, size, speed: -size * v * abs(v),
    "viscous_friction": lambda x, v, size, speed: -size * v,
    "added_spring": lambda x, v, size, speed: -size * x,
    "cubic_stiffness": lambda x, v, size, speed: -size * x**3,
    "quadratic_stiffness": lambda x, v, size, speed: -size * x**2,
    "constant_force": lambda x, v, size, speed: size,
    "linear_leak": lambda x, v, size, speed: -size * max(x, 0.0),
    "root_outflow": lambda x, v, size, speed: -size * max(x, 0.0) ** 0.5,
}
SHARP = ("dry_friction",)
# What an instrument does to a channel: (time, readings, size) -> readings -------------------------
READINGS: Mapping[str, Callable[[Array, Array, float], Array]] = {
    "sensor_scale": lambda t, y, size: (1.0 + size) * y,
    "sensor_offset": lambda t, y, size: y + size,
    "sensor_drift": lambda t, y, size: y + size * t / t[-1],
    "sensor_lag": _lagged,
    "sensor_delay": _late,
    "sensor_backlash": lambda t, y, size: _play(y, size),
}


def _act(on: str, form: str, typical: float, *names: str, at: int = 0, **more: Any) -> Acts:
    return Acts(on, form, Cause(typical, names=names, **more), at)


drive, force, reading = (partial(_act, on) for on in (DRIVE, FORCE, READING))


# The rigs -----------------------------------------------------------------------------------------


def _cart(y: Array, u: float, p: Mapping[str, float], push: Force) -> list[float]:
    x, v = y
    return [v, (u - p["damping"] * v - p["spring"] * x + push(0, x, v)) / p["mass"]]


CART = EquationRig(
    "cart",
    {
        "system": "ode",
        "states": {"x": "0 m", "v": "0 m/s"},
        "rates": {"x": "v", "v": "(force_N - damping*v - spring*x)/mass"},
        "inputs": ["force_N"],
        "parameters": {
            "mass": {"value": 1.2, "percent": 7, "unit": "kg"},
            "damping": {"value": 1.0, "percent": 50, "unit": "N s/m"},
            "spring": {"value": 40.0, "percent": 15, "unit": "N/m"},
        },
        "readings": {"place_m": "x", "speed_m_s": "v"},
        "places": [{"position": "x", "velocity": "v", "inertia": "mass"}],
    },
    _cart,
    lambda y, p: y[:, :2].copy(),
    (
        Channel("place_m", "m", "position", sd=1e-3),
        Channel("speed_m_s", "m/s", "velocity", sd=1e-2),
    ),
    (0.0, 0.0),
    0.02,
    150,
    3.0,
    {
        "dry_friction": force("dry_friction", 0.05),
        "square_drag": force("square_drag", 1.0),
        "cubic_stiffness": force("cubic_stiffness", 500.0, signed=True),
        "constant_force": force("constant_force", 0.1, "constant_force", "command_offset",
                                signed=True),
        "lag": drive("lag", 0.02),
        "delay": drive("delay", 0.01),
        "dead_band": drive("dead_band", 0.1),
        "backlash": drive("backlash", 0.1),
        "saturation": drive("saturation", 0.2, most=0.7),
        "gain_slope": drive("gain_slope", 0.03, signed=True, most=0.2),
        "sensor_scale_of_velocity": reading("sensor_scale", 0.03, signed=True, at=1, most=0.4),
        "sensor_drift_of_position": reading("sensor_drift", 2e-3, signed=True),
    },
    speed=0.3,
)  # fmt: skip


def _wheel(y: Array, u: float, p: Mapping[str, float], push: Force) -> list[float]:
    a, w = y
    return [w, (p["gain"] * u - p["damping"] * w + push(0, a, w)) / p["inertia"]]


WHEEL = EquationRig(
    "wheel",
    {
        "system": "ode",
        "states": {"angle": "0 rad", "rate": "0 rad/s"},
        "rates": {"angle": "rate", "rate": "(gain*current_A - damping*rate)/inertia"},
        "inputs": ["current_A"],
        "parameters": {
            "inertia": {"value": 2e-3, "percent": 10, "unit": "kg m^2"},
            "damping": {"value": 4e-3, "percent": 30, "unit": "N m s/rad"},
            "gain": {"value": 0.05, "percent": 3, "unit": "N m/A"},
        },
        "readings": {"angle_rad": "angle"},
        "places": [
            {"name": "shaft", "position": "angle", "velocity": "rate", "inertia": "inertia",
             "unit": "N m", "position_unit": "rad"},
        ],
    },
    _wheel,
    lambda y, p: y[:, :1].copy(),
    (Channel("angle_rad", "rad", "angle", sd=0.02),),
    (0.0, 0.0),
    0.02,
    150,
    1.0,
    {
        "dry_friction_at_shaft": force("dry_friction", 2e-3),
        "square_drag_at_shaft": force("square_drag", 1e-4),
        "added_spring_at_shaft": force("added_spring", 1e-3),
        "constant_force_at_shaft": force("constant_force", 1e-3, "constant_force_at_shaft",
                                         "command_offset", signed=True),
        "lag": drive("lag", 0.02, "lag", "sensor_lag"),
        "delay": drive("delay", 0.01),
        "dead_band": drive("dead_band", 0.05),
        "saturation": drive("saturation", 0.2, most=0.7),
        "gain_slope": drive("gain_slope", 0.1, signed=True, most=0.5),
        "sensor_drift": reading("sensor_drift", 0.03, "sensor_drift_of_angle", signed=True),
    },
    speed=5.0,
)  # fmt: skip


def _pendulum(y: Array, u: float, p: Mapping[str, float], push: Force) -> list[float]:
    a, w = y
    moment = u - p["damping"] * w - p["weight"] * np.sin(a) + push(0, a, w)
    return [w, moment / p["inertia"]]


PENDULUM = EquationRig(
    "pendulum",
    PENDULUM_MODEL,
    _pendulum,
    lambda y, p: y[:, :1].copy(),
    (Channel("angle_rad", "rad", "angle", sd=3e-3),),
    (0.0, 0.0),
    0.02,
    200,
    0.9,
    {
        "dry_friction_at_hinge": force("dry_friction", 0.02),
        "square_drag_at_hinge": force("square_drag", 0.02),
        "added_spring_at_hinge": force("added_spring", 0.2),
        "constant_force_at_hinge": force("constant_force", 0.05, "constant_force_at_hinge",
                                         "command_offset", signed=True),
        "cubic_stiffness_at_hinge": force("cubic_stiffness", 0.3, signed=True),
        "lag": drive("lag", 0.02),
        "delay": drive("delay", 0.02),
        "backlash": drive("backlash", 0.05),
        "saturation": drive("saturation", 0.2, most=0.7),
        "dead_band": drive("dead_band", 0.05),
        "sensor_drift": reading("sensor_drift", 0.01, "sensor_drift_of_angle", signed=True),
        "sensor_backlash": reading("sensor_backlash", 5e-3),
    },
    speed=2.0,
)  # fmt: skip


def _tanks(y: Array, u: float, p: Mapping[str, float], push: Force) -> list[float]:
    h, g = max(y[0], 0.0), max(y[1], 0.0)
    out = p["upper_hole"] * h**0.5
    last = p["lower_hole"] * g**0.5
    return [p["gain"] * u - out + push(0, h, 0.0), out - last + push(1, g, 0.0)]


TANKS = EquationRig(
    "tanks",
    {
        "system": "ode",
        "states": {
            "upper": {"value": 0.25, "sd": 0.1, "unit": "m", "lower": 0.0, "upper": 3.0},
            "lower": {"value": 0.25, "sd": 0.1, "unit": "m", "lower": 0.0, "upper": 3.0},
        },
        "inputs": ["pump"],
        "parameters": {
            "upper_hole": {"value": 0.02, "percent": 20, "unit": "m^0.5/s"},
            "lower_hole": {"value": 0.02, "percent": 20, "unit": "m^0.5/s"},
            "gain": {"value": 0.02, "percent": 10, "unit": "m/s"},
        },
        "define": {
            "outflow": "upper_hole*sqrt(max(upper, 0))",
            "last_outflow": "lower_hole*sqrt(max(lower, 0))",
            "inflow": "gain*pump",
        },
        "rates": {"upper": "inflow - outflow", "lower": "outflow - last_outflow"},
        "stores": [
            {"name": "upper_tank", "level": "upper", "into": "lower_tank", "unit": "m"},
            {"name": "lower_tank", "level": "lower", "unit": "m"},
        ],
        "laws": [
            {"name": "outflow", "of": "upper", "unit": "m/s", "of_unit": "m"},
            {"name": "inflow", "of": "pump", "unit": "m/s"},
        ],
        "readings": {"upper_m": "upper", "lower_m": "lower"},
    },
    _tanks,
    lambda y, p: y[:, :2].copy(),
    (
        Channel("upper_m", "m", "position", sd=2e-3),
        Channel("lower_m", "m", "position", sd=2e-3),
    ),
    (0.25, 0.25),
    2.0,
    150,
    1.0,
    {
        "linear_leak_of_lower_tank": force("linear_leak", 1e-3, at=1),
        "leak_of_upper_tank": force("root_outflow", 1e-3, known=False),
        "lag": drive("lag", 5.0),
        "delay": drive("delay", 3.0),
        "saturation": drive("saturation", 0.2, most=0.6),
        "gain_slope": drive("gain_slope", 0.1, signed=True, most=0.6),
        "sensor_scale_of_lower_m": reading("sensor_scale", 0.03, signed=True, at=1, most=0.4),
    },
    lifted=True,
)  # fmt: skip


def _masses(y: Array, u: float, p: Mapping[str, float], push: Force) -> list[float]:
    x, v, z, w = y
    pull = p["coupling"] * (z - x) + p["loss"] * (w - v)
    first = (u - p["spring"] * x - p["damping"] * v + pull + push(0, x, v)) / p["mass"]
    return [v, first, w, (-pull + push(1, z, w)) / p["load"]]


MASSES = EquationRig(
    "masses",
    {
        "system": "ode",
        "states": {"x": "0 m", "v": "0 m/s", "z": "0 m", "w": "0 m/s"},
        "rates": {
            "x": "v",
            "v": "(force_N - spring*x - damping*v + pull)/mass",
            "z": "w",
            "w": "-pull/load",
        },
        "define": {"pull": "coupling*(z - x) + loss*(w - v)"},
        "inputs": ["force_N"],
        "parameters": {
            "mass": {"value": 1.0, "percent": 5, "unit": "kg"},
            "load": {"value": 0.5, "percent": 5, "unit": "kg"},
            "spring": {"value": 30.0, "percent": 15, "unit": "N/m"},
            "coupling": {"value": 60.0, "percent": 15, "unit": "N/m"},
            "damping": {"value": 1.0, "percent": 40, "unit": "N s/m"},
            "loss": {"value": 0.3, "percent": 40, "unit": "N s/m"},
        },
        "readings": {"drive_m": "x", "load_m": "z"},
        "places": [
            {"name": "drive", "position": "x", "velocity": "v", "inertia": "mass"},
            {"name": "load", "position": "z", "velocity": "w", "inertia": "load"},
        ],
    },
    _masses,
    lambda y, p: y[:, [0, 2]].copy(),
    (Channel("drive_m", "m", "position", sd=1e-3), Channel("load_m", "m", "position", sd=1e-3)),
    (0.0, 0.0, 0.0, 0.0),
    0.02,
    200,
    3.0,
    {
        "dry_friction_at_drive": force("dry_friction", 0.05),
        "dry_friction_at_load": force("dry_friction", 0.05, at=1),
        "square_drag_at_load": force("square_drag", 0.5, at=1),
        "cubic_stiffness_at_drive": force("cubic_stiffness", 300.0, signed=True),
        "added_spring_at_load": force("added_spring", 2.0, at=1),
        "lag": drive("lag", 0.02),
        "delay": drive("delay", 0.01),
        "backlash": drive("backlash", 0.1),
        "saturation": drive("saturation", 0.2, most=0.7),
        "sensor_scale_of_load_m": reading("sensor_scale", 0.03, signed=True, at=1, most=0.4),
        "sensor_delay_of_load_m": reading("sensor_delay", 0.01, at=1),
    },
    speed=0.3,
)  # fmt: skip

TOY = (CART, WHEEL)
ODE = (PENDULUM, TANKS, MASSES)
