"""What the time integrator does on its own: frequency and damping without material damping."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from examples.data import vibration
from examples.data.beam import BeamGeometry
from examples.data.beam_motion import RING_DOWN_START_S
from examples.demo.beam import Beam
from examples.demo.plan import Plan
from examples.demo.workers import Workers

INTEGRATORS = ("implicit_euler", "bdf2", "implicit_midpoint")
LENGTH_S = 1.0


def describe(
    bar: BeamGeometry, plan: Plan, youngs_modulus: float, workers: Workers
) -> dict[str, Any]:
    """Free vibration of the bare bar by every integrator and step."""

    def job(integrator: str, dt_s: float) -> Callable[[], dict[str, Any]]:
        def compute() -> dict[str, Any]:
            setup = plan.published().changed(integrator=integrator, dt_s=dt_s)
            with torch.no_grad():
                run = Beam(bar, setup).release(
                    {"youngs_modulus": youngs_modulus}, LENGTH_S, tick=workers.tick
                )
            found = motion(run.time_s, run.tip_m[:, 2].numpy())
            return {"integrator": integrator, "dt_s": dt_s, **found}

        return compute

    rows = workers.run([job(name, dt) for name in INTEGRATORS for dt in plan.damping_dt_s])
    return {"youngs_modulus_Pa": youngs_modulus, "rows": rows}


def num_steps(plan: Plan) -> int:
    """Time steps of ``describe``."""
    return sum(len(INTEGRATORS) * round(LENGTH_S / dt) for dt in plan.damping_dt_s)


def motion(time_s: np.ndarray, z: np.ndarray) -> dict[str, Any]:
    """Frequency and damping ratio of a simulated ring-down, as the measured ones are found."""
    free = time_s >= RING_DOWN_START_S
    decay = vibration.fit_decay(time_s[free], z[free], drift="none")
    return {"frequency_Hz": decay.frequency_Hz, "damping_ratio": decay.damping_ratio}


def euler_damping_ratio(omega: float, dt_s: float) -> float:
    """Damping ratio that implicit Euler gives an undamped mode, about omega dt / 2.

    One step multiplies the mode by 1 / (1 - i omega dt): its logarithm is decay and turn.
    """
    decay, turn = 0.5 * np.log1p((omega * dt_s) ** 2), np.arctan(omega * dt_s)
    return float(decay / np.hypot(decay, turn))
