"""Environments by name: classes with data sheets, and the native vector environments.

Packages of users add tasks by entry points of the group ``diffsim.environments``; they are made,
trained and played by the same names.
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

from diffsim.core.check import require_choice, require_number
from diffsim.core.plugins import ENVIRONMENTS, find_plugins, load_plugin
from diffsim.envs.env import TaskEnv
from diffsim.envs.task import Task
from diffsim.envs.task_file import TaskFile, is_task_file, read_task_file
from diffsim.envs.vector_env import TaskVectorEnv


class NamedTask(NamedTuple):
    """What is registered of a task.

    Attributes:
        module: Where its class is; None: in another package.
        max_steps: Length of an episode with default options, control steps; None: as the task says.
        threshold: Return of an episode at which the task counts as solved: what published runs
            (``docs/measured/learning.md``) reached, rounded down; None where none was measured.
    """

    module: str | None = None
    max_steps: int | None = None
    threshold: float | None = None


_COPTER, _SOFT = "diffsim.envs.copter_tasks", "diffsim.envs.soft_named"
_TASKS = {
    "CopterHover": NamedTask(_COPTER, 200, 180.0),
    "CopterTrack": NamedTask(_COPTER, 200, 150.0),
    "StarfishSwim": NamedTask(_SOFT, 200, 80.0),
    "SharkSwim": NamedTask(_SOFT, 200, 90.0),
    "QuadrupedWalk": NamedTask(_SOFT, 100),
    "CowWalk": NamedTask(_SOFT, 60),
    "TorusRoll": NamedTask(_SOFT, 100),
    "TendonReach": NamedTask(_SOFT, 100),
    "SoftJumper": NamedTask(_SOFT, 300),
}
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
    sensor_noise: float | NDArray[np.float64] = 0.0,
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


def make_vector(
    name: str | Path,
    num_envs: int,
    *,
    max_episode_steps: int | None = None,
    autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    render_mode: str | None = None,
    sensor_noise: float | NDArray[np.float64] = 0.0,
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
        sensor_noise: float | NDArray[np.float64] = 0.0,
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


class CopterHoverEnv(NamedEnv):
    """A multicopter that must come to rest at the origin.

    | | |
    |---|---|
    | actions | one per rotor: 0 is hover thrust, 1 as much above it as the motor or zero allows |
    | observations | 0-2 position error, 3-5 velocity (both body frame) [m, m/s], 6-14 rotation \
matrix by rows, 15-17 body rates [rad/s], then one per rotor: thrust over its maximum; unbounded \
but for the rotation, in [-1, 1] |
    | reward | 1 - position / 3 - 0.02 velocity - 0.003 turning (each sqrt(x^2 + 0.01) - 0.1) \
- 0.003 mean squared action; 1 at best |
    | start | sd of position 0.5 m, velocity 0.25 m/s, attitude 0.05 rad, rates 0.1 rad/s; motors \
at hover thrust |
    | termination | farther than 3 m, upside down, turning faster than 30 rad/s |
    | truncation | 200 steps of 20 ms |
    | options | design (shipped name, file), vehicle (its file), dt, seconds, start_spread, \
