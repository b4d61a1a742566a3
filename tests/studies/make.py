"""Make the tables of the studies beside this file: ``python -m tests.studies.make [NAME ...]``.

What channels show is what the described model makes of the commands, its base parameters a third of
a standard deviation off, with noise. Bodies in flight are flown by formulas of their own.
"""

import sys
from collections.abc import Callable, Mapping

import numpy as np
import torch
import yaml
from scipy.spatial.transform import Rotation

from diffsim.systems.registry import setup_of
from tests.studies import HERE, NAMES, study_of
from tests.systems import small_copter

Columns = Mapping[str, np.ndarray]
OFF = 0.3  # base parameters [sd]
DIGITS = "%.9g"


def at(count: int, step: float) -> np.ndarray:
    """Times of samples [s]."""
    return step * np.arange(float(count))


def _commands(time: np.ndarray, **columns: Callable[[np.ndarray], np.ndarray]) -> Columns:
    return {"time_s": time, **{name: value(time) for name, value in columns.items()}}


def _moved(time: np.ndarray, size: float) -> Columns:
    return _commands(time, force=lambda t: size * np.where(t > 0.2, 1.0, 0.0) * np.cos(3.0 * t))


def _sweep(low: float, high: float) -> Columns:
    up = np.linspace(low, high, 18)
    return {"time_s": at(36, 1.0), "speed": np.r_[up, up[::-1] - 5.0]}


def _levels(name: str, unit: float, shares: tuple[float, ...]) -> Columns:
    return {"time_s": at(2 * len(shares), 1.0), name: unit * np.repeat(shares, 2)}


def _swing(name: str, most: float, period: float, time: np.ndarray) -> Columns:
    return {"time_s": time, name: 0.5 * most * (1.0 - np.cos(2.0 * np.pi / period * time))}


_POSES = ((1.0, 0.0), (2.0, 0.0), (0.0, 1.0), (0.0, 2.5), (1.5, 1.5), (3.0, 1.0))
_CART, _TANK, _TURN, _NET, _ROD = (
    at(60, 0.03),
    at(40, 0.5),
    at(60, 0.02),
    at(36, 0.25),
    at(18, 0.15),
)
_STROKE = at(24, 0.05)


def _pulls(left: float, right: float) -> Columns:
    swing = 0.65 - 0.35 * np.cos(np.pi * _ROD)  # never slack: what a drive loses has a kink there
    return {"time_s": _ROD, "left": left * swing, "right": right * swing**2}


#: Times and commands of each run, by study
TOLD: Mapping[str, Mapping[str, Columns]] = {
    "ode_places": {
        "step": _moved(_CART, 8.0),
        "sweep": _commands(_CART, force=lambda t: 10.0 * np.sin((2.0 + 4.0 * t) * t)),
        "large": _moved(_CART, -20.0),
        "saw": _commands(_CART, force=lambda t: 12.0 * np.abs((1.3 * t) % 2 - 1.0) - 6.0),
    },
    "ode_stores": {
        "rising": _commands(_TANK, pump=lambda t: 0.3 * t),
        "held": _commands(_TANK, pump=lambda t: 2.0 + np.sin(t)),
        "falling": _commands(_TANK, pump=lambda t: np.maximum(4.0 - 0.5 * t, 0.0)),
        "steps": _commands(_TANK, pump=lambda t: np.where(t % 10.0 < 5.0, 3.5, 1.0)),
    },
    "bench": {
        name: _sweep(100.0, most)
        for name, most in (("a", 900.0), ("b", 880.0), ("c", 910.0), ("again", 860.0))
    },
    "outside": {
        "sine": _commands(_TURN, moment_Nm=lambda t: 1.2 * np.sin(5.0 * t)),
        "steps": _commands(_TURN, moment_Nm=lambda t: np.where(t % 0.6 < 0.3, 0.8, -0.6)),
        "low": _commands(_TURN, moment_Nm=lambda t: 0.5 * np.sin(3.0 * t)),
        "chirp": _commands(_TURN, moment_Nm=lambda t: 1.5 * np.sin((2.0 + 5.0 * t) * t)),
    },
    "rod_in_time": {"left": _pulls(3.0, 0.0), "right": _pulls(0.0, 2.5), "both": _pulls(2.0, 1.0)},
    "soft_pulled": {
        name: _commands(_STROKE, pull_m=lambda t, m=most: m * np.sin(2.0 * t) ** 2)
        for name, most in (("small", 1e-3), ("middle", 2e-3), ("large", 3e-3), ("far", 2.5e-3))
    },
    "soft_swung": {
        name: {"time_s": at(16, 0.02) - 0.02} for name in ("light", "middle", "heavy", "last")
    },
    "flow_levels": {
        name: _levels("pump", 2e-8, shares)
        for name, shares in (
            *(("up", (0.2, 0.5, 1.0)), ("down", (0.9, 0.6, 0.1))),
            *(("few", (0.4, 0.7)), ("many", (0.3, 0.5, 0.8))),
        )
    },
    "flow_in_time": {
        name: _swing("pump", most, period, _NET)
        for name, most, period in (
            *(("slow", 2e-8, 8.0), ("fast", 2e-8, 2.5)),
            *(("small", 1e-8, 4.0), ("large", 3e-8, 4.0)),
        )
    },
    "flow_device": {
        name: _levels("flow_in_1_m2_s", 1e-4, shares)
        for name, shares in (
            *(("up", (0.5, 1.0)), ("down", (1.2, 0.4))),
            *(("few", (0.8,)), ("many", (0.6, 0.9))),
        )
    },
}


