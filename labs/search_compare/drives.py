"""Rigs whose drives are not what their owner took them for; integrated here, sizes drawn."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from diffsim.data.study import Study
from labs.search_compare.rigs import (
    NUM_RUNS,
    Array,
    Rates,
    Rig,
    draw_goals,
    hold,
    integrate,
    make_study,
    with_noise,
)

JOINT = {
    "name": "joint", "position": "q", "velocity": "w", "unit": "N m", "position_unit": "rad"
}  # fmt: skip


def elastic(seed: int, null: bool) -> Study:
    """A controller holds the drive's side of an elastic coupling; the link is read."""
    rng, t = np.random.default_rng(seed), 0.004 * np.arange(500.0)
    whole, part = 0.06 * rng.uniform(0.97, 1.03), rng.uniform(0.5, 0.85)
    front, behind = whole * (1.0 - part), whole * part
    swing = 2.0 * np.pi * rng.uniform(14.0, 30.0)
    stiffness = 1e6 if null else swing**2 * front * behind / whole
    damping = 2.0 * 0.03 * np.sqrt(stiffness * behind) * (10.0 if null else 1.0)
    kp, kd = 80.0 * rng.uniform(0.97, 1.03), 3.0 * rng.uniform(0.97, 1.03)

    def rates(goal: Array) -> Rates:
        def of(s: float, y: Array) -> Array:
            torque = kp * (hold(goal, s, 0.004) - y[0]) - kd * y[1]
            if null:
                return np.array([y[1], torque / whole, y[1], torque / whole])
            pull = stiffness * (y[0] - y[2]) + damping * (y[1] - y[3])
            return np.array([y[1], (torque - pull) / front, y[3], pull / behind])

        return of

    runs = [
        (integrate(rates(g), np.zeros(4), t, 8)[:, 2:3], {"goal": g})
        for g in _sweeps(rng, t, 0.25, 9.0)
    ]
    return make_study(
        "elastic",
        {"angle": "rad"},
        t,
        with_noise(rng, runs, 5e-4),
        parameters={"I": (0.06, 5), "kp": (80.0, 5), "kd": (3.0, 10)},
        inputs=[{"name": "goal", "held": True}],
        states={"q": 0, "w": 0},
        define={"motor": "kp*(goal - q) - kd*w"},
        rates={"q": "w", "w": "motor/I"},
        readings={"angle": "q"},
        places=[{**JOINT, "inertia": "I"}],
    )


def profile(seed: int, null: bool) -> Study:
    """A drive that goes to its set point with its speed and acceleration limited."""
    rng, t = np.random.default_rng(seed), 0.02 * np.arange(250.0)
    fastest, most = rng.uniform(1.0, 2.5), rng.uniform(2.0, 6.0)
    inertia, kp, kd = 0.05, 60.0 * rng.uniform(0.97, 1.03), 2.9 * rng.uniform(0.95, 1.05)

    def rates(points: Array) -> Rates:
        def of(s: float, y: Array) -> Array:
            goal = hold(points, s, 1e-3)
            return np.array([y[1], (kp * (goal - y[0]) - kd * y[1]) / inertia])

        return of

    runs = []
    for goal in draw_goals(rng, t, 0.6):
        goal[0] = 0.0
        points = np.repeat(goal, 20) if null else _profile(goal, 0.02, fastest, most)
        runs.append((integrate(rates(points), np.zeros(2), t, 20)[:, :1], {"goal": goal}))
    return make_study(
        "profile",
        {"angle": "rad"},
        t,
        with_noise(rng, runs, 1e-3),
        parameters={"kp": (60.0, 5), "kd": (2.9, 10)},
        inputs=[{"name": "goal", "held": True}],
        states={"q": 0, "w": 0},
        define={"motor": "kp*(goal - q) - kd*w"},
        rates={"q": "w", "w": f"motor/{inertia}"},
        readings={"angle": "q"},
        places=[{**JOINT, "inertia": str(inertia)}],
    )


