"""A task as a gymnasium vector environment: the whole batch in one call of the simulator."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from diffsim.core.check import require_choice
from diffsim.core.check_options import require_count
from diffsim.envs.env import RENDER_MODES, action_rows, refuse_reset_options, spaces_of
from diffsim.envs.sensing import Sensing
from diffsim.envs.task import Task, TaskState, where


class TaskVectorEnv(VectorEnv):
    """Many episodes of a task side by side.

    An episode that ends starts again within the same step (``AutoresetMode.SAME_STEP``): the
    observation returned is that of the new episode, and ``info["final_obs"]`` holds the last one of
    the old, so that a truncated episode can be bootstrapped.

    Args:
        task: What is simulated; one prepared solver serves all members.
        num_envs: Members of the batch.
        render_mode: "rgb_array" or None.
        sensor_noise: Standard deviation of white noise on observations.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": list(RENDER_MODES),
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        task: Task,
        num_envs: int,
        *,
        render_mode: str | None = None,
        sensor_noise: float | NDArray[np.float64] = 0.0,
    ):
        num_envs = require_count("num_envs", num_envs, at_least=1)
        if render_mode is not None:
            require_choice("render_mode", render_mode, RENDER_MODES)
        self.task, self.num_envs, self.render_mode = task, num_envs, render_mode
        self.sensing = Sensing(sensor_noise, task.num_observations)
        self.single_action_space, self.single_observation_space = spaces_of(task)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.state: TaskState | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start all episodes."""
        super().reset(seed=seed)
        refuse_reset_options(self.task, options)
        with torch.no_grad():
            self.state = self.task.start(self.num_envs, self.np_random)
        return self._observations(), {}

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[
        NDArray[np.float32],
        NDArray[np.float64],
        NDArray[np.bool_],
        NDArray[np.bool_],
        dict[str, Any],
    ]:
        """One control step of all members."""
        if self.state is None:
            raise RuntimeError(f"{self.task.name}: call reset() before step()")
        rows = action_rows(self.task, actions, (self.num_envs,))
        with torch.no_grad():
            self.state, terms = self.task.step_terms(self.state, rows)
            failed = self.task.failed(self.state)
        reward = torch.stack(list(terms.values())).sum(0).numpy()
        ended = self.state["step"] >= self.task.max_steps
        terminated, truncated = failed.numpy().copy(), (ended & ~failed).numpy().copy()
        info: dict[str, Any] = {}
        for name, value in terms.items():
            info[name], info[f"_{name}"] = value.numpy(), np.ones(self.num_envs, dtype=bool)
        done = terminated | truncated
        if done.any():
            info |= self._final(done)
            self._restart(torch.from_numpy(done))
        return self._observations(), reward, terminated, truncated, info

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Pictures of all members."""
        if self.render_mode is None or self.state is None:
            return None
        return tuple(self.task.picture(self.state, k) for k in range(self.num_envs))

    def differentiable_step(self, state: TaskState, action: Tensor) -> tuple[TaskState, Tensor]:
        """The same step in torch: see ``Task.step``. Leaves the environment's own state alone."""
        return self.task.step(state, action)

    def _final(self, done: NDArray[np.bool_]) -> dict[str, Any]:
        """Last observations of the episodes that end, as gymnasium's vector environments give."""
        last = np.empty(self.num_envs, dtype=object)
        for k, row in enumerate(self._observations()):
            last[k] = row if done[k] else None
        return {"final_obs": last, "_final_obs": done.copy()}

    def _restart(self, done: Tensor) -> None:
        assert self.state is not None  # of step
        with torch.no_grad():
            fresh = self.task.start(int(done.sum()), self.np_random)
        index = torch.cumsum(done, 0) - 1  # place of a member among the fresh ones
        spread = {name: value[index.clamp(min=0)] for name, value in fresh.items()}
        self.state = where(done, spread, self.state)

    def _observations(self) -> NDArray[np.float32]:
        assert self.state is not None  # of reset and step
        with torch.no_grad():
            plain = self.task.observe(self.state).numpy()
        return self.sensing(plain, self.np_random)
