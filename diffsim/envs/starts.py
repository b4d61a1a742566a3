"""How episodes start: states drawn from generators, and what ``reset`` was told of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.utils import seeding
from numpy.typing import NDArray

from diffsim.core.arrays import Mask
from diffsim.core.check import did_you_mean
from diffsim.envs.task import Task, TaskState

RESET_MASK = "reset_mask"


def with_options(state: TaskState, options: Mapping[str, Any], where: str) -> TaskState:
    """First states with quantities set by ``reset``'s options.

    Args:
        state: As drawn, (batch, ...) each.
        options: Quantities of the state by name; each is broadcast to its shape. All of a state,
            as ``TaskEnv.differentiable_state`` gives it, starts a copy of that state.
        where: Name of the environment, for messages.

    Raises:
        ValueError: not a quantity of the state, a shape that does not fit, or not finite.
    """
    out = dict(state)
    for name, value in options.items():
        if name not in state:
            raise ValueError(
                f"options[{name!r}] is no quantity of {where}'s state, which has "
                f"{', '.join(state)}{did_you_mean(name, state)}"
            )
        drawn = state[name]
        given = torch.as_tensor(value, dtype=drawn.dtype)
        if not bool(torch.isfinite(given).all()):
            raise ValueError(f"options[{name!r}] must be finite, got {value}")
        try:
            out[name] = given.expand(drawn.shape).clone()
        except RuntimeError as error:
            raise ValueError(
                f"options[{name!r}] must have a shape that broadcasts to {tuple(drawn.shape)}, "
                f"got {tuple(given.shape)}"
            ) from error
    return out


def checked_mask(mask: Any, num_envs: int) -> Mask:
    """``options["reset_mask"]``: which members start anew; as gymnasium's own environments ask.

    Raises:
        TypeError, ValueError: not a boolean array (num_envs,) with at least one True.
    """
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
        kind = f"an array of {mask.dtype}" if isinstance(mask, np.ndarray) else type(mask).__name__
        raise TypeError(f"options['{RESET_MASK}'] must be a numpy array of bool, got {kind}")
    if mask.shape != (num_envs,):
        raise ValueError(f"options['{RESET_MASK}'] must have shape ({num_envs},), got {mask.shape}")
    if not mask.any():
        raise ValueError(f"options['{RESET_MASK}'] must be True for at least one member")
    return mask


class Generators:
    """What a batch draws from: one generator for all members, or one for each.

    Args:
        num_envs: Number of environments side by side.
    """

    def __init__(self, num_envs: int):
        self.num_envs = num_envs
        self.each: list[np.random.Generator] | None = None

    def seed_each(
        self, seeds: Sequence[int | None], members: NDArray[np.intp], common: np.random.Generator
    ) -> None:
        """A generator for every member.

        Args:
            seeds: One per member of the batch; None goes on with the member's generator.
            members: Whose seeds count.
            common: From which members without a generator get one.

        Raises:
            ValueError: not as many seeds as members, or something else than a whole number >= 0.
        """
        if len(seeds) != self.num_envs:
            raise ValueError(
                f"seed must have {self.num_envs} entries, one per member, got {len(seeds)}"
            )
        for seed in seeds:
            whole = isinstance(seed, int | np.integer) and not isinstance(seed, bool)
            if seed is not None and not (whole and seed >= 0):
                raise ValueError(f"a member's seed must be None or a whole number >= 0, got {seed}")
        each = list(common.spawn(self.num_envs)) if self.each is None else self.each
        for k in members:
            if (seed := seeds[k]) is not None:
                each[k] = seeding.np_random(int(seed))[0]
        self.each = each

    def start(
        self, task: Task, members: NDArray[np.intp], common: np.random.Generator
    ) -> TaskState:
        """First states of some members, (len(members), ...)."""
        if self.each is None:
            return task.start(len(members), common)
        rows = [task.start(1, self.each[k]) for k in members]
        return {name: torch.cat([row[name] for row in rows]) for name in rows[0]}
