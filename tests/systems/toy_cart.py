"""A cart on a spring, described by formulas: recordings with hidden causes."""

import copy

import numpy as np
from scipy.integrate import solve_ivp

from diffsim.data.study import Channel, Run, Study

MODEL = {
    "system": "ode",
    "states": {"x": "0", "v": "0"},
    "rates": {"x": "v", "v": "(force - c*v - k*x)/m"},
    "readings": {"position_m": "x"},
    "inputs": [{"name": "force", "held": False}],
    "parameters": {
        "m": {"value": 1.0, "percent": 3, "unit": "kg"},
        "c": {"value": 0.8, "percent": 30, "unit": "N s/m"},
        "k": {"value": "40 N/m", "percent": 10},
    },
    "places": [{"name": "cart", "position": "x", "velocity": "v", "inertia": "m"}],
}
TIME = np.arange(0.0, 3.0, 0.01)
NOISE = 1e-3  # [m]


def _step(t, level):
    return np.where(t > 0.3, level, 0.0) * np.where(t > 2.0, -0.5, 1.0)


COMMANDS = {
    "step": (_step(TIME, 8.0), "fit"),
    "sweep": (10.0 * np.sin(2.0 * np.pi * (0.3 + 0.4 * TIME) * TIME), "fit"),
    "large": (_step(TIME, 20.0), "fit"),
    "saw": (12.0 * np.abs((0.8 * TIME) % 2 - 1.0) - 6.0, "test"),
}


def cart_study(*, force=None, drive=None, reading=None, noise=NOISE, seed=0, model=None):
    """Recordings of a true cart: m = 1.01 kg, c = 0.85 N s/m, k = 41 N/m, and what is hidden.

    Args:
        force: Function (x, v) of a further force [N].
        drive: Function of the recorded force, (num_samples,): the one that acts.
        reading: Function of the position: what is read.
        noise: Sd of the readings [m].
        seed: Seed of the noise.
        model: Description; None: ``MODEL``.
    """
    rng = np.random.default_rng(seed)
    runs = []
    for order, (name, (u, use)) in enumerate(COMMANDS.items()):
        acts = u if drive is None else drive(u)

        def rate(t, y, acts=acts):
            more = 0.0 if force is None else force(y[0], y[1])
            return [y[1], (np.interp(t, TIME, acts) - 0.85 * y[1] - 41.0 * y[0] + more) / 1.01]

        found = solve_ivp(
            rate, (0.0, TIME[-1]), [0.0, 0.0], t_eval=TIME, max_step=0.01, rtol=1e-6, atol=1e-8
        ).y[0]
        found = found if reading is None else reading(found)
        measured = found + noise * rng.normal(size=len(TIME))
        runs.append(
            Run(name, TIME, measured[:, None], {"force": u}, name, order, use, {"load_kg": 0.0})
        )
    channels = (Channel("position_m", "m", "position", noise),)
    return Study("cart", "ode", channels, tuple(runs), model=model or copy.deepcopy(MODEL))


def described(**changes):
    """The description with some of its keys replaced."""
    return {**copy.deepcopy(MODEL), **changes}
