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


def elastic_arm(seed: int, null: bool) -> Study:
    """Two coupled joints in the plane, of which one has an elastic coupling behind its drive."""
    rng, t, joint = np.random.default_rng(seed), 0.005 * np.arange(500.0), seed % 2
    size = rng.uniform((0.2, 0.04, 0.06), (0.3, 0.06, 0.09)).round(4)
    inertia = np.array([size[0] + 2.0 * size[1], size[2]]) / rng.uniform(0.6, 0.75, 2)
    rotors = inertia - [size[0] + 2.0 * size[1], size[2]]
    pace = 2.0 * np.pi * rng.uniform(2.5, 4.0, 2)
    kp, kd = inertia * pace**2, 1.4 * inertia * pace
    true = kp * rng.uniform(0.98, 1.02, 2)
    stiffness = (2.0 * np.pi * rng.uniform(11.0, 20.0)) ** 2 * rotors * (1.0 - rotors / inertia)
    damping = 0.06 * np.sqrt(stiffness * (inertia - rotors))
    # the drive's part of the joint's inertia moves by itself
    moving = rotors * (1.0 if null else 1.0 - np.eye(2)[joint])

    def rates(goals: Array) -> Rates:
        def of(s: float, y: Array) -> Array:
            q, w, drive, turns = np.split(y, 4)
            push = true * ([hold(g, s, 0.005) for g in goals] - drive) - kd * turns
            pull = stiffness * (drive - q) + damping * (turns - w)
            onto = push if null else np.where(np.arange(2) == joint, pull, push)
            across, bend = size[2] + size[1] * np.cos(q[1]), size[1] * np.sin(q[1])
            mass = [[size[0] + 2.0 * size[1] * np.cos(q[1]), across], [across, size[2]]]
            turning = bend * np.array([w[1] * (2.0 * w[0] + w[1]), -(w[0] ** 2)])
            a = np.linalg.solve(mass + np.diag(moving), onto + turning)
            own = np.where((np.arange(2) == joint) & (not null), (push - pull) / rotors, a)
            return np.concatenate([w, a, turns, own])

        return of

    runs = []
    for goals in zip(_sweeps(rng, t, 0.3, 7.0), draw_goals(rng, t, 0.3), strict=True):
        both = np.array(goals if joint == 0 else goals[::-1]) * np.clip(t / 0.1, 0.0, 1.0)
        made = integrate(rates(both), np.zeros(8), t, 8)[:, :2]
        runs.append((made, {"u1": both[0], "u2": both[1]}))
    a, b, d = (f"{x:.4f}" for x in size)
    r1, r2 = (f"{x:.6f}" for x in rotors)
    return make_study(
        "elastic_arm",
        {"y1": "rad", "y2": "rad"},
        t,
        with_noise(rng, runs, 5e-4),
        parameters={
            **{f"k{k + 1}": (float(kp[k]), 3) for k in range(2)},
            **{f"d{k + 1}": (float(kd[k]), 5) for k in range(2)},
        },
        inputs=[{"name": f"u{k}", "held": True} for k in (1, 2)],
        states={f"{s}{k}": 0 for k in (1, 2) for s in "qw"},
        define={
            **{f"m{k}": f"k{k}*(u{k} - q{k}) - d{k}*w{k}" for k in (1, 2)},
            "m11": f"{a} + 2*{b}*cos(q2) + {r1}",
            "m12": f"{d} + {b}*cos(q2)",
            "m22": f"{d} + {r2}",
            "f1": f"m1 + {b}*sin(q2)*w2*(2*w1 + w2)",
            "f2": f"m2 - {b}*sin(q2)*w1**2",
        },
        rates={
            "q1": "w1",
            "q2": "w2",
            "w1": "(m22*f1 - m12*f2)/(m11*m22 - m12**2)",
            "w2": "(m11*f2 - m12*f1)/(m11*m22 - m12**2)",
        },
        readings={"y1": "q1", "y2": "q2"},
        places=[
            {**JOINT, "name": f"joint{k}", "position": f"q{k}", "velocity": f"w{k}",
             "inertia": f"m{k}{k}", "force": f"m{k}"}
            for k in (1, 2)
        ],
    )  # fmt: skip


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
    "elastic_arm": Rig(elastic_arm, frozenset({"elastic_coupling"})),
    "profile": Rig(profile, frozenset({"acceleration_limit"})),  # which has a greatest speed
    "late_torque": Rig(late_torque, frozenset({"delay_inside_motor"})),
    "sticking": Rig(sticking, frozenset({"dry_friction", "stribeck_friction"})),
    "exchanged": Rig(exchanged, frozenset({"exchanged"})),
    "bus": Rig(bus, frozenset({"bus_age"})),
}
