"""CMA-ES (package ``cma``) for controllers with few parameters: sinusoids and knots.

Hansen, "The CMA evolution strategy: a tutorial", 2016.

Of a batch of episodes, every member is steered by parameters of its own.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cma
import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.envs.rollout import Controller, rollout_task
from diffsim.envs.task import Task
from diffsim.learn.open_loop import make_open_loop
from diffsim.learn.run import Update, rng_state, set_rng_state
from diffsim.learn.setup import Setup, broke_down


@checked
@dataclass(frozen=True)
class CmaOptions:
    """Options of ``CmaLearner``.

    Attributes:
        kind: Kind of the controller, "sinusoid" or "knots": open loop, no network.
        population: Candidates per generation.
        episodes: Per candidate; all candidates of a generation meet the same starts.
        spread: First standard deviation of the parameters.
    """

    kind: str = "sinusoid"
    population: int = 8
    episodes: int = 1
    spread: float = 0.5


class CmaLearner:
    """One generation per update, all its candidates in one batch; rated is the mean of the search.

    Args:
        setup: Task and seed.
        options: Options of the method.
    """

    @checked
    def __init__(self, setup: Setup, options: CmaOptions | None = None):
        self.options = options or CmaOptions()
        self.task: Task = setup.require_new().make_task()
        self.seed = setup.seed
        self.net = make_open_loop(self.options.kind, self.task, setup.seed)
        self.trained = {k: p for k, p in self.net.named_parameters() if p.requires_grad}
        self.rng = np.random.default_rng([setup.seed, 6])  # of the episodes' starts
        self.values: list[list[float]] = []  # of all candidates so far, by generation
        self.search = self._begin()

    def controller(self) -> nn.Module:
        """The open-loop controller at the mean of the search."""
        out = copy.deepcopy(self.net)
        mean = torch.from_numpy(np.asarray(self.search.mean, dtype=np.float64))
        vector_to_parameters(mean, [p for p in out.parameters() if p.requires_grad])
        return out

    @checked(kinds_only=True)
    def update(self, progress: float) -> Update:
        """One generation; a batch that breaks down counts as worse than all before."""
        o = self.options
        candidates = self.search.ask()
        try:
            values = (-self._rewards(np.array(candidates))).tolist()
        except (ArithmeticError, RuntimeError, ValueError) as error:
            if not broke_down(error):
                raise
            values = [math.inf] * len(candidates)
        self.search.tell(candidates, values)
        self.values.append(values)
        steps = o.population * o.episodes * self.task.max_steps
        scalars = {"train/reward": -min(values), "train/spread": float(self.search.sigma)}
        return Update(steps, 0, scalars)

    def _begin(self) -> Any:
        """A search whose random numbers are its own: the package's default are global."""
        rng = np.random.default_rng([self.seed, 7])
        first = parameters_to_vector(list(self.trained.values())).detach().numpy()
        options = {
            "popsize": self.options.population,
            "randn": lambda *shape: rng.standard_normal(shape),
            "seed": math.nan,
            "verbose": -9,
        }
        return cma.CMAEvolutionStrategy(first, self.options.spread, options)

    def _rewards(self, candidates: Array) -> Tensor:
        """Mean reward per step of each candidate, (population,)."""
        episodes = self.options.episodes
        start = self.task.start(episodes, self.rng)
        many = {k: v.repeat(len(candidates), *(1,) * (v.dim() - 1)) for k, v in start.items()}
        rows = torch.from_numpy(candidates).repeat_interleave(episodes, 0)
        weights, place = {}, 0
        for name, p in self.trained.items():
            weights[name] = rows[:, place : place + p.numel()].reshape(-1, *p.shape)
            place += p.numel()
        with torch.no_grad():
            steer = steer_members(self.net, weights)
            rewards = rollout_task(self.task, steer, many, self.task.max_steps).rewards
        return rewards.mean(0).reshape(len(candidates), episodes).mean(1)

    def state_dict(self) -> dict[str, Any]:
        """See ``Learner``. The search is what it has been told: it is told again on resuming."""
        return {"values": [list(v) for v in self.values], "rng": rng_state(self.rng)}

    @checked(kinds_only=True)
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See ``Learner``."""
        self.values = [list(v) for v in state["values"]]
        set_rng_state(self.rng, state["rng"])
        self.search = self._begin()
        for values in self.values:
            self.search.tell(self.search.ask(), values)


def steer_members(controller: nn.Module, parameters: Mapping[str, Tensor]) -> Controller:
    """A controller whose member k of the batch has parameters[k].

    Args:
        controller: Whose call it is, and whose buffers and other parameters all members share.
        parameters: By name, (batch, ...) each; differentiable.
    """
    buffers = dict(controller.named_buffers())

    def steer(observation: Tensor, step: int) -> Tensor:
        def one(weights: Mapping[str, Tensor], seen: Tensor) -> Tensor:
            out: Tensor = functional_call(controller, {**buffers, **weights}, (seen, step))
            return out

        actions: Tensor = vmap(one)(dict(parameters), observation)
        return actions

    return steer
