"""What a controller is trained with unless told otherwise, task by task: by measurement, one seed
after the other, with nothing left to tune.

Swimmers: the reward is flat around a controller that hardly moves, and velocities alone do not
tell it when to begin a stroke. With a clock among the observations and a last layer that is not
small, the first network already strokes, and the gradient has something to make better.
``docs/measured/learning.md`` says what each part does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from diffsim.core.checked import checked
from diffsim.envs.task_file import is_task_file, read_task_file
from diffsim.learn.gradient import GradientOptions
from diffsim.learn.setup import Setup

Options = Mapping[str, Any]


@checked(kinds_only=True)
@dataclass(frozen=True)
class Recipe:
    """How a task is trained.

    Attributes:
        task_options: Options of the task, for every method.
        setup: Fields of ``Setup`` that differ from their defaults, for every method.
        budget: Fields of ``Setup`` that differ from their defaults for training by gradient.
        gradient: Fields of ``GradientOptions`` that differ from their defaults.
    """

    task_options: Options = field(default_factory=dict)
    setup: Options = field(default_factory=dict)
    budget: Options = field(default_factory=dict)
    gradient: Options = field(default_factory=dict)

    @checked
    def setup_of(self, task: str, *, task_options: Options | None = None, **fields: Any) -> Setup:
        """Set-up of a run by gradient; what is given here goes before the recipe's.

        Args:
            task: Name of the task.
            task_options: Further options of the task.
            **fields: Further fields of ``Setup``.
        """
        options = {**self.task_options, **(task_options or {})}
        return Setup(task, options, **{**self.setup, **self.budget, **fields})

    def gradient_options(self, **fields: Any) -> GradientOptions:
        """Options of ``GradientLearner`` by this recipe; what is given here goes before it."""
        return GradientOptions(**{**self.gradient, **fields})


# of a gait of 1 Hz: its own frequency, and half of it, so that two strokes may differ
CLOCK = (0.5, 1.0)
_SWIM = Recipe(
    task_options={"clock": CLOCK},
    setup={"output_gain": 0.5, "balance_clock": True, "evaluation_episodes": 2},
    budget={"steps": 1_200, "evaluate_every": 600},
    gradient={"batch": 1, "learning_rate": 3e-3},
)
# of a stride of 3 Hz, the best square wave of all its muscles, and half of it
JUMP_CLOCK = (1.5, 3.0)
# copters: chosen on seeds 100 to 104, by what five seeds reach in two seconds
_FLY = Recipe(
    budget={"steps": 80_000, "evaluate_every": 40_000},
    gradient={
        "batch": 64,
        "first_horizon": 30,
        "horizon": 100,
        "learning_rate": 2e-2,
        "beta1": 0.7,
        "beta2": 0.95,
    },
)
RECIPES: dict[str, Recipe] = {
    "StarfishSwim": _SWIM,
    "SharkSwim": _SWIM,
    # by a file; by one seed of examples/learning/fish, whose clock the file states
    "SoftBody": Recipe(
        setup={"output_gain": 0.5, "balance_clock": True, "evaluation_episodes": 4},
        budget={"steps": 3_000, "evaluate_every": 500},
        gradient={"batch": 1, "learning_rate": 1e-2},
    ),
    # two seeds; a gradient of whole episodes that is cut every three strides
    "SoftJumper": Recipe(
        task_options={"clock": JUMP_CLOCK},
        setup={"output_gain": 0.5, "balance_clock": True, "evaluation_episodes": 4},
        budget={"steps": 60_000, "evaluate_every": 6_000},
        gradient={"batch": 1, "cut_every": 60, "learning_rate": 2e-3},
    ),
    # the search's winner, and what did better than it afterwards
    "CopterHover": _FLY,
    "CopterTrack": _FLY,
}


@checked
def recipe(task: str) -> Recipe:
    """The recipe of a task, by its name or file; an empty one where none was measured.

    What a file states is left to the file.

    Raises:
        FileNotFoundError, ValueError: a file that is not there, or is no task's.
    """
    if is_task_file(task):
        file = read_task_file(task)
        usual = recipe(file.task)
        more = {k: v for k, v in usual.task_options.items() if k not in file.options}
        return replace(usual, task_options=more)
    return RECIPES.get(task.removeprefix("diffsim/").removesuffix("-v0"), Recipe())
