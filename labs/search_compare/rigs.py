"""Rigs whose causes help only together, or show at large sizes alone; integrated here.

Nothing of the library makes these recordings: a fourth-order Runge-Kutta scheme with steps far
below a sample, sharp friction, limits and slack.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.data.study import Channel, Run, Study

Array = NDArray[np.float64]
Rates = Callable[[float, Array], Array]
NUM_RUNS = 5  # the last one is for a test


@dataclass(frozen=True)
class Rig:
    """A rig that can be recorded.

    Attributes:
        record: Function (seed, whether nothing is hidden) -> study.
        truth: What is hidden: rows of the library, without the places where they act; laws with
            theirs.
        with_laws: Whether a law may be hidden: the answer is a first one, as of the command line.
    """

    record: Callable[[int, bool], Study]
    truth: frozenset[str]
    with_laws: bool = False


def shoulder(seed: int, null: bool) -> Study:
    """An arm's joint without an integral part that hangs low and rubs."""
    rng, t = np.random.default_rng(seed), 0.02 * np.arange(250.0)
    inertia, kp, kd = 0.02 * rng.uniform(0.95, 1.05), 6.0 * rng.uniform(0.97, 1.03), 0.35
    push, rub = (0.0, 0.0) if null else (-0.22, 0.12) * rng.uniform(0.8, 1.2, 2)

    def rates(goal: Array) -> Rates:
        def of(s: float, y: Array) -> Array:
            torque = kp * (hold(goal, s, 0.02) - y[0]) - kd * y[1] + push
            return np.array([y[1], (torque - rub * np.tanh(y[1] / 0.01)) / inertia])

        return of

    goals = draw_goals(rng, t, 0.6)
    runs = [
        (integrate(rates(g), np.zeros(2), t, 24)[:, :1], {"goal": g}) for g in goals
    ]  # steps of 0.8 ms: friction fades within 0.01 rad/s
    return make_study(
        "shoulder",
        {"angle": "rad"},
        t,
        with_noise(rng, runs, 1e-3),
        parameters={"I": (0.02, 5), "kp": (6.0, 5), "kd": (0.35, 20)},
        inputs=[{"name": "goal", "held": True}],
        states={"q": 0, "w": 0},
        define={"torque": "kp*(goal - q) - kd*w"},
        rates={"q": "w", "w": "torque/I"},
        readings={"angle": "q"},
        places=[
            {"name": "shoulder", "position": "q", "velocity": "w", "inertia": "I",
             "force": "torque", "unit": "N m", "position_unit": "rad"}
        ],
    )  # fmt: skip


def tanks(seed: int, null: bool) -> Study:
    """Two tanks in a row, of which the upper one spills; the lower level is read."""
    rng, t, area = np.random.default_rng(seed), 0.5 * np.arange(300.0), 0.06
    rim = 9.0 if null else 0.35 * rng.uniform(0.9, 1.1)
    upper, lower = 0.012 * rng.uniform(0.9, 1.1), 0.010 * rng.uniform(0.9, 1.1)

    def rates(pump: Array) -> Rates:
        def of(s: float, y: Array) -> Array:
            out = np.array([upper, lower]) * np.sqrt(np.maximum(y, 1e-4))  # as the study has it
            spilled = 0.5 * max(y[0] - rim, 0.0)
            return np.array(
                [(hold(pump, s, 0.5) - out[0]) / area - spilled, -np.diff(out)[0] / area]
            )

        return of

    flows = [
        np.repeat(rng.uniform(0.0, 0.016 if k else 0.01, 10), 30) for k in range(NUM_RUNS)
    ]  # the first run stays below the rim
    runs = [(integrate(rates(u), np.full(2, 0.1), t, 8)[:, 1:], {"pump": u}) for u in flows]
    tank = {"unit": "m", "area": str(area)}
    return make_study(
        "tanks",
        {"level": "m"},
        t,
        with_noise(rng, runs, 1e-3),
        parameters={"a": (0.012, 20), "b": (0.010, 20)},
        inputs=[{"name": "pump", "held": True}],
        states={"upper": 0.1, "lower": 0.1},
        define={"fall": "a*sqrt(max(upper, 1e-4))", "loss": "b*sqrt(max(lower, 1e-4))"},
        rates={"upper": f"(pump - fall)/{area}", "lower": f"(fall - loss)/{area}"},
        readings={"level": "lower"},
        stores=[
            {"name": "upper_tank", "level": "upper", **tank},
            {"name": "lower_tank", "level": "lower", **tank},
        ],
        laws=[{"name": "fall", "of": "upper", "unit": "m^3/s", "of_unit": "m"}],
    )