def late_torque(seed: int, null: bool) -> Study:
    """A controller whose torque reaches the joint late."""
    rng, t = np.random.default_rng(seed), 0.005 * np.arange(400.0)
    wait = 0.0 if null else rng.uniform(0.008, 0.016)
    inertia, damping = 0.05 * rng.uniform(0.98, 1.02), 0.3 * rng.uniform(0.8, 1.2)
    kp, kd, parts = 80.0, 2.0, 100
    h = 0.005 / parts  # what steps this short miss is far below the noise
    later = round(wait / h)
    runs = []
    for goal in _sweeps(rng, t, 0.25, 4.0):
        q = w = 0.0
        torques, seen = [0.0] * later, []
        for k in range(len(t)):
            seen.append(q)
            for _ in range(parts):
                torques.append(kp * (goal[k] - q) - kd * w)
                w += h * (torques[-1 - later] - damping * w) / inertia
                q += h * w
        runs.append((np.array(seen)[:, None], {"goal": goal}))
    return make_study(
        "late_torque",
        {"angle": "rad"},
        t,
        with_noise(rng, runs, 5e-4),
        parameters={"I": (0.05, 5), "d": (0.3, 30)},
        inputs=[{"name": "goal", "held": True}],
        states={"q": 0, "w": 0},
        define={"motor": f"{kp}*(goal - q) - {kd}*w"},
        rates={"q": "w", "w": "(motor - d*w)/I"},
        readings={"angle": "q"},
        places=[{**JOINT, "inertia": "I", "force": "motor"}],
    )


def sticking(seed: int, null: bool) -> Study:
    """A joint that rubs, and sticks where it rests, in a controller without an integral part."""
    rng, t = np.random.default_rng(seed), 0.02 * np.arange(250.0)
    inertia, kp = 0.05 * rng.uniform(0.96, 1.04), 8.0 * rng.uniform(0.97, 1.03)
    kd, falls = 0.5 * rng.uniform(0.85, 1.15), rng.uniform(0.05, 0.15)
    rub, stick = (0.0, 0.0) if null else rng.uniform((0.08, 0.1), (0.15, 0.25))

    def rates(goal: Array) -> Rates:
        def of(s: float, y: Array) -> Array:
            friction = (rub + stick * np.exp(-((y[1] / falls) ** 2))) * np.tanh(y[1] / 0.005)
            torque = kp * (hold(goal, s, 0.02) - y[0]) - kd * y[1] - friction
            return np.array([y[1], torque / inertia])

        return of

    runs = [
        (integrate(rates(g), np.zeros(2), t, 40)[:, :1], {"goal": g})
        for g in draw_goals(rng, t, 0.6)
    ]
    return make_study(
        "sticking",
        {"angle": "rad"},
        t,
        with_noise(rng, runs, 1e-3),
        parameters={"I": (0.05, 5), "kp": (8.0, 5), "kd": (0.5, 20)},
        inputs=[{"name": "goal", "held": True}],
        states={"q": 0, "w": 0},
        define={"motor": "kp*(goal - q) - kd*w"},
        rates={"q": "w", "w": "motor/I"},
        readings={"angle": "q"},
        places=[{**JOINT, "inertia": "I", "force": "motor"}],
    )


def exchanged(seed: int, null: bool) -> Study:
    """Three joints of which two have each other's command."""
    rng = np.random.default_rng(seed)
    order = [0, 1, 2] if null else list(rng.permutation([[1, 0, 2], [2, 1, 0], [0, 2, 1]])[0])
    return _joints("exchanged", rng, lambda u: u[order], lambda y, t: y)


def bus(seed: int, null: bool) -> Study:
    """Three joints that are read one after the other over a bus."""
    rng = np.random.default_rng(seed)
    age = 0.0 if null else rng.uniform(0.003, 0.008)

    def read(y: Array, t: Array) -> Array:
        return np.stack([np.interp(t - k * age, t, y[:, k]) for k in range(3)], 1)

    return _joints("bus", rng, lambda u: u, read)


