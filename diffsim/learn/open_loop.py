"""Controllers with few parameters, their first guesses: sinusoids and knots."""

from __future__ import annotations

import numpy as np
import torch

from diffsim.control import Knots, OpenLoop, Sinusoid
from diffsim.core.check import require_choice
from diffsim.envs.task import Task

KINDS = ("sinusoid", "knots")


def make_open_loop(kind: str, task: Task, seed: int) -> OpenLoop:
    """A random first guess.

    Args:
        kind: "sinusoid", or "knots" (20 over an episode).
    """
    rng = np.random.default_rng([seed, 4])
    n, dt = task.num_actions, task.dt
    if require_choice("kind", kind, KINDS) == "sinusoid":
        return Sinusoid(
            n,
            dt,
            frequency=float(rng.uniform(0.5, 2.0)),
            amplitudes=rng.uniform(-0.5, 0.5, n).tolist(),
            phases=rng.uniform(-np.pi, np.pi, n).tolist(),
        )
    start = torch.from_numpy(rng.uniform(-0.5, 0.5, (20, n)))
    return Knots(n, dt, num_knots=20, duration=task.max_steps * dt, start=start)