def late(seed: int, null: bool) -> Study:
    """Three coupled joints whose commands are all as late."""
    rng, t = np.random.default_rng(seed), 0.01 * np.arange(250.0)
    wait = 0.0 if null else 0.012 * rng.uniform(0.8, 1.2)
    kp, kd = np.array([80.0, 60.0, 100.0]), np.array([9.0, 8.0, 11.0])
    true = kp * rng.uniform(0.97, 1.03, 3)

    def rates(goals: Array) -> Rates:
        def of(s: float, y: Array) -> Array:
            u = np.array([np.interp(s - wait, t, g) for g in goals])
            push = true * (u - y[:3]) - kd * y[3:]
            return np.concatenate([y[3:], push - 0.2 * push[[1, 2, 0]]])

        return of

    drawn = [np.array(draw_goals(rng, t, 0.5)[:3]) for _ in range(NUM_RUNS)]
    runs = [
        (integrate(rates(g), np.zeros(6), t, 2)[:, :3], {f"u{k}": g[k] for k in range(3)})
        for g in drawn
    ]
    return make_study(
        "late",
        {f"y{k}": "rad" for k in range(3)},
        t,
        with_noise(rng, runs, 1e-3),
        parameters={
            **{f"k{k}": (float(kp[k]), 5) for k in range(3)},
            **{f"d{k}": (float(kd[k]), 10) for k in range(3)},
        },
        inputs=[{"name": f"u{k}", "held": False} for k in range(3)],
        states={f"{s}{k}": 0 for s in "qw" for k in range(3)},
        define={f"a{k}": f"k{k}*(u{k} - q{k}) - d{k}*w{k}" for k in range(3)},
        rates={
            **{f"q{k}": f"w{k}" for k in range(3)},
            **{f"w{k}": f"a{k} - 0.2*a{(k + 1) % 3}" for k in range(3)},
        },
        readings={f"y{k}": f"q{k}" for k in range(3)},
    )


def drive(seed: int, null: bool) -> Study:
    """A slide whose drive pushes four times as hard as stated."""
    rng, t = np.random.default_rng(seed), 0.01 * np.arange(300.0)
    gain = 1.0 if null else 4.0 * rng.uniform(0.9, 1.1)
    mass, damping = rng.uniform(0.98, 1.02), 0.8 * rng.uniform(0.9, 1.1)
    stiffness = 12.0 * rng.uniform(0.98, 1.02)

    def rates(force: Array) -> Rates:
        def of(s: float, y: Array) -> Array:
            push = gain * hold(force, s, 0.01) - damping * y[1] - stiffness * y[0]
            return np.array([y[1], push / mass])

        return of

    runs = [
        (integrate(rates(g), np.zeros(2), t, 4)[:, :1], {"force": g})
        for g in draw_goals(rng, t, 1.5)
    ]
    return make_study(
        "drive",
        {"place": "m"},
        t,
        with_noise(rng, runs, 2e-3),
        parameters={"m": (1.0, 3), "d": (0.8, 20), "k": (12.0, 3)},
        inputs=[{"name": "force", "held": True}],
        states={"x": 0, "v": 0},
        rates={"x": "v", "v": "(force - d*v - k*x)/m"},
        readings={"place": "x"},
        places=[{"name": "rail", "position": "x", "velocity": "v", "inertia": "m"}],
    )


def slow(seed: int, null: bool) -> Study:
    """A positioner with a speed limit and slack behind it."""
    rng, t = np.random.default_rng(seed), 0.01 * np.arange(400.0)
    limit, slack = (1e9, 0.0) if null else (1.2, 0.06) * rng.uniform(0.9, 1.1, 2)
    pace = 20.0 * rng.uniform(0.97, 1.03)

    def rates(u: Array) -> Rates:
        def of(s: float, y: Array) -> Array:
            pull = pace**2 * (np.interp(s, t, u) - y[0])
            return np.array([y[1], pull - 1.6 * pace * y[1]])

        return of

    runs = []
    for goal in draw_goals(rng, t, 0.5):
        u = _behind(goal, 0.01 * limit, 0.5 * slack)
        runs.append((integrate(rates(u), np.array([u[0], 0.0]), t, 4)[:, :1], {"goal": goal}))
    return make_study(
        "slow",
        {"place": "m"},
        t,
        with_noise(rng, runs, 1e-3),
        parameters={"pace": (20.0, 5), "z": (0.8, 10)},
        inputs=[{"name": "goal", "held": False}],
        states={"x": {"value": 0, "sd": 0.3, "per": "run"}, "v": 0},
        rates={"x": "v", "v": "pace**2*(goal - x) - 2*z*pace*v"},
        readings={"place": "x"},
    )


