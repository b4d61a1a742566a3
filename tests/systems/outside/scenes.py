"""Recordings of the test pendulum, and the study that describes it as an outside simulator."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from diffsim.causes import rows
from diffsim.causes.ports import OF_FORCES
from diffsim.core.expression import Expression, parse_expression
from diffsim.data.study import Channel, Run, Study
from diffsim.systems.outside.forces import PlaceForces, Term
from tests.systems.outside.pendulum_sim import Pendulum

HERE = Path(__file__).parent
TIME = 0.02 * np.arange(120)
CHANNELS = (
    Channel("angle_rad", "rad", "angle", sd=2e-3),
    Channel("rate_rad_s", "rad/s", "velocity", sd=2e-2),
)
MOMENTS = {
    "sine": 1.2 * np.sin(5.0 * TIME),
    "steps": np.where(TIME % 1.2 < 0.6, 0.8, -0.6) * np.minimum(20.0 * TIME, 1.0),
    "chirp": 1.5 * np.sin(2.0 * np.pi * (0.3 + 0.35 * TIME) * TIME),
}
TRUTH = {"inertia": 0.21, "damping": 0.06, "gravity_moment": 1.9}
MODEL = {
    "system": "outside",
    "simulator": "pendulum_sim.py:Pendulum",
    "parameters": {
        "inertia": {"value": 0.2, "percent": 10, "unit": "kg m^2"},
        "damping": {"value": 0.05, "percent": 60, "unit": "N m s/rad"},
        "gravity_moment": {"value": 2.0, "percent": 10, "unit": "N m"},
    },
    "hooks": {"force": {"hinge": {"unit": "N m", "typical": 0.05, "distance": 0.5, "speed": 3.0}}},
}


def law_of(cause: str) -> Expression:
    """Formula of a force by the name of its row."""
    return parse_expression(rows("force")[cause].said("law"), OF_FORCES)


def run_of(name: str, use: str = "fit", order: int = 0) -> Run:
    """A run of the test pendulum, nothing measured yet."""
    group = name.split("_")[0]
    blank = np.zeros((len(TIME), len(CHANNELS)))
    return Run(name, TIME, blank, {"moment_Nm": MOMENTS[group]}, group, order, use)


def recorded(*terms: Term, delay: float = 0.0, seed: int = 0) -> Study:
    """Sine and steps, twice each, and a chirp for the test, with these forces at the hinge."""
    rng, runs = np.random.default_rng(seed), []
    for order, name in enumerate(("sine_a", "sine_b", "steps_a", "steps_b", "chirp")):
        run = run_of(name, "test" if name == "chirp" else "fit", order)
        late = np.interp(TIME - delay, TIME, run.command["moment_Nm"])
        driven = replace(run, command={"moment_Nm": late})
        clean = Pendulum(8).predict(TRUTH, driven, PlaceForces(["hinge"], terms))
        noise = rng.standard_normal(clean.shape) * [c.sd for c in CHANNELS]
        runs.append(replace(run, measured=clean + noise))
    return Study("pendulum", "outside", CHANNELS, tuple(runs), model=MODEL, folder=HERE)