model (a diagnosis's extended_model.yaml), posterior, motor_time_constant, drag, wind_speed, \
battery, action_delay, randomization (thrust, mass, inertia, drag, motor_lag, battery), \
sensor_noise |
    | versions | v0: first |
    """

    task_name = "CopterHover"


class CopterTrackEnv(NamedEnv):
    """A multicopter that must follow a horizontal figure of eight.

    As ``CopterHoverEnv``, with errors relative to the moving reference, and, at the end of the
    observations, the way of the reference over the next 0.1 s and 0.3 s (body frame) [m].

    | | |
    |---|---|
    | start | at a random place of the figure with its velocity, spread as for hovering |
    | options | also size [m] and period [s] of the figure |
    | versions | v0: first |
    """

    task_name = "CopterTrack"


class StarfishSwimEnv(NamedEnv):
    """A soft starfish in water that must rise (thesis 4.1.6).

    | | |
    |---|---|
    | actions | 0-3: bend an arm (+x, +y, -x, -y) down (1) or up (-1); +-1 is the muscles' stroke |
    | observations | velocities x, y, z of 137 nodes spread over the body: 411 numbers, unbounded \
[m/s] |
    | reward | per step, speeds of the center over 0.1 m/s: 1.0 upward - 0.5 sideways |
    | start | shape of rest, still water; velocities linear in place, at random, up to about \
0.1 m/s at the arms' ends, center at rest |
    | termination | none |
    | truncation | 200 steps of 33.3 ms |
    | options | robot (arguments of ``diffsim.systems.robots.starfish``, ``coarse`` for quick \
trials), num_steps, substeps, start_speed, current, clock, drift_weight, rise_weight, speed_scale, \
action_delay, randomization (muscles, water), sensor_noise |
    | versions | v0: first |
    """

    task_name = "StarfishSwim"


class SharkSwimEnv(NamedEnv):
    """A soft shark in water that must swim along +x (thesis 4.1.6).

    | | |
    |---|---|
    | actions | 0: bend the tail to +y (1) or -y (-1) |
    | observations | velocities x, y, z of 95 nodes spread over the body: 285 numbers, unbounded \
[m/s] |
    | reward | per step, speeds of the center over 0.1 m/s: 1.0 along +x - 0.5 across |
    | start, termination, truncation | as ``StarfishSwimEnv`` |
    | options | robot: arguments of ``diffsim.systems.robots.shark``; others as \
``StarfishSwimEnv`` |
    | versions | v0: first |
    """

    task_name = "SharkSwim"


class QuadrupedWalkEnv(NamedEnv):
    """A soft slab on four legs that must walk along +x on a floor (thesis 4.1.6).

    | | |
    |---|---|
    | actions | 0-7: shorten (1) or lengthen (-1) the muscle along the front (even) or back (odd) \
of a leg: hind left, hind right, front left, front right |
    | observations | 0-35 velocities x, y, z of 12 nodes [m/s], 36 height of the center [m], 37-45 \
mean deformation gradient by rows [-]: where the robot's axes point; all unbounded |
    | reward | per step, speeds of the center over 0.1 m/s: 1.0 along +x - 0.5 along y |
    | start | shape of rest, on the floor, at rest; it settles under its weight |
    | termination | tipped over: its z axis has turned by more than about 60 degrees |
    | truncation | 100 steps of 10 ms |
    | options | robot (arguments of ``diffsim.systems.robots.quadruped``: coarse, friction, \
per_muscle, ...), num_steps, substeps, start_speed, clock, drift_weight, rise_weight, \
speed_scale, action_delay, randomization (muscles), sensor_noise |
    | versions | v0: first |
    """

    task_name = "QuadrupedWalk"


class CowWalkEnv(NamedEnv):
    """A soft quadruped whose head is so heavy that it tends to fall on its face.

    | | |
    |---|---|
    | actions, observations, start, termination | as ``QuadrupedWalkEnv`` |
    | reward | as there, + 0.3 upward speed (thesis: -0.3 z in the loss) |
    | truncation | 60 steps of 10 ms, each 10 time steps of the body |
    | options | robot: arguments of ``diffsim.systems.robots.cow``; others as ``QuadrupedWalkEnv`` |
    | versions | v0: first |
    """

    task_name = "CowWalk"


class TorusRollEnv(NamedEnv):
    """A soft ring on its edge that must roll along +x (thesis 4.1.6).

    | | |
    |---|---|
    | actions | 0-7: shorten (1) or lengthen (-1) an eighth of the rim, from the lowest point \
towards +x and up |
    | observations | 0-23 velocities x, y, z of 8 nodes [m/s], 24 height of the center [m], 25-33 \
mean deformation gradient by rows [-]: how far it has rolled; all unbounded |
    | reward | per step, speeds of the center over 0.1 m/s: 1.0 along +x - 0.5 along y |
    | start | shape of rest, on the floor, at rest; it settles under its weight |
    | termination | fallen: its y axis has turned by more than about 60 degrees |
    | truncation | 100 steps of 16 ms, each 4 time steps of the body |
    | options | robot: arguments of ``diffsim.systems.robots.torus``; others as \
``QuadrupedWalkEnv`` |
    | versions | v0: first |
    """

    task_name = "TorusRoll"


class TendonReachEnv(NamedEnv):
    """An upright soft arm, fixed at its foot, whose tip must reach a goal (thesis 4.1.6).

    | | |
    |---|---|
    | actions | 0-15: shorten (1) or lengthen (-1) a corner of a quarter of the length: quarters \
from below, corners (+x, +y), (-x, +y), (-x, -y), (+x, -y) |
    | observations | 0-11 velocities x, y, z of the middles of the quarters' ends [m/s], 12-14 way \
from the tip to the goal [m]; all unbounded |
    | reward | per step: -1.0 distance of tip and goal over the arm's length (0.4 m; smooth at \
zero) - 0.001 mean squared action |
    | start | upright, at rest; the goal is uniform in a box about the tip, x and y +-0.12 m, z \
-0.06 to 0.02 m |
    | termination | none |
    | truncation | 100 steps of 10 ms |
    | options | robot (arguments of ``diffsim.systems.robots.tendon_arm``: coarse, gravity, ...), \
num_steps, substeps, goal_low, goal_high, node, effort_weight, start_speed, clock, action_delay, \
randomization (muscles), sensor_noise |
    | versions | v0: first |
    """

    task_name = "TendonReach"


class SoftJumperEnv(NamedEnv):
    """A light soft table that must jump along +x, after the soft jumper of SAPO's authors
    (Xing, Luk, Oh, ICLR 2025, arXiv:2412.12089; our mesh, solver and contact differ).

    | | |
    |---|---|
    | actions | 0-215: shrink (1) or swell (-1) two tetrahedra each, by an isotropic stress of up \
to 300 Pa |
    | observations | 0-2 center [0.1 m], 3-5 its velocity [0.1 m/s], 6-221 last actions, 222-752 \
x, y, z of 177 nodes from the center [0.1 m]; all unbounded but for actions |
    | reward | per step: 1.0 forward speed of the center [m/s] + 3.0 its height above the start's \
[m] - 0.001 sum of squared actions |
    | start | at rest, soles 0 to 0.4 m above the floor, x and y +-0.8 m, size of the positions \
times 0.9 to 1.1 |
    | termination | none |
    | truncation | 300 steps of 16.7 ms, each 2 time steps of the body |
    | options | robot (arguments of ``diffsim.systems.robots.soft_jumper``: coarse, dt, \
active_stress, friction, ...), num_steps, substeps, forward_weight, rise_weight, effort_weight, \
drop, aside, size_spread, start_speed, clock, action_delay, randomization (muscles), sensor_noise |
    | versions | v0: first |
    """

    task_name = "SoftJumper"


def __getattr__(name: str) -> Any:
    """``CopterHoverVectorEnv`` and the like, by name, as gymnasium's registry asks for them."""
    short = name.removesuffix("VectorEnv")
    if name.endswith("VectorEnv") and short in _TASKS:
        return partial(make_vector, short)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
