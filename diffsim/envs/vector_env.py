"""A task as a gymnasium vector environment: the whole batch in one call of the simulator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from diffsim.core.arrays import Array, Mask
from diffsim.core.check import require_choice, require_count
from diffsim.core.checked import checked
from diffsim.envs.env import RENDER_MODES, action_rows, frame_rate, spaces_of
from diffsim.envs.sensing import ObservationNoise
from diffsim.envs.starts import RESET_MASK, Generators, checked_mask, with_options
from diffsim.envs.task import Task, TaskState
from diffsim.envs.window import PictureWindow, side_by_side

Floats = NDArray[np.float32]
Bools = Mask
Members = NDArray[np.intp]


class TaskVectorEnv(VectorEnv):
    """Many episodes of a task side by side.

    ``autoreset_mode`` says what follows the end of an episode, as gymnasium defines it:

    - SAME_STEP: the step that ends it starts the next one. The observation is that of the new
      episode; ``info["final_obs"]`` holds the last one of the old, so that a truncated episode can
      be bootstrapped.
    - NEXT_STEP: the next step starts it, whatever its action, with a reward of zero.
    - DISABLED: ``reset(options={"reset_mask": ended})`` does.

    Args:
        task: What is simulated; one prepared solver serves all members.
        num_envs: Members of the batch.
        autoreset_mode: One of the above, or its value ("SameStep", "NextStep", "Disabled").
        render_mode: "rgb_array", "human" (a window) or None.
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
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        render_mode: str | None = None,
        sensor_noise: float | Array = 0.0,
    ):
        num_envs = require_count("num_envs", num_envs, at_least=1)
        if render_mode is not None:
            require_choice("render_mode", render_mode, RENDER_MODES)
        self.task, self.num_envs, self.render_mode = task, num_envs, render_mode
        self.autoreset_mode = _mode(autoreset_mode)
        self.metadata = {
            **type(self).metadata,
            "render_fps": frame_rate(task),
            "autoreset_mode": self.autoreset_mode,
        }
        self.sensing = ObservationNoise(sensor_noise, task.num_observations)
        self.single_action_space, self.single_observation_space = spaces_of(task)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.state: TaskState | None = None
        self.window = PictureWindow(task.name, frame_rate(task)) if render_mode == "human" else None
        self._generators = Generators(self.num_envs)
        self._ended = np.zeros(self.num_envs, dtype=bool)
        self._seen = np.zeros((self.num_envs, task.num_observations), dtype=np.float32)

    @checked(kinds_only=True)
    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Floats, dict[str, Any]]:
        """Start episodes.

        Args:
            seed: One for the batch, which then draws from a single generator; or one per member,
                whose episodes then are those of a single environment with that seed.
            options: Quantities of the first states by name (``task.start`` has them), each
                broadcast to (num_envs, ...). ``reset_mask``, (num_envs,) bool, restarts those
                members only.
        """
        options = dict(options or {})  # wrappers read theirs after us
        mask = options.pop(RESET_MASK, None)
        chosen = np.ones(self.num_envs, bool) if mask is None else checked_mask(mask, self.num_envs)
        if self.state is None and mask is not None:
            raise ValueError(f"{self.task.name}: reset once without a {RESET_MASK} first")
        members = np.flatnonzero(chosen)
        if seed is None or isinstance(seed, int | np.integer):
            super().reset(seed=None if seed is None else int(seed))
            if seed is not None:
                self._generators.each = None
        else:
            self._generators.seed_each(list(seed), members, self.np_random)
        self._restart(members, options)
        self._show()
        return self._seen.copy(), {}

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Floats, Array, Bools, Bools, dict[str, Any]]:
        """One control step of all members."""
        if self.state is None:
            raise RuntimeError(f"{self.task.name}: call reset() before step()")
        rows = action_rows(self.task, actions, (self.num_envs,))
        if self.autoreset_mode == AutoresetMode.DISABLED and self._ended.any():
            over = ", ".join(str(k) for k in np.flatnonzero(self._ended))
            raise ValueError(
                f"{self.task.name}: the episodes of member {over} have ended; restart them with "
                f'reset(options={{"{RESET_MASK}": terminated | truncated}})'
            )
        going = ~self._ended
        if self._ended.any():
            self._restart(np.flatnonzero(self._ended), {})
        terms, failed = self._advance(rows, going)
        reward = np.sum(list(terms.values()), 0) if terms else np.zeros(self.num_envs)
        timed_out = self.state["step"].numpy() >= self.task.max_steps
        terminated, truncated = failed & going, timed_out & ~failed & going
        info: dict[str, Any] = {}
        for name, value in terms.items():
            info[name], info[f"_{name}"] = value, going.copy()
        self._ended = terminated | truncated
        if self._ended.any() and self.autoreset_mode == AutoresetMode.SAME_STEP:
            info |= self._final()
            self._restart(np.flatnonzero(self._ended), {})
        self._show()
        return self._seen.copy(), reward, terminated, truncated, info

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Pictures of all members; None with a window, which every step shows."""
        if self.render_mode != "rgb_array" or self.state is None:
            return None
        return self._pictures()

    def close(self, **kwargs: Any) -> None:
        """Close the window, if there is one."""
        if self.window is not None:
            self.window.close()
            self.window = None
        super().close(**kwargs)

    def differentiable_step(self, state: TaskState, action: Tensor) -> tuple[TaskState, Tensor]:
        """The same step in torch: see ``Task.step``. Leaves the environment's own state alone."""
        return self.task.step(state, action)

    def _advance(self, rows: Tensor, going: Bools) -> tuple[dict[str, Array], Bools]:
        """Step and sense the members that go on; terms and failures are zero for the others."""
        assert self.state is not None  # of step
        members = np.flatnonzero(going)
        failed = np.zeros(self.num_envs, dtype=bool)
        terms: dict[str, Array] = {}
        if not len(members):
            return terms, failed
        with torch.no_grad():
            if going.all():
                self.state, some = self.task.step_terms(self.state, rows)
                failed = self.task.failed(self.state).numpy().copy()
                terms = {name: value.numpy() for name, value in some.items()}
            else:
                index = torch.from_numpy(members)
                part = {name: value[index] for name, value in self.state.items()}
                part, some = self.task.step_terms(part, rows[index])
                failed[members] = self.task.failed(part).numpy()
                self._put(members, part)
                for name, value in some.items():
                    terms[name] = np.zeros(self.num_envs)
                    terms[name][members] = value.numpy()
        self._sense(members)
        return terms, failed

    def _restart(self, members: Members, options: dict[str, Any]) -> None:
        """New episodes of some members."""
        with torch.no_grad():
            fresh = self._generators.start(self.task, members, self.np_random)
            if options:
                index = torch.from_numpy(members)
                whole = {
                    name: value.new_zeros(self.num_envs, *value.shape[1:]).index_copy(
                        0, index, value
                    )
                    for name, value in fresh.items()
                }
                given = with_options(whole, options, self.task.name)
                fresh = {name: value[index] for name, value in given.items()}
            if len(members) == self.num_envs:
                self.state = fresh
            else:
                self._put(members, fresh)
        self._ended[members] = False
        self._sense(members)

    def _put(self, members: Members, part: TaskState) -> None:
        """Replace the states of some members; the tensors themselves stay as they were."""
        assert self.state is not None  # of reset and step
        index = torch.from_numpy(members)
        self.state = {k: v.index_copy(0, index, part[k]) for k, v in self.state.items()}

    def _sense(self, members: Members) -> None:
        """Take new observations of some members."""
        assert self.state is not None  # of reset and step
        state = self.state
        if len(members) < self.num_envs:
            index = torch.from_numpy(members)
            state = {name: value[index] for name, value in state.items()}
        with torch.no_grad():
            plain = self.task.observe(state).numpy()
        each = self._generators.each
        if each is None:
            self._seen[members] = self.sensing(plain, self.np_random)
        else:
            for row, k in zip(plain, members, strict=True):
                self._seen[k] = self.sensing(row, each[k])

    def _final(self) -> dict[str, Any]:
        """Last observations of the episodes that end, as gymnasium's vector environments give."""
        last = np.empty(self.num_envs, dtype=object)
        for k in np.flatnonzero(self._ended):
            last[k] = self._seen[k].copy()
        return {"final_obs": last, "_final_obs": self._ended.copy()}

    def _pictures(self) -> tuple[NDArray[np.uint8], ...]:
        assert self.state is not None  # of its callers
        return tuple(self.task.picture(self.state, k) for k in range(self.num_envs))

    def _show(self) -> None:
        if self.window is not None:
            self.window.show(side_by_side(self._pictures()))


def _mode(mode: AutoresetMode | str) -> AutoresetMode:
    if isinstance(mode, AutoresetMode):
        return mode
    return AutoresetMode(require_choice("autoreset_mode", mode, [m.value for m in AutoresetMode]))