def hopper(seed: int, null: bool) -> Study:
    """A sled on a spring that loses sand: its mass falls with time, which no library lists."""
    rng, t = np.random.default_rng(seed), 0.02 * np.arange(400.0)
    loss, full = 0.0 if null else rng.uniform(0.15, 0.3), 4.0 * rng.uniform(0.97, 1.03)
    damping, stiffness = 1.5 * rng.uniform(0.85, 1.15), 20.0 * rng.uniform(0.97, 1.03)

    def rates(force: Array) -> Rates:
        def of(s: float, y: Array) -> Array:
            push = hold(force, s, 0.02) - damping * y[1] - stiffness * y[0]
            return np.array([y[1], push / (full - loss * s)])

        return of

    runs = [
        (integrate(rates(g), np.zeros(2), t, 4)[:, :1], {"force": g})
        for g in draw_goals(rng, t, 6.0)
    ]
    return make_study(
        "hopper",
        {"place": "m"},
        t,
        with_noise(rng, runs, 1e-3),
        parameters={"m": (4.0, 5), "d": (1.5, 20), "k": (20.0, 5)},
        inputs=[{"name": "force", "held": True}],
        states={"x": 0, "v": 0},
        define={"mass": "m", "pull": "force - d*v - k*x"},
        rates={"x": "v", "v": "pull/mass"},
        readings={"place": "x"},
        places=[
            {"name": "rail", "position": "x", "velocity": "v", "inertia": "mass", "force": "pull"}
        ],
    )


RIGS: Mapping[str, Rig] = {
    "shoulder": Rig(shoulder, frozenset({"constant_force", "dry_friction"})),
    "tanks": Rig(tanks, frozenset({"overflow"})),
    "late": Rig(late, frozenset({"delay"})),
    "drive": Rig(drive, frozenset({"command_gain"})),
    "slow": Rig(slow, frozenset({"rate_limit", "backlash"})),
    "hopper": Rig(hopper, frozenset({"law_of_time_at_m"}), with_laws=True),
}


def draw_goals(rng: np.random.Generator, t: Array, size: float) -> list[Array]:
    """Sines, steps and sweeps, one a run."""
    out = []
    for k in range(NUM_RUNS):
        pace, start = rng.uniform(0.3, 1.2), rng.uniform(0.0, 6.0)
        steps = np.repeat(rng.uniform(-size, size, 8), -(-len(t) // 8))[: len(t)]
        sine = size * rng.uniform(0.5, 1.0) * np.sin(2.0 * np.pi * pace * t + start)
        sweep = size * np.sin(2.0 * np.pi * (0.2 + 0.2 * pace * t) * t)
        out.append((sine, steps, sweep)[(k + int(3 * start)) % 3])
    return out


def _behind(goal: Array, step: float, half: float) -> Array:
    """A goal behind a limit of its steps, and half a slack."""
    place = seen = goal[0]
    out = np.empty_like(goal)
    for k, wanted in enumerate(goal):
        place += np.clip(wanted - place, -step, step)
        seen = np.clip(seen, place - half, place + half)
        out[k] = seen
    return out


def hold(values: Array, s: float, step: float) -> float:
    """Value that lasts a step; the last stage of ``integrate`` still has the old one."""
    return float(values[min(int(s / step + 1e-12), len(values) - 1)])


def integrate(rates: Rates, start: Array, t: Array, steps: int) -> Array:
    """States at the samples, (T, n), by Runge and Kutta's scheme, so many steps a sample."""
    out = [start]
    for begin, end in pairwise(t):
        y, h = out[-1], (end - begin) / steps
        for k in range(steps):
            s = begin + k * h
            a = rates(s, y)
            b = rates(s + 0.5 * h, y + 0.5 * h * a)
            c = rates(s + 0.5 * h, y + 0.5 * h * b)
            d = rates(s + h * (1.0 - 1e-9), y + h * c)
            y = y + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
        out.append(y)
    return np.array(out)


def with_noise(
    rng: np.random.Generator, runs: Sequence[tuple[Array, dict[str, Array]]], sd: float
) -> list[tuple[Array, dict[str, Array], float]]:
    """Channels with white noise, commands, and the noise, of each run."""
    return [(y + sd * rng.normal(size=y.shape), command, sd) for y, command in runs]


def make_study(
    name: str,
    channels: Mapping[str, str],
    t: Array,
    runs: Sequence[tuple[Array, dict[str, Array], float]],
    parameters: Mapping[str, tuple[float, float]],
    **model: Any,
) -> Study:
    """A study of a described system; parameters by value and percent."""
    made = [
        Run(f"r{k}", t, y, u, f"r{k}", k, "test" if k == len(runs) - 1 else "fit")
        for k, (y, u, _) in enumerate(runs)
    ]
    said = {n: {"value": value, "percent": percent} for n, (value, percent) in parameters.items()}
    seen = tuple(
        Channel(n, unit, "position" if unit == "m" else "angle", runs[0][2])
        for n, unit in channels.items()
    )
    return Study(
        name, "ode", seen, tuple(made), model={"system": "ode", "parameters": said, **model}
    )