def _joints(
    name: str,
    rng: np.random.Generator,
    wired: Callable[[Array], Array],
    read: Callable[[Array, Array], Array],
) -> Study:
    """Three joints, each with a controller, that pull on each other."""
    t, fine = 0.01 * np.arange(250.0), 0.001 * np.arange(2500.0)
    kp, kd = np.array([80.0, 60.0, 100.0]), np.array([9.0, 8.0, 11.0])
    true = kp * rng.uniform(0.97, 1.03, 3)

    def rates(goals: Array) -> Rates:
        def of(s: float, y: Array) -> Array:
            u = np.array([hold(g, s, 0.01) for g in goals])
            push = true * (u - y[:3]) - kd * y[3:]
            return np.concatenate([y[3:], push - 0.2 * push[[1, 2, 0]]])

        return of

    runs = []
    for _ in range(NUM_RUNS):
        goals = np.array(draw_goals(rng, t, 0.5)[:3])
        y = integrate(rates(wired(goals)), np.zeros(6), fine, 1)[:, :3]
        runs.append((read(y, fine)[::10], {f"u{k}": goals[k] for k in range(3)}))
    return make_study(
        name,
        {f"y{k}": "rad" for k in range(3)},
        t,
        with_noise(rng, runs, 1e-3),
        parameters={
            **{f"k{k}": (float(kp[k]), 5) for k in range(3)},
            **{f"d{k}": (float(kd[k]), 10) for k in range(3)},
        },
        inputs=[{"name": f"u{k}", "held": True} for k in range(3)],
        states={f"{s}{k}": 0 for s in "qw" for k in range(3)},
        define={f"a{k}": f"k{k}*(u{k} - q{k}) - d{k}*w{k}" for k in range(3)},
        rates={
            **{f"q{k}": f"w{k}" for k in range(3)},
            **{f"w{k}": f"a{k} - 0.2*a{(k + 1) % 3}" for k in range(3)},
        },
        readings={f"y{k}": f"q{k}" for k in range(3)},
    )


def _sweeps(rng: np.random.Generator, t: Array, size: float, fastest: float) -> list[Array]:
    """Steps, then sweeps up to a frequency, one a run."""
    steps = np.repeat(rng.uniform(-size, size, 8), -(-len(t) // 8))[: len(t)]
    steps[:10] = 0.0  # at rest at first
    out = [steps]
    for _ in range(NUM_RUNS - 1):
        first, last = rng.uniform(0.2, 1.0), fastest * rng.uniform(0.6, 1.0)
        phase = 2.0 * np.pi * (first * t + 0.5 * (last - first) * t**2 / t[-1])
        out.append(size * rng.uniform(0.5, 1.0) * np.sin(phase))
    return out


def _profile(goal: Array, step: float, fastest: float, most: float) -> Array:
    """Set points every 1/20 of a step that follow a held goal, and brake in time.

    Where it brakes is decided in small parts: in parts of 1/20 it ends up to 0.02 beside.
    """
    parts, place, speed, out = 1000, float(goal[0]), 0.0, []
    h = step / parts
    for k, wanted in enumerate(np.repeat(goal, parts)):
        away = wanted - place
        to = math.copysign(min(fastest, math.sqrt(2.0 * most * abs(away))), away)
        speed = min(max(to, speed - most * h), speed + most * h)
        place += speed * h
        if (k + 1) % (parts // 20) == 0:
            out.append(place)
    return np.array(out)


DRIVES: Mapping[str, Rig] = {
    "elastic": Rig(elastic, frozenset({"elastic_coupling"})),
    "profile": Rig(profile, frozenset({"acceleration_limit"})),  # which has a greatest speed
    "late_torque": Rig(late_torque, frozenset({"delay_inside_motor"})),
    "sticking": Rig(sticking, frozenset({"dry_friction", "stribeck_friction"})),
    "exchanged": Rig(exchanged, frozenset({"exchanged"})),
    "bus": Rig(bus, frozenset({"bus_age"})),
}
