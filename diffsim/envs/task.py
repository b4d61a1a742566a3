"""A control problem as torch functions of batched states: what every environment is made of.

One task serves both worlds. A gymnasium environment (``TaskEnv``), a vector environment
(``TaskVectorEnv``) and a differentiable rollout all call the same ``start``, ``advance``,
``observe`` and ``reward_terms``; none of them owns any physics.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim.core.check import require, require_choice, require_count, require_options
from diffsim.core.checked import checked
from diffsim.core.inside import inside

TaskState = dict[str, Tensor]
"""Tensors by name, all with a leading batch axis; holds everything that the next step needs."""


@checked
@dataclass(frozen=True)
class Entry:
    """One action or observation, as data sheets list it.

    Attributes:
        name: Such as "tip velocity x".
        low, high: Range; may be infinite.
        unit: SI unit, "-" if none.
    """

    name: str
    low: float
    high: float
    unit: str = "-"


@checked
@dataclass(frozen=True)
class Randomization:
    """What differs from episode to episode: factors drawn uniformly at every start.

    Attributes:
        factors: Name of a physical quantity -> (low, high) factor on its nominal value.
    """

    factors: Mapping[str, tuple[float, float]]

    @checked(kinds_only=True)
    def draw(self, batch: int, rng: np.random.Generator) -> TaskState:
        """Factors (batch,) by ``random.NAME``."""
        return {
            f"random.{name}": torch.from_numpy(rng.uniform(low, high, batch))
            for name, (low, high) in self.factors.items()
        }


Randomizing = Randomization | Mapping[str, tuple[float, float]] | None
"""As a task takes it: a mapping of names to (low, high) will do."""


def _interval(name: str, bounds: Any) -> tuple[float, float]:
    try:
        low, high = (float(bound) for bound in bounds)
    except (TypeError, ValueError):
        low = high = math.nan
    if not 0.0 < low <= high < math.inf:
        raise ValueError(
            f"randomization[{name!r}] must be (low, high), 0 < low <= high, got {bounds!r}"
        )
    return low, high


class Task(ABC):
    """A robot, what it is asked to do, and what it senses.

    Args:
        action_delay: Control steps between a command and its effect.
        randomization: Factors on physical quantities, per episode, by name; None: none.

    Attributes:
        name: Such as "StarfishSwim".
        dt: Control period [s].
        max_steps: Length of an episode, after which it is truncated.
        actions, observations: Data sheets; actions lie in [-1, 1].
        randomizable: Quantities that ``randomization`` may name.
        clock_inputs: Which observations are a clock's.
        length_option: Option with the length of an episode: ``num_steps``, or ``seconds``.
        file_options: Options that name files, in a task file relative to it.
    """

    name: str
    dt: float
    max_steps: int
    actions: tuple[Entry, ...]
    observations: tuple[Entry, ...]
    randomizable: tuple[str, ...] = ()
    clock_inputs: tuple[int, ...] = ()
    length_option: ClassVar[str] = "num_steps"
    file_options: ClassVar[tuple[str, ...]] = ()

    @classmethod
    @checked(kinds_only=True)
    def of_options(
        cls, options: Mapping[str, Any], folder: Path | None = None, source: str | None = None
    ) -> Task:
        """A task of options that a user gave, each checked.

        Args:
            options: By name.
            folder: Folder that files among them are in, which they cannot leave; None: anywhere.
            source: What messages call the options, such as a file; None: the task.

        Raises:
            ValueError: an option that the task does not have, or a wrong one.
        """
        where = "" if source is None else f"{source}: "
        given = dict(options)
        try:
            require_options(cls.__name__, given, cls)
        except ValueError as error:
            raise ValueError(f"{where}{error}") from None
        if folder is not None:
            for name in given.keys() & set(cls.file_options):
                given[name] = cls.find_file(name, given[name], folder, source or cls.__name__)
        try:
            return cls(**given)
        except (ValueError, TypeError) as error:
            if source is None or str(error).startswith(source):
                raise
            raise ValueError(f"{where}{error}") from error

    @classmethod
    @checked(kinds_only=True)
    def merged(cls, stated: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
        """Options of a file with those of a call, which go first."""
        return {**stated, **options}

    @classmethod
    @checked(kinds_only=True)
    def find_file(cls, option: str, stated: Any, folder: Path, source: str) -> Any:
        """A file that an option of a task file names, in the file's folder."""
        if not isinstance(stated, str):
            raise ValueError(f"{source}: {option} must name a file, got {stated!r}")
        path = inside(folder, stated, f"{source}: {option}")
        if not path.exists():
            raise FileNotFoundError(f"{source}: {option}: no such file {path}")
        return path

    def __init__(self, *, action_delay: int = 0, randomization: Randomizing = None):
        self.action_delay = require_count("action_delay", action_delay)
        self.randomization = self._check_randomization(randomization)

    def _check_randomization(self, given: Randomizing) -> Randomization | None:
        if given is None:
            return None
        factors = given.factors if isinstance(given, Randomization) else given
        if not isinstance(factors, Mapping):
            raise TypeError(
                "randomization must map names to (low, high), as {'"
                f"{(*self.randomizable, 'NAME')[0]}': (0.8, 1.2)}}, got {type(factors).__name__}"
            )
        checked = {}
        for name, bounds in factors.items():
            require_choice("randomization", name, self.randomizable)
            checked[name] = _interval(name, bounds)
        return Randomization(checked)

    # what a task defines

    @abstractmethod
    def rest(self, batch: int, rng: np.random.Generator) -> TaskState:
        """Physical states at the start of episodes."""

    @abstractmethod
    def advance(self, state: TaskState, action: Tensor) -> TaskState:
        """Physical states one control period later; differentiable in state and action.

        Args:
            state: State as ``rest`` makes it, with ``random.NAME`` (batch,) where randomized.
            action: (batch, num_actions) in [-1, 1], already delayed.
        """

    @abstractmethod
    def observe(self, state: TaskState) -> Tensor:
        """(batch, num_observations), differentiable."""

    @abstractmethod
    def reward_terms(self, before: TaskState, action: Tensor, after: TaskState) -> TaskState:
        """Weighted terms (batch,) by name; the reward is their sum. Differentiable."""

    @checked(kinds_only=True)
    def failed(self, state: TaskState) -> Tensor:
        """(batch,) bool: episodes that end for a reason of physics, not of time."""
        return torch.zeros(state["step"].shape[0], dtype=torch.bool)

    def picture(self, state: TaskState, index: int) -> NDArray[np.uint8]:
        """(height, width, 3) picture of one member of the batch."""
        raise NotImplementedError(f"{self.name} has no picture")

    # what all tasks share

    @property
    def num_actions(self) -> int:
        """Width of an action."""
        return len(self.actions)

    @property
    def num_observations(self) -> int:
        """Width of an observation."""
        return len(self.observations)

    @checked(kinds_only=True)
    def start(self, batch: int, rng: np.random.Generator) -> TaskState:
        """States at the start of ``batch`` episodes, drawn from ``rng``."""
        state = self.rest(batch, rng)
        state["step"] = torch.zeros(batch, dtype=torch.int64)
        if self.action_delay:
            width = (batch, self.action_delay, self.num_actions)
            state["commands"] = torch.zeros(width, dtype=torch.float64)
        if self.randomization is not None:
            state |= self.randomization.draw(batch, rng)
        return state

    def step(self, state: TaskState, action: Tensor) -> tuple[TaskState, Tensor]:
        """One control step.

        Args:
            state: (batch, ...) as ``start`` or ``step`` returned it.
            action: (batch, num_actions); clamped to [-1, 1].

        Returns:
            The next state and the reward (batch,). Gradients: state, action; an action beyond its
            bounds has none.
        """
        after, terms = self.step_terms(state, action)
        return after, torch.stack(list(terms.values())).sum(0)

    def step_terms(self, state: TaskState, action: Tensor) -> tuple[TaskState, TaskState]:
        """Advance as ``step`` does, with the terms of the reward by name."""
        batch = state["step"].shape[0]
        require("action", action, (batch, self.num_actions))
        action = action.clamp(-1.0, 1.0)
        effective, queue = action, None
        if self.action_delay:
            queue = torch.cat([state["commands"], action[:, None]], 1)
            effective, queue = queue[:, 0], queue[:, 1:]
        after = {k: v for k, v in state.items() if k.startswith("random.")}
        after |= self.advance(state, effective)
        after["step"] = state["step"] + 1
        if queue is not None:
            after["commands"] = queue
        return after, self.reward_terms(state, action, after)

    def data_sheet(self) -> str:
        """Actions and observations as a table in Markdown."""
        lines = []
        for title, entries in (("action", self.actions), ("observation", self.observations)):
            lines += [f"| # | {title} | low | high | unit |", "|---|---|---|---|---|"]
            lines += [
                f"| {i} | {e.name} | {e.low:g} | {e.high:g} | {e.unit} |"
                for i, e in enumerate(entries)
            ]
            lines.append("")
        return "\n".join(lines)


def where(mask: Tensor, yes: TaskState, no: TaskState) -> TaskState:
    """Members of ``yes`` where ``mask`` (batch,), of ``no`` elsewhere."""
    return {
        name: torch.where(mask.view(-1, *(1,) * (value.dim() - 1)), yes[name], value)
        for name, value in no.items()
    }


def detached(state: TaskState) -> TaskState:
    """The state without its history of gradients."""
    return {name: value.detach() for name, value in state.items()}
