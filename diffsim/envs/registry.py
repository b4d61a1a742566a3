"""Environments by name: classes with data sheets, and the native vector environments.

Both are made of the rows of ``environments.yaml``. Packages of users add tasks by entry points of
the group ``diffsim.environments``; they are made, trained and played by the same names.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from diffsim.core.arrays import Array
from diffsim.core.check import require_choice, require_number
from diffsim.core.checked import checked
from diffsim.core.plugins import ENVIRONMENTS, find_plugins, load_plugin
from diffsim.core.yaml_text import read_yaml_file
from diffsim.envs.env import TaskEnv
from diffsim.envs.task import Task
from diffsim.envs.task_file import TaskFile, is_task_file, read_task_file
from diffsim.envs.vector_env import TaskVectorEnv


class NamedTask(NamedTuple):
    """What is registered of a task."""

    module: str | None = None  # where its class is; None: in another package
    # length of an episode with default options, control steps; None: as the task says
    max_steps: int | None = None
    # return of an episode at which the task counts as solved: what published runs
    # (``docs/measured/learning.md``) reached, rounded down; None where none was measured
    threshold: float | None = None
    # what the robot must do, and a table in Markdown of what it commands and senses
    data_sheet: str = ""


def _read_table() -> dict[str, NamedTask]:
    """The rows of ``environments.yaml``."""
    table = {}
    for name, row in read_yaml_file(Path(__file__).with_name("environments.yaml")).items():
        lines = [row["does"], "", "| | |", "|---|---|"]
        lines += [f"| {key} | {text} |" for key, text in row["sheet"].items()]
        module, steps = f"diffsim.envs.{row['module']}", row["max_steps"]
        table[name] = NamedTask(module, steps, row.get("threshold"), "\n".join(lines))
    return table


_TASKS = _read_table()
ENV_IDS = tuple(f"diffsim/{name}-v0" for name in _TASKS)
#: Tasks that are nothing without options: no environment is registered for them.
_OF_FILES = {"SoftBody": NamedTask("diffsim.envs.soft_body")}
FILE_ID = "diffsim/Task-v0"  # any task by its file: gymnasium.make(FILE_ID, name="eel.yaml")


def known_tasks() -> Mapping[str, NamedTask]:
    """All tasks by name, those of other packages among them.

    Raises:
        ValueError: another package gives a task the name of one of this package.
    """
    added, own = find_plugins(ENVIRONMENTS), {**_TASKS, **_OF_FILES}
    if taken := sorted(set(added) & {*own, "Task"}):
        raise ValueError(
            f"{ENVIRONMENTS}: {taken[0]!r} is a task of diffsim already; give "
            f"{added[taken[0]].value} another name"
        )
    return {**own, **dict.fromkeys(added, NamedTask())}


def short_name(name: str) -> str:
    """A task's name, also from an environment's id.

    Raises:
        ValueError: no such task; the message offers the closest names.
    """
    return require_choice("task", name.removeprefix("diffsim/").removesuffix("-v0"), known_tasks())


def register() -> None:
    """Tell gymnasium of the environments."""
    if FILE_ID not in gymnasium.registry:
        gymnasium.register(
            FILE_ID,
            entry_point=f"{__name__}:make_env",
            vector_entry_point=f"{__name__}:make_vector",
        )
    for name, named in known_tasks().items():
        if name not in _OF_FILES and f"diffsim/{name}-v0" not in gymnasium.registry:
            own = named.module is not None
            gymnasium.register(
                f"diffsim/{name}-v0",
                entry_point=f"{__name__}:{name}Env" if own else partial(make_env, name),
                vector_entry_point=f"{__name__}:{name}VectorEnv"
                if own
                else partial(make_vector, name),
                max_episode_steps=named.max_steps,
                reward_threshold=named.threshold,
            )


def task_class(name: str | Path) -> type[Task]:
    """Class of a task.

    Args:
        name: Such as "CopterHover"; also the environment's id, or a task file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no such task, or one that another package cannot give.
    """
    return _find_task(name)[0]


def _find_task(name: str | Path) -> tuple[type[Task], TaskFile | None]:
    """Class of a task, and the file that describes it; None: it is made of options alone."""
    if is_task_file(name):
        file = read_task_file(name)
        try:
            short = require_choice("task", file.task, known_tasks())
        except ValueError as error:
            raise ValueError(f"{file.path}: {error}") from None
        kind, inner = _find_named(short)
        if inner is not None:
            raise ValueError(
                f"{file.path}: task must be a kind of task, got {short}, which is a file itself, "
                f"{inner.path}"
            )
        return kind, file
    return _find_named(short_name(str(name)))


def _find_named(short: str) -> tuple[type[Task], TaskFile | None]:
    module = known_tasks()[short].module
    if module is None:
        added = load_plugin(ENVIRONMENTS, short, Task, or_file=True)
        return _find_task(added) if isinstance(added, Path) else (added, None)
    own: type[Task] = getattr(import_module(module), short)
    return own, None


@checked
def make_task(name: str | Path, **options: Any) -> Task:
    """A task, to be rolled out differentiably.

    Args:
        name: Such as "CopterHover"; also the environment's id, or a task file, "eel.yaml".
        **options: Options of the task's class; they go before those of the file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no such task, or an option that it does not have; the message offers the closest
            names.
    """
    kind, file = _find_task(name)
    if file is None:
        return kind.of_options(options)
    merged = kind.merged(file.options, options)
    made = kind.of_options(merged, file.path.parent, str(file.path))
    made.name = file.path.stem
    return made


def make_env(
    name: str | Path,
    *,
    render_mode: str | None = None,
    sensor_noise: float | Array = 0.0,
    **options: Any,
) -> TaskEnv:
    """The environment of a task that has no class of its own.

    Args:
        name: Name of a task, as ``make_task`` takes it.
        render_mode: "rgb_array", "human" or None.
        sensor_noise: Standard deviation of white noise on observations.
        **options: Options of the task's class.
    """
    task = make_task(name, **options)
    return TaskEnv(task, render_mode=render_mode, sensor_noise=sensor_noise)


@checked
def make_vector(
    name: str | Path,
    num_envs: int,
    *,
    max_episode_steps: int | None = None,
    autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    render_mode: str | None = None,
    sensor_noise: float | Array = 0.0,
    **options: Any,
) -> TaskVectorEnv:
    """The native vector environment of a task: one prepared solver, the whole batch per call.

    Args:
        name: Name of a task, as ``make_task`` takes it.
        num_envs: Number of environments side by side.
        max_episode_steps: Length of an episode, where it is not the registered one; None: the
            task's. gymnasium hands on the registered length with every batch.
        autoreset_mode: What follows the end of an episode; see ``TaskVectorEnv``.
        render_mode: "rgb_array", "human" or None.
        sensor_noise: Standard deviation of white noise on observations.
        **options: Options of the task's class.
    """
    task = make_task(name, **options)
    registered = None if is_task_file(name) else known_tasks()[short_name(str(name))].max_steps
    if max_episode_steps not in (None, registered):
        task.max_steps = int(require_number("max_episode_steps", max_episode_steps, at_least=1))
    return TaskVectorEnv(
        task,
        num_envs,
        autoreset_mode=autoreset_mode,
        render_mode=render_mode,
        sensor_noise=sensor_noise,
    )


class NamedEnv(TaskEnv):
    """An environment that makes its own task; its subclasses are what gymnasium registers.

    Args:
        render_mode: "rgb_array", "human" or None.
        sensor_noise: Standard deviation of white noise on observations.
        **options: Options of the task, such as ``randomization`` and ``action_delay``.
    """

    task_name: ClassVar[str]

    def __init__(
        self,
        *,
        render_mode: str | None = None,
        sensor_noise: float | Array = 0.0,
        **options: Any,
    ):
        task = make_task(self.task_name, **options)
        super().__init__(task, render_mode=render_mode, sensor_noise=sensor_noise)
        self._limit: int | None = _TASKS[self.task_name].max_steps  # None once it was reported

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; see ``TaskEnv``."""
        length, limit = self.task.max_steps, self._limit
        cut = self.state is not None and int(self.state["step"]) == limit
        if cut and limit is not None and limit < length:
            gymnasium.logger.warn(
                f"{self.task_name}: the task lasts {length} steps, but gymnasium's time limit "
                f"ended the episode after {limit}; give max_episode_steps={length} to "
                "gymnasium.make as well"
            )
            self._limit = None
        return super().reset(seed=seed, options=options)


_ENVS: dict[str, type[NamedEnv]] = {
    f"{name}Env": type(
        f"{name}Env",
        (NamedEnv,),
        {"task_name": name, "__doc__": named.data_sheet, "__module__": __name__},
    )
    for name, named in _TASKS.items()
}


def __getattr__(name: str) -> Any:
    """``CopterHoverEnv``, ``CopterHoverVectorEnv`` and the like, as gymnasium's registry asks."""
    if name in _ENVS:
        return _ENVS[name]
    short = name.removesuffix("VectorEnv")
    if name.endswith("VectorEnv") and short in _TASKS:
        return partial(make_vector, short)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
