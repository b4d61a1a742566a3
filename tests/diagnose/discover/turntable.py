"""A turntable with a motor, recorded by an encoder: its equations in numpy, what is hidden too."""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.data.study import Channel, Column, Run, Study

Array = NDArray[np.float64]
STEP, SUBSTEPS, COUNT = 0.02, 8, 240
NOISE = 1e-3  # [rad]
INERTIA, DAMPING = 0.0102, 0.0185  # of the true one [kg m^2], [N m s/rad]
MODEL: dict[str, Any] = {
    "system": "ode",
    "states": {"angle": "0", "speed": "0"},
    "rates": {"angle": "speed", "speed": "(torque - drag)/J"},
    "define": {"drag": "c*speed"},
    "readings": {"angle_rad": "angle"},
    "inputs": [{"name": "torque", "held": True}],
    "parameters": {
        "J": {"value": 0.01, "percent": 5, "unit": "kg m^2"},
        "c": {"value": 0.02, "percent": 30, "unit": "N m s/rad"},
    },
    "places": [
        {
            "name": "shaft",
            "position": "angle",
            "velocity": "speed",
            "inertia": "J",
            "unit": "N m",
            "position_unit": "rad",
        }
    ],
    # few rivals: what is tested here are laws
    "effects": {"only": ["dry_friction_at_shaft", "square_drag_at_shaft", "command_gain"]},
}
USES = ("fit", "fit", "fit", "select", "test")
Push = Callable[[Array, Array, Array], Any]


def described(**changes: Any) -> dict[str, Any]:
    """The description with some of its keys replaced."""
    return {**copy.deepcopy(MODEL), **changes}


def turntable_study(
    push: Push = lambda angle, speed, temp: 0.0,
    *,
    uses: tuple[str, ...] = USES,
    noise: float = NOISE,
    seed: int = 0,
    count: int = COUNT,
    model: dict[str, Any] | None = None,
) -> Study:
    """Recordings of the table, all runs side by side.

    Args:
        push: Function (angle, speed, temp) of a further torque [N m], each (num_runs,).
        uses: What each run is for.
        noise: Sd of the readings [rad].
        seed: Seed of commands and noise.
        count: Samples of each run.
        model: Description; None: ``MODEL``.
    """
    rng = np.random.default_rng(seed)
    time = STEP * np.arange(count)
    num_runs = len(uses)
    edges = np.cumsum(rng.uniform(0.2, 0.6, (num_runs, 100)), axis=1)
    levels = rng.uniform(-0.1, 0.2, (num_runs, 101))
    torque = np.stack(
        [u[np.searchsorted(e, time, side="right")] for u, e in zip(levels, edges, strict=True)]
    )
    warm = rng.uniform(0.0, 2.0 * np.pi, (num_runs, 1))
    temp = 298.0 + 12.0 * np.sin(0.9 * time + warm) + rng.uniform(-4.0, 4.0, (num_runs, 1))
    path = _turn(torque, temp, push)
    measured = path + noise * rng.normal(size=path.shape)
    runs = tuple(
        Run(
            f"run_{k}",
            time,
            measured[k, :, None],
            {"torque": torque[k]},
            f"run_{k}",
            k,
            use,
            columns={"temp": temp[k]},
        )
        for k, use in enumerate(uses)
    )
    channels = (Channel("angle_rad", "rad", "angle", noise),)
    columns = (Column("temp", "K", "temp (K)"),)
    return Study("turntable", "ode", channels, runs, columns=columns, model=model or described())


def _turn(torque: Array, temp: Array, push: Push) -> Array:
    """Angle at the samples [rad], by Runge and Kutta's method on a finer grid."""
    h, count = STEP / SUBSTEPS, torque.shape[1]
    y = np.zeros((2, len(torque)))
    out = np.zeros_like(torque)
    for k in range(count - 1):
        for j in range(SUBSTEPS):

            def rate(y: Array, share: float, k: int = k) -> Array:
                now = (1.0 - share) * temp[:, k] + share * temp[:, k + 1]
                angle, speed = y
                force = torque[:, k] - DAMPING * speed + push(angle, speed, now)
                return np.array([speed, force / INERTIA])

            at, middle, end = j / SUBSTEPS, (j + 0.5) / SUBSTEPS, (j + 1) / SUBSTEPS
            k1 = rate(y, at)
            k2 = rate(y + 0.5 * h * k1, middle)
            k3 = rate(y + 0.5 * h * k2, middle)
            y = y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rate(y + h * k3, end))
        out[:, k + 1] = y[0]
    return out
