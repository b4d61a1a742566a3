"""L-BFGS for controllers with few parameters: sinusoids and knots."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from diffsim import optim
from diffsim.control import Knots, OpenLoop, Sinusoid
from diffsim.core.arrays import Array
from diffsim.core.check import require_choice
from diffsim.core.errors import DiffsimError
from diffsim.envs.rollout import rollout_task
from diffsim.envs.task import Task
from diffsim.learn.setup import broke_down

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


def fit_open_loop(
    task: Task, controller: OpenLoop, *, seed: int, batch: int = 1, max_iterations: int
) -> optim.Result:
    """Maximize the mean reward of fixed episodes with L-BFGS; changes ``controller``.

    Args:
        controller: First guess, which the fit changes.
        batch: Number of episodes side by side.
        max_iterations: Largest number of iterations of L-BFGS.

    Returns:
        The search's result; its values are minus the mean reward per step. The controller gets the
        parameters of ``final``.

    Raises:
        DiffsimError: the simulation of the first guess breaks down.
    """
    start = task.start(batch, np.random.default_rng([seed, 5]))
    trained = [p for p in controller.parameters() if p.requires_grad]
    first = parameters_to_vector(trained).detach().numpy().astype(np.float64)

    def loss_and_gradient(x: Array) -> tuple[float, Array]:
        vector_to_parameters(torch.from_numpy(x), trained)
        try:
            loss: Tensor = -rollout_task(task, controller, start, task.max_steps).rewards.mean()
            parts = torch.autograd.grad(loss, trained)
        except (ArithmeticError, RuntimeError, ValueError) as error:
            if not broke_down(error):
                raise
            raise DiffsimError(f"the simulation broke down: {error}") from error
        return float(loss.detach()), torch.cat([g.flatten() for g in parts]).numpy()

    budget = optim.Budget(evaluations=None, iterations=max_iterations)
    result = optim.minimize(loss_and_gradient, first, options=optim.Options(budget=budget))
    vector_to_parameters(torch.from_numpy(result.final.x.copy()), trained)
    return result
