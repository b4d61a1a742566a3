"""A lever on a motor, described by formulas: gentle runs swing, wild ones turn over."""

import copy
from dataclasses import replace

import numpy as np
from scipy.integrate import solve_ivp

from diffsim.data.study import Channel, Run, Study

STEP = 0.01  # [s]
TRUE = {"J": 0.0102, "c": 0.0115, "k": 0.51, "friction": 0.03}
MODEL = {
    "system": "ode",
    "time_step": 0.005,
    "states": {"angle": "first_angle_rad", "speed": "0"},
    "rates": {"angle": "speed", "speed": "(torque - c*speed - k*sin(angle))/J"},
    "readings": {"angle_rad": "angle"},
    "inputs": [{"name": "torque", "held": False}],
    "parameters": {
        "J": {"value": 0.01, "percent": 5, "unit": "kg m^2"},
        "c": {"value": 0.01, "percent": 30, "unit": "N m s/rad"},
        "k": {"value": 0.5, "percent": 5, "unit": "N m"},
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
MODEL["effects"] = {
    "only": [
        "dry_friction_at_axis",
        "square_drag_at_axis",
        "command_gain",
        "sensor_scale",
        "cubic_stiffness_at_axis",
    ]
}


def command(amplitude, phase, time):
    """Torque near the lever's own frequency [N m], (num_samples,)."""
    beats = np.sin(2.0 * np.pi * (0.9 + 0.05 * time) * time + phase)
    return amplitude * beats * np.cos(0.7 * time + phase)


def lever_study(
    *,
    wild=True,
    friction=TRUE["friction"],
    noise=3e-3,
    seed=0,
    duration=8.0,
    kept=None,
    model=None,
    only=None,
):
    """Recordings of a true lever.

    Args:
        wild: Whether it is driven over the top.
        friction: Dry friction that the description lacks [N m].
        noise: Sd of the readings [rad].
        seed: Seed of the commands, starts and noise.
        duration: Of each run [s].
        kept: Function (rng, time) of the samples that are recorded; None: all.
        model: Description; None: ``MODEL``.
        only: Name of the run that is there alone, to be fitted; None: all.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, duration, STEP)
    runs = []
    for order, use in enumerate(("fit", "fit", "fit", "select", "test")):
        torque = command(rng.uniform(0.45, 0.8) if wild else 0.06, rng.uniform(0.0, 6.0), time)

        def rate(t, y, torque=torque):
            rest = friction * np.tanh(y[1] / 0.1)
            drive = np.interp(t, time, torque)
            k = TRUE["k"]
            return [y[1], (drive - TRUE["c"] * y[1] - k * np.sin(y[0]) - rest) / TRUE["J"]]

        start = [rng.uniform(-0.3, 0.3), 0.0]
        path = solve_ivp(rate, (0.0, duration), start, t_eval=time, max_step=0.005, rtol=1e-8).y[0]
        measured = path + noise * rng.normal(size=len(time))
        rows = np.arange(len(time)) if kept is None else kept(rng, time)
        name = f"run_{order}"
        runs.append(
            Run(name, time[rows], measured[rows, None], {"torque": torque[rows]}, name, order, use)
        )
    if only is not None:
        runs = [replace(run, use="fit") for run in runs if run.name == only]
    channels = (Channel("angle_rad", "rad", "angle", noise),)
    return Study("lever", "ode", channels, tuple(runs), model=model or copy.deepcopy(MODEL))
