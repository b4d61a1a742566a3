"""A pendulum as described: held torques, a clock that is not even, and rows that got lost."""

import copy

import numpy as np
from scipy.integrate import solve_ivp

from diffsim.data.study import Channel, Run, Study

STEP = 0.01  # [s], of the recorder's clock, about
TRUE = {"J": 0.0172, "c": 0.021, "k": 0.94}
MODEL = {
    "system": "ode",
    "states": {"angle": "0", "speed": "0"},
    "rates": {"angle": "speed", "speed": "(torque - c*speed - k*sin(angle))/J"},
    "readings": {"angle_rad": "angle + zero"},
    "inputs": [{"name": "torque", "held": True}],
    "parameters": {
        "J": {"value": 0.017, "percent": 10, "unit": "kg m^2"},
        "c": {"value": 0.02, "percent": 40, "unit": "N m s/rad"},
        "k": {"value": 0.95, "percent": 5, "unit": "N m"},
        "zero": {"value": 0.0, "sd": 0.01, "unit": "rad", "per": "run"},
    },
    "places": [
        {
            "position": "angle",
            "velocity": "speed",
            "inertia": "J",
            "unit": "N m",
            "position_unit": "rad",
        }
    ],
}


def _clock(rng, duration, jitter):
    steps = STEP * (1.0 + jitter * rng.uniform(-1.0, 1.0, int(duration / STEP)))
    return np.concatenate([[0.0], np.cumsum(steps)])


def held_steps(rng, time):
    """Torques that rest for 0.2 to 0.6 s and jump [N m]."""
    edges = np.cumsum(rng.uniform(0.2, 0.6, 100))
    return rng.uniform(-0.45, 0.45, 101)[np.searchsorted(edges, time, side="right")]


def pendulum_study(
    *, lost=0.02, jitter=0.2, noise=1e-3, seed=0, duration=8.0, command=held_steps, model=None
):
    """Recordings of the pendulum, its command written at every row.

    Args:
        lost: Share of the rows that the recorder dropped.
        jitter: Of its steps, as a share.
        noise: Sd of the readings [rad].
        seed: Seed of everything.
        duration: Of each run [s].
        command: Function (rng, time) of the torque at the rows, (num_samples,).
        model: Description; None: ``MODEL``.
    """
    rng = np.random.default_rng(seed)
    runs = []
    for order, use in enumerate(("fit", "fit", "fit", "select", "test")):
        time = _clock(rng, duration, jitter)
        torque = command(rng, time)
        state, path = np.zeros(2), [0.0]
        for start, end, u in zip(time, time[1:], torque, strict=False):

            def rate(t, y, u=u):
                return [y[1], (u - TRUE["c"] * y[1] - TRUE["k"] * np.sin(y[0])) / TRUE["J"]]

            state = solve_ivp(rate, (start, end), state, rtol=1e-8, atol=1e-10).y[:, -1]
            path.append(state[0])
        measured = np.array(path) + noise * rng.normal(size=len(time))
        kept = rng.uniform(size=len(time)) >= lost
        kept[0] = True
        name = f"run_{order}"
        held = {"torque": torque[kept]}
        runs.append(Run(name, time[kept], measured[kept, None], held, name, order, use))
    channels = (Channel("angle_rad", "rad", "angle", noise),)
    return Study("pendulum", "ode", channels, tuple(runs), model=model or copy.deepcopy(MODEL))