def throw(seed: int) -> Columns:
    """A ball that bounces twice or so: place, and speed upwards."""
    rng, radius = np.random.default_rng(seed), 0.02
    time, step = at(60, 1.0 / 60.0), 1e-4
    state = np.array([*rng.uniform(-0.5, 0.5, 2), 0.6, *rng.uniform(-1.0, 1.0, 2), 0.8])
    shown = []
    for k in range(round(time[-1] / step) + 1):
        if k % round(time[1] / step) == 0 or not shown:
            shown.append(state.copy())
        state[:3] += step * state[3:] - [0.0, 0.0, 0.5 * 9.81 * step**2]
        state[5] -= 9.81 * step
        if state[2] < radius and state[5] < 0.0:
            state[2], state[5] = 2.0 * radius - state[2], -0.87 * state[5]
    out = np.array(shown)
    time = step * round(time[1] / step) * np.arange(len(out))
    return {"time_s": time, **dict(zip("xyz", out.T, strict=False)), "vz": out[:, 5]}


def toss(seed: int) -> Columns:
    """A box in free flight by Euler's equations."""
    rng, edges, step = np.random.default_rng(seed), np.array([0.12, 0.08, 0.05]), 1e-3
    moments = (np.sum(edges**2) - edges**2) / 12.0
    turn, rate = Rotation.random(random_state=rng), rng.normal(0.0, 4.0, 3)
    start, speed = np.array([*rng.uniform(-0.3, 0.3, 2), 0.6]), np.array([0.5, -0.3, 1.0])
    time, quaternions = at(36, 0.01), []
    for k in range(351):
        if k % 10 == 0:
            quaternions.append(np.roll(turn.as_quat(), 1))
        half = rate + 0.5 * step * np.cross(moments * rate, rate) / moments
        rate = rate + step * np.cross(moments * half, half) / moments
        turn = turn * Rotation.from_rotvec(step * half)
    place = start + speed * time[:, None] - [0.0, 0.0, 0.5 * 9.81] * time[:, None] ** 2
    q = np.array(quaternions) * np.sign(np.array(quaternions) @ quaternions[0])[:, None]
    return {
        "time_s": time,
        **dict(zip("xyz", place.T, strict=True)),
        **dict(zip(("qw", "qx", "qy", "qz"), q.T, strict=True)),
    }


def flight(kind: str) -> Columns:
    """A second or so of the small copter of the tests, which has nothing of diffsim."""
    f = small_copter.fly(kind, small_copter.Causes(), seconds=1.2, fine=2)
    groups = {
        ("x", "y", "z"): f.position,
        ("qw", "qx", "qy", "qz"): f.quaternion,
        ("p", "q", "r"): f.rates,
        ("fx", "fy", "fz"): f.specific,
        ("n1", "n2", "n3", "n4"): f.speeds,
    }
    columns = {n: v[:, i] for names, v in groups.items() for i, n in enumerate(names)}
    return {"time_s": f.time, **columns}


def _write(name: str, table: str, columns: Columns) -> None:
    rows = np.column_stack(list(columns.values()))
    path = HERE / name / f"{table}.csv"
    np.savetxt(path, rows, fmt=DIGITS, delimiter=",", header=",".join(columns), comments="")


def _noise(name: str, rng: np.random.Generator, columns: Columns) -> Columns:
    stated = yaml.safe_load((HERE / name / "study.yaml").read_text())["channels"]
    sd = {c["name"]: c["sd"] for c in stated}
    return {k: v + rng.normal(0.0, sd[k], v.shape) if k in sd else v for k, v in columns.items()}


def make_flown(name: str) -> None:
    """Tables of bodies in flight."""
    rng = np.random.default_rng(7)
    for k, run in enumerate(yaml.safe_load((HERE / name / "study.yaml").read_text())["runs"]):
        made = (
            {"ball": throw, "toss": toss}[name](k) if name != "multicopter" else flight(run["name"])
        )
        _write(name, run["name"], _noise(name, rng, made))


def make_simulated(name: str) -> None:
    """Tables of what the described model shows under commands."""
    stated = yaml.safe_load((HERE / name / "study.yaml").read_text())["channels"]
    blank = {c["name"] for c in stated}
    for run, told in TOLD[name].items():
        _write(name, run, {**told, **{c: np.zeros_like(told["time_s"]) for c in blank}})
    study, rng = study_of(name), np.random.default_rng(7)
    model = setup_of(study).model
    q = torch.full((len(model.base),), OFF, dtype=torch.float64)
    for run in study.runs:
        with torch.no_grad():
            shown = model.predict(run, q).numpy()
        columns = {c.name: shown[:, i] for i, c in enumerate(study.channels)}
        _write(name, run.name, {**TOLD[name][run.name], **_noise(name, rng, columns)})


def make_poses(name: str) -> None:
    """One table of poses, a row each."""
    stated = yaml.safe_load((HERE / name / "study.yaml").read_text())["channels"]
    left, right = np.array(_POSES).T
    told = {"pose": np.arange(1, len(_POSES) + 1), "left": left, "right": right}
    _write(name, "poses", {**told, **{c["name"]: np.zeros(len(_POSES)) for c in stated}})
    study, rng = study_of(name), np.random.default_rng(7)
    model = setup_of(study).model
    q = torch.full((len(model.base),), OFF, dtype=torch.float64)
    by_pose = {int(run.name): run for run in study.runs}
    with torch.no_grad():
        rows = [model.predict(by_pose[int(k)], q).numpy()[0] for k in told["pose"]]
    shown = {c.name: np.array(rows)[:, i] for i, c in enumerate(study.channels)}
    _write(name, "poses", {**told, **_noise(name, rng, shown)})


if __name__ == "__main__":
    for name in sys.argv[1:] or NAMES:
        way = make_flown if name in ("ball", "toss", "multicopter") else make_simulated
        (make_poses if name == "rod_poses" else way)(name)
