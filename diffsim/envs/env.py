"""A task as a gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor

from diffsim.core.arrays import Array
from diffsim.core.check import require_choice
from diffsim.core.checked import checked
from diffsim.envs.sensing import ObservationNoise
from diffsim.envs.starts import with_options
from diffsim.envs.task import Entry, Task, TaskState, detached
from diffsim.envs.window import PictureWindow

RENDER_MODES = ("rgb_array", "human")


class TaskEnv(gymnasium.Env):
    """One episode at a time of a task.

    Args:
        task: What is simulated.
        render_mode: "rgb_array", "human" (a window that shows every step) or None.
        sensor_noise: Standard deviation of white noise on observations.

    ``info`` holds the terms of the reward by name. An episode that reaches ``task.max_steps`` is
    truncated, not terminated: its last state has a value.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 30}  # noqa: RUF012

    def __init__(
        self,
        task: Task,
        *,
        render_mode: str | None = None,
        sensor_noise: float | Array = 0.0,
    ):
        if render_mode is not None:
            require_choice("render_mode", render_mode, RENDER_MODES)
        self.task, self.render_mode = task, render_mode
        self.metadata = {**type(self).metadata, "render_fps": frame_rate(task)}
        self.sensing = ObservationNoise(sensor_noise, task.num_observations)
        self.action_space, self.observation_space = spaces_of(task)
        self.state: TaskState | None = None
        self._has_ended = False
        self.window = PictureWindow(task.name, frame_rate(task)) if render_mode == "human" else None

    @checked(kinds_only=True)
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Of everything drawn at random from here on; None: go on drawing.
            options: Quantities of the first state by name (``task.start`` has them), each
                broadcast to (1, ...); all of ``differentiable_state()`` starts a copy of it.
        """
        super().reset(seed=seed)
        with torch.no_grad():
            state = self.task.start(1, self.np_random)
        self.state = with_options(state, options or {}, self.task.name)
        self._has_ended = False
        self._show()
        return self._observation(), {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """One control step."""
        state = self._require_started()
        if self._has_ended:
            raise gymnasium.error.ResetNeeded(
                f"{self.task.name}: the episode has ended after {int(state['step'][0])} steps; "
                "call reset() before the next step()"
            )
        row = action_rows(self.task, action, ())[None]
        with torch.no_grad():
            self.state, terms = self.task.step_terms(state, row)
            failed = bool(self.task.failed(self.state).item())
        info = {name: value.item() for name, value in terms.items()}
        truncated = self.state["step"].item() >= self.task.max_steps
        self._has_ended = failed or truncated
        self._show()
        return self._observation(), sum(info.values()), failed, truncated and not failed, info

    def render(self) -> NDArray[np.uint8] | None:
        """Picture of the present state, (height, width, 3); None with a window."""
        if self.render_mode is None:
            gymnasium.logger.warn(
                f"{self.task.name}: render() without a render_mode; make the environment with "
                'render_mode="rgb_array"'
            )
            return None
        if self.render_mode == "human":  # every step shows itself
            return None
        return self.task.picture(self._require_started(), 0)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self.window is not None:
            self.window.close()
            self.window = None
        super().close()

    def differentiable_step(self, state: TaskState, action: Tensor) -> tuple[TaskState, Tensor]:
        """The same step in torch: see ``Task.step``. Leaves the environment's own state alone."""
        return self.task.step(state, action)

    def differentiable_state(self) -> TaskState:
        """A copy of the present state, from which ``differentiable_step`` can go on."""
        return {k: v.clone() for k, v in detached(self._require_started()).items()}

    def _show(self) -> None:
        if self.window is not None:
            self.window.show(self.task.picture(self._require_started(), 0))

    def _require_started(self) -> TaskState:
        if self.state is None:
            raise gymnasium.error.ResetNeeded(f"{self.task.name}: call reset() before step()")
        return self.state

    def _observation(self) -> NDArray[np.float32]:
        with torch.no_grad():
            plain = self.task.observe(self._require_started())[0].numpy()
        return self.sensing(plain, self.np_random)


def action_rows(task: Task, action: Any, batch: tuple[int, ...]) -> Tensor:
    """Actions as the task takes them, (*batch, num_actions) float64.

    Raises:
        TypeError: not numbers.
        ValueError: another shape, or not finite.
    """
    try:
        given = np.asarray(action, dtype=np.float64)
    except (TypeError, ValueError):
        raise TypeError(f"{task.name}: action must be numbers, got {action!r}") from None
    shape = (*batch, task.num_actions)
    if given.shape != shape:
        raise ValueError(
            f"{task.name}: action must have shape {shape}, one for each actuator, got {given.shape}"
        )
    if not np.isfinite(given).all():
        raise ValueError(f"{task.name}: action must be finite, got {given.tolist()}")
    return torch.from_numpy(given.copy())


def frame_rate(task: Task) -> int:
    """Pictures per second at which a film runs as fast as the robot."""
    return max(1, round(1.0 / task.dt))


def spaces_of(task: Task) -> tuple[spaces.Box, spaces.Box]:
    """Action and observation space, float32."""
    return _box(task.actions), _box(task.observations)


def _box(entries: tuple[Entry, ...]) -> spaces.Box:
    low = np.array([e.low for e in entries], dtype=np.float32)
    high = np.array([e.high for e in entries], dtype=np.float32)
    return spaces.Box(low, high, dtype=np.float32)
