"""Sound rigs, and sound records that look like faults."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from labs.records.rig import KINDS, RUNS, Array, Folder, Tables, course, followed, study_of

Rng = np.random.Generator


def _first_order(
    rng: Rng,
    name: str,
    *,
    command: tuple[str, str, float, float],
    channel: tuple[str, str, float, float],
    step: float,
    lag: float,
    gain: float = 1.0,
    count: int = 500,
    whole: bool = False,
) -> Folder:
    """A channel that follows a command with a lag.

    Args:
        command: Column, unit, size and level.
        channel: Column, unit, noise and level.
    """
    step, lag = step * rng.uniform(0.8, 1.2), lag * rng.uniform(0.7, 1.4)
    size, sd = command[2] * rng.uniform(0.7, 1.3), channel[2]
    tables = {}
    for run, kind in zip(RUNS, KINDS, strict=True):
        t = step * np.arange(float(count))
        u = command[3] + course(rng, t, kind, size)
        u = np.round(u) if whole else u
        x0 = np.array([gain * (u[0] - command[3]) + channel[3]])
        target = gain * (u - command[3]) + channel[3]
        x = followed(lambda x, v: (v - x) / lag, x0, target, step)[:, 0]
        x = x + rng.normal(0.0, sd, count)
        tables[run] = {"time_s": t, command[0]: u, channel[0]: np.round(x) if whole else x}
    slope = f"{gain:g}*(drive - {command[3]:g}) + {channel[3]:g}"
    entry = {
        "name": "seen",
        "column": channel[0],
        "unit": channel[1],
        "sd": max(sd, 0.3) if whole else sd,
    }
    study = study_of(
        name,
        [entry],
        [{"name": "drive", "column": command[0], "unit": command[1]}],
        {
            "states": {"q": "first_seen"},
            "inputs": [{"name": "drive", "held": True}],
            "parameters": {"lag": {"value": f"{lag:.3g} s", "percent": 30}},
            "define": {"wanted": slope},
            "rates": {"q": "(wanted - q)/lag"},
            "readings": {"seen": "q"},
        },
    )
    return Folder(name, study, tables, {})


servo = partial(
    _first_order,
    name="servo",
    command=("goal_counts", "-", 700.0, 2000.0),
    channel=("present_counts", "-", 1.0, 2000.0),
    step=0.02,
    lag=0.08,
    whole=True,
)
servo_at_zero = partial(
    _first_order,
    name="servo_at_zero",
    command=("goal_counts", "-", 600.0, 0.0),
    channel=("present_counts", "-", 1.0, 0.0),
    step=0.01,
    lag=0.05,
    whole=True,
)
joint = partial(
    _first_order,
    name="joint",
    command=("goal_deg", "deg", 50.0, 20.0),
    channel=("angle_deg", "deg", 0.05, 20.0),
    step=0.01,
    lag=0.1,
)
wheel = partial(
    _first_order,
    name="wheel",
    command=("voltage_V", "V", 8.0, 0.0),
    channel=("speed_rad_s", "rad/s", 0.3, 0.0),
    step=0.01,
    lag=0.15,
    gain=6.0,
)
press = partial(
    _first_order,
    name="press",
    command=("valve_mbar", "mbar", 300.0, 800.0),
    channel=("pressure_mbar", "mbar", 1.5, 800.0),
    step=0.005,
    lag=0.06,
)
plate = partial(
    _first_order,
    name="plate",
    command=("heater_W", "W", 15.0, 30.0),
    channel=("temperature_K", "K", 0.05, 330.0),
    step=2.0,
    lag=60.0,
    gain=0.8,
)


def pendulum(rng: Rng) -> Folder:
    """A torque moves a pendulum: angle and rate are measured."""
    inertia, drag, pull, step = 0.05 * rng.uniform(0.7, 1.4), 0.12, 1.2, 0.01
    tables = {}
    for run, kind in zip(RUNS, KINDS, strict=True):
        t = step * np.arange(600.0)
        u = course(rng, t, kind, 0.9)

        def rate(x: Array, v: float) -> Array:
            return np.array([x[1], (v - drag * x[1] - pull * np.sin(x[0])) / inertia])

        x = followed(rate, np.zeros(2), u, step)
        tables[run] = {
            "time_s": t,
            "torque_Nm": u,
            "angle_rad": x[:, 0] + rng.normal(0.0, 1e-3, len(t)),
            "rate_rad_s": x[:, 1] + rng.normal(0.0, 0.02, len(t)),
        }
    study = study_of(
        "pendulum",
        [
            {"name": "angle", "column": "angle_rad", "unit": "rad", "sd": 1e-3},
            {"name": "rate", "column": "rate_rad_s", "unit": "rad/s", "sd": 0.02},
        ],
        [{"name": "torque", "column": "torque_Nm", "unit": "N m"}],
        {
            "states": {"q": 0, "w": 0},
            "inputs": [{"name": "torque", "held": True}],
            "parameters": {
                "inertia": {"value": f"{inertia:.3g} kg m^2", "percent": 30},
                "drag": {"value": f"{drag} N m s/rad", "percent": 50},
            },
            "rates": {"q": "w", "w": f"(torque - drag*w - {pull}*sin(q))/inertia"},
            "readings": {"angle": "q", "rate": "w"},
        },
    )
    return Folder("pendulum", study, tables, {})


def _towards(lag: float, x: Array, v: float) -> Array:
    return (v - x) / lag


def stage(rng: Rng) -> Folder:
    """Two axes with goals of their own."""
    step, lags = 0.01, 0.06 * rng.uniform(0.6, 1.6, 2)
    tables = {}
    for k, run in enumerate(RUNS):
        t = step * np.arange(500.0)
        table = {"time_s": t}
        for i, axis in enumerate("xy"):
            u = course(rng, t, KINDS[(k + i) % 5], 40.0)
            x = followed(partial(_towards, float(lags[i])), u[:1], u, step)[:, 0]
            table[f"goal_{axis}_mm"] = u
            table[f"{axis}_mm"] = x + rng.normal(0.0, 0.02, len(t))
        tables[run] = table
    study = study_of(
        "stage",
        [{"name": a, "column": f"{a}_mm", "unit": "mm", "sd": 0.02} for a in "xy"],
        [{"name": f"goal_{a}", "column": f"goal_{a}_mm", "unit": "mm"} for a in "xy"],
        {
            "states": {f"p{a}": f"first_{a}" for a in "xy"},
            "inputs": [{"name": f"goal_{a}", "held": True} for a in "xy"],
            "parameters": {
                f"lag_{a}": {"value": f"{lag:.3g} s", "percent": 30}
                for a, lag in zip("xy", lags, strict=True)
            },
            "rates": {f"p{a}": f"(goal_{a} - p{a})/lag_{a}" for a in "xy"},
            "readings": {a: f"p{a}" for a in "xy"},
        },
    )
    return Folder("stage", study, tables, {})


def arm(rng: Rng) -> Folder:
    """A joint under PD control: angle and motor torque are measured."""
    inertia, kp, kd, step = 0.05 * rng.uniform(0.7, 1.4), 60.0, 2.5, 0.01
    tables = {}
    for run, kind in zip(RUNS, KINDS, strict=True):
        t = step * np.arange(500.0)
        u = course(rng, t, kind, 0.4)

        def rate(x: Array, v: float) -> Array:
            return np.array([x[1], (kp * (v - x[0]) - (kd + 0.3) * x[1]) / inertia])

        x = followed(rate, np.array([u[0], 0.0]), u, step)
        effort = kp * (u - x[:, 0]) - kd * x[:, 1]
        tables[run] = {
            "time_s": t,
            "goal_rad": u,
            "angle_rad": x[:, 0] + rng.normal(0.0, 5e-4, len(t)),
            "torque_Nm": effort + rng.normal(0.0, 0.1, len(t)),
        }
    study = study_of(
        "arm",
        [
            {"name": "angle", "column": "angle_rad", "unit": "rad", "sd": 5e-4},
            {"name": "torque", "column": "torque_Nm", "unit": "N m", "sd": 0.1},
        ],
        [{"name": "goal", "column": "goal_rad", "unit": "rad"}],
        {
            "states": {"q": "first_angle", "w": 0},
            "inputs": [{"name": "goal", "held": True}],
            "parameters": {"inertia": {"value": f"{inertia:.3g} kg m^2", "percent": 30}},
            "define": {"effort": f"{kp:g}*(goal - q) - {kd:g}*w"},
            "rates": {"q": "w", "w": "(effort - 0.3*w)/inertia"},
            "readings": {"angle": "q", "torque": "effort"},
        },
    )
    return Folder("arm", study, tables, {})


def bench(rng: Rng) -> Folder:
    """Thrust of a propeller over its speed, point by point."""
    tables = {}
    for run in RUNS:
        w = np.round(rng.uniform(300.0, 1500.0, 60), 1)
        if run in "ab":
            w = np.sort(w)[:: 1 if run == "a" else -1]
        thrust = 3.0e-6 * w**2 * (1.0 + rng.normal(0.0, 0.005, 60)) + rng.normal(0.0, 2e-3, 60)
        tables[run] = {"time_s": np.arange(60.0), "speed_rad_s": w, "thrust_N": thrust}
    study = study_of(
        "bench",
        [{"name": "thrust", "column": "thrust_N", "unit": "N", "sd": 0.01}],
        [{"name": "speed", "column": "speed_rad_s", "unit": "rad/s", "is_measured": True}],
        {"states": {"unused": 0}, "inputs": [{"name": "speed"}], "rates": {"unused": "0"},
         "parameters": {"c": {"value": 3e-6, "percent": 30}},
         "readings": {"thrust": "c*speed**2"}},
    )  # fmt: skip
    return Folder("bench", study, tables, {})


def bounce(rng: Rng) -> Folder:
    """A ball on a floor: height alone, every bounce a cusp."""
    tables = {}
    for run in RUNS:
        t = 0.01 * np.arange(400.0)
        y, v, out, back = rng.uniform(0.8, 1.6), 0.0, [], rng.uniform(0.75, 0.9)
        for _ in t:
            out.append(y)
            for _ in range(10):
                v -= 9.81e-3
                y += 1e-3 * v
                if y < 0.0:
                    y, v = -y, -back * v
        tables[run] = {"time_s": t, "height_m": np.array(out) + rng.normal(0.0, 1e-3, len(t))}
    study = study_of(
        "bounce",
        [{"name": "height", "column": "height_m", "unit": "m", "sd": 1e-3}],
        [],
        {"states": {"y": "first_height", "v": 0}, "rates": {"y": "v", "v": "-9.81 + push"},
         "parameters": {"stiff": {"value": 1e4, "percent": 30}},
         "define": {"push": "stiff*max(-y, 0)"}, "readings": {"height": "y"}},
    )  # fmt: skip
    return Folder("bounce", study, tables, {})


def unsigned_torque(rng: Rng) -> Folder:
    """A driver that shows the size of its torque, as the model says: cusps at every reversal."""
    made = pendulum(rng)
    tables = {
        run: {
            "time_s": t["time_s"],
            "torque_Nm": t["torque_Nm"],
            "angle_rad": t["angle_rad"],
            "effort_Nm": np.abs(1.2 * np.sin(t["angle_rad"]) + 0.12 * t["rate_rad_s"])
            + rng.normal(0.0, 2e-3, len(t["time_s"])),
        }
        for run, t in made.tables.items()
    }
    study = dict(made.study)
    study["channels"] = [
        study["channels"][0],
        {"name": "effort", "column": "effort_Nm", "unit": "N m", "sd": 5e-3},
    ]
    model = dict(study["model"])
    model["readings"] = {"angle": "q", "effort": "abs(1.2*sin(q) + 0.12*w)"}
    return Folder("unsigned_torque", {**study, "model": model}, tables, {})


def at_rest(rng: Rng) -> Folder:
    """An encoder of few lines that rests between steps."""
    made = joint(rng)
    tables = {}
    for run, t in made.tables.items():
        goal = 20.0 + rng.uniform(20.0, 40.0) * np.sign(
            np.sin(2.0 * np.pi * rng.uniform(1.0, 3.0) * np.arange(500) / 500)
        )
        x = followed(lambda x, v: (v - x) / 0.05, goal[:1], goal, 0.01)[:, 0]
        tables[run] = {
            **t,
            "goal_deg": goal,
            "angle_deg": 0.5 * np.round((x + rng.normal(0.0, 0.1, 500)) / 0.5),
        }
    return made.changed(tables, name="at_rest")


def stick_slip(rng: Rng) -> Folder:
    """A joint with dry friction that stops at every reversal while its command goes on."""
    made = joint(rng)
    tables = {}
    for run, t in made.tables.items():
        goal, x, out = t["goal_deg"], float(t["goal_deg"][0]), []
        for g in goal:
            x += 0.3 * max(abs(g - x) - 4.0, 0.0) * np.sign(g - x)
            out.append(x)
        tables[run] = {**t, "angle_deg": 0.1 * np.round(np.array(out) / 0.1)}
    return made.changed(tables, name="stick_slip")


def full_scale(rng: Rng) -> Folder:
    """A valve driven from 0 to all of 12 bits, and a pressure that follows at once."""
    made = press(rng)
    tables = {}
    for run, t in made.tables.items():
        drive = np.where(t["valve_mbar"] > 800.0, 4095.0, 0.0)
        seen = 0.2 * np.append(drive[0], drive[:-1]) + rng.normal(0.0, 1.5, len(drive))
        tables[run] = {"time_s": t["time_s"], "valve_mbar": drive, "pressure_mbar": seen + 100.0}
    return made.changed(tables, name="full_scale")


def turns(rng: Rng) -> Folder:
    """An angle that goes on for many turns, unwrapped, and one that stays in half a turn."""
    made = joint(rng)
    tables = {}
    for run, t in made.tables.items():
        wide = 900.0 if run in "ab" else 3.5
        goal = wide * (t["goal_deg"] - 20.0) / 50.0
        x = followed(lambda x, v: (v - x) / 0.1, goal[:1], goal, 0.01)[:, 0]
        tables[run] = {**t, "goal_deg": goal, "angle_deg": x + rng.normal(0.0, 0.05, len(x))}
    return made.changed(tables, name="turns")


def end_stop(rng: Rng) -> Folder:
    """An arm that runs against a stop with an encoder that shows it."""
    made = joint(rng)
    tables = {}
    for run, t in made.tables.items():
        x = np.minimum(t["angle_deg"], 50.0 + rng.normal(0.0, 0.05, len(t["angle_deg"])))
        tables[run] = {**t, "angle_deg": x}
    return made.changed(tables, name="end_stop")


def coarse(rng: Rng) -> Folder:
    """Few samples per motion: each looks like an outlier."""
    made = pendulum(rng)
    tables = {r: {n: c[::12] for n, c in t.items()} for r, t in made.tables.items()}
    return made.changed(tables, name="coarse")


def rounded(rng: Rng) -> Folder:
    """A slow temperature in tenths of a kelvin: it stays for many samples, and follows lines."""
    made = plate(rng)
    tables = {
        r: {**t, "temperature_K": 0.1 * np.round(t["temperature_K"] / 0.1)}
        for r, t in made.tables.items()
    }
    return made.changed(tables, name="rounded")


def paused(rng: Rng) -> Folder:
    """A logger that paused while everything stood still."""
    made = joint(rng)
    tables = {}
    for run, t in made.tables.items():
        later = np.where(np.arange(500) >= 250, 3.0, 0.0)
        still = np.abs(np.arange(500) - 250) < 60
        goal = np.where(still, 20.0, t["goal_deg"])
        x = followed(lambda x, v: (v - x) / 0.05, goal[:1], goal, 0.01)[:, 0]
        seen = x + rng.normal(0.0, 0.05, 500)
        tables[run] = {"time_s": t["time_s"] + later, "goal_deg": goal, "angle_deg": seen}
    return made.changed(tables, name="paused")


def kicked(rng: Rng) -> Folder:
    """A wheel that is hit: its speed jumps and falls, time and again."""
    made = wheel(rng)
    tables = {}
    for run, t in made.tables.items():
        hits = np.zeros(500)
        hits[rng.choice(500, 6, replace=False)] = rng.uniform(20.0, 40.0, 6)
        seen = followed(lambda x, v: -x / 0.05 + 100.0 * v, np.zeros(1), hits, 0.01)[:, 0]
        tables[run] = {**t, "speed_rad_s": t["speed_rad_s"] + seen}
    return made.changed(tables, name="kicked")


def let_go(rng: Rng) -> Folder:
    """A joint on a spring that is let go: nothing is commanded, in any run."""
    made = joint(rng)
    tables: Tables = {}
    for run, table in made.tables.items():
        t, rate = table["time_s"], rng.uniform(4.0, 9.0)
        seen = rng.uniform(10.0, 40.0) * np.exp(-t / rng.uniform(1.0, 4.0)) * np.cos(rate * t)
        seen = np.round(seen + rng.normal(0.0, 0.05, len(t)), 4)
        tables[run] = {**table, "goal_deg": np.zeros_like(t), "angle_deg": seen}
    return made.changed(tables, name="let_go")


def goals(rng: Rng) -> Folder:
    """Two servos that get a goal every two seconds, and rest there to the count until the next;
    one moves longer, one misses a goal. The clock of the goals is recorded as a command."""
    tables: Tables = {}
    t = 0.1 * np.arange(80)
    at = np.minimum((t + 0.95) // 2.0, 4.0).astype(int)
    for k, run in enumerate(RUNS):
        table = {"time_s": t, "told_s": 1.6e9 + 1e4 * k + 2.0 * at}
        for axis, lasts in (("a", 0.4), ("b", 1.8)):
            told = np.round(rng.uniform(300.0, 700.0, 6))
            taken = told + np.round(rng.normal(0.0, 4.0, 6))
            if axis == "a":
                taken[3] = taken[2]
            share = np.clip((t + 0.95 - 2.0 * at) / lasts, 0.0, 1.0)
            table[f"goal_{axis}"] = told[at + 1]
            table[f"servo_{axis}"] = np.round(taken[at] + share * (taken[at + 1] - taken[at]))
        tables[run] = table
    model = {
        "parameters": {"lag": {"value": 0.1, "percent": 30}},
        "inputs": [{"name": f"goal_{axis}", "held": True} for axis in "ab"],
        "states": {"a": "first_servo_a", "b": "first_servo_b"},
        "rates": {"a": "(goal_a - a)/lag", "b": "(goal_b - b)/lag"},
        "readings": {"servo_a": "a", "servo_b": "b"},
    }
    channels = [{"name": f"servo_{axis}", "unit": "-", "sd": 1.0} for axis in "ab"]
    commands = [{"name": name, "unit": "-"} for name in ("goal_a", "goal_b", "told_s")]
    study = study_of("goals", channels, commands, model)
    return Folder("goals", study, tables, {"told_s": "%.10g"})


SOUND: tuple[Callable[[Rng], Folder], ...] = (
    servo, servo_at_zero, joint, wheel, press, plate, pendulum, stage, arm, bench,
)  # fmt: skip
ALIKE: tuple[Callable[[Rng], Folder], ...] = (
    bounce, unsigned_torque, at_rest, stick_slip, full_scale, turns, end_stop, coarse, rounded,
    paused, kicked, goals, let_go,
)  # fmt: skip
