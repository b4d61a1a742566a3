"""Controllers that come with the package: trained once, small, and rated as they are stored.

Weights are stored in half precision and moments in single. The recorded reward is that of the
stored numbers: ``replay`` gives it again on any machine, but for what instruction sets round
differently.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim.control import MLPController
from diffsim.core.check import require_choice
from diffsim.core.checked import checked
from diffsim.core.files import to_plain, write_bytes_atomic
from diffsim.envs.registry import make_task
from diffsim.envs.task import Task, TaskState
from diffsim.envs.task_file import require_unchanged, task_label
from diffsim.learn.kept_files import ABOUT, FOLDER, trained_names
from diffsim.learn.setup import EVALUATION_SEED

_WHOLE = ("normalizer.count",)


@checked(kinds_only=True)
@dataclass(frozen=True)
class Trained:
    """A controller with the task that it was trained for.

    Attributes:
        task, task_options: What it steers.
        episodes: Fixed starts of the rating (``diffsim.learn.setup.evaluate``).
        reward: Mean reward per step over them.
        made_by: Command of the training.
        state: Weights and moments by name.
        task_file: What is remembered of the task's file (``TaskFile.record``); None: it has a name.
        folder: Where the controller was read from, in which a task file is looked for, too.
    """

    task: str
    task_options: Mapping[str, Any]
    episodes: int
    reward: float
    made_by: str
    state: Mapping[str, NDArray[np.floating[Any]]]
    task_file: Mapping[str, Any] | None = None
    folder: Path | None = None

    @property
    def label(self) -> str:
        """What folders of results call the task."""
        return task_label(self.task)

    @checked
    def make_task(self, *, changed: bool = False) -> Task:
        """The task.

        Args:
            changed: Whether its file may differ from the one of the training.

        Raises:
            FileNotFoundError: the task's file is neither where it was nor beside the controller.
            ChangedTaskError: the file differs; the message says in what.
        """
        name: str | Path = self.task
        if self.task_file is not None and self.folder is not None and not Path(name).is_file():
            name = self.folder / Path(name).name
        if not changed:
            require_unchanged(name, self.task_file, "the controller")
        return make_task(name, **dict(self.task_options))

    @checked
    def controller(self, task: Task) -> MLPController:
        """The network, for the task that ``make_task`` made.

        Raises:
            RuntimeError: the task has other observations or actions than in training.
        """
        net = MLPController(task.num_observations, task.num_actions)
        net.load_state_dict(
            {name: torch.as_tensor(v, dtype=torch.float64) for name, v in self.state.items()}
        )
        return net


class Replay(NamedTuple):
    """The episodes of a rating, step by step."""

    states: list[TaskState]  # at every step and at the end, (episodes, ...)
    commands: Tensor  # (steps, episodes, num_actions)
    rewards: Tensor  # (steps, episodes); zero once an episode has failed


def replay(trained: Trained, task: Task) -> Replay:
    """Steer the episodes that ``trained.reward`` was measured on.

    Args:
        trained: Whose controller steers.
        task: As ``trained.make_task`` made it.
    """
    net = trained.controller(task)
    states = [task.start(trained.episodes, np.random.default_rng(EVALUATION_SEED))]
    commands, rewards = [], []
    going = torch.ones(trained.episodes, dtype=torch.bool)
    with torch.no_grad():
        for k in range(task.max_steps):
            commands.append(net(task.observe(states[-1]), k))
            state, reward = task.step(states[-1], commands[-1])
            rewards.append(torch.where(going, reward, torch.zeros_like(reward)))
            going = going & ~task.failed(state)
            states.append(state)
    return Replay(states, torch.stack(commands), torch.stack(rewards))


@checked
def load_trained(name: str) -> Trained:
    """A controller that comes with the package.

    Args:
        name: Of its task, such as "SharkSwim".

    Raises:
        ValueError: there is none of this name; the message offers the closest.
    """
    return read_trained(FOLDER / f"{require_choice('controller', name, trained_names())}.npz")


@checked
def read_trained(path: str | Path) -> Trained:
    """A controller from a file that ``write_trained`` wrote.

    Args:
        path: The file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: it is no such file.
    """
    try:
        with np.load(path, allow_pickle=False) as content:
            about = json.loads(str(content[ABOUT]))
            state = {name: content[name] for name in content.files if name != ABOUT}
        return Trained(state=state, folder=Path(path).parent, **about)
    except OSError:
        raise
    except Exception as error:  # NumPy's, zip's and JSON's
        raise ValueError(
            f"{path}: no controller that diffsim wrote ({type(error).__name__}); "
            "rl/keep_controller.py makes one of a training's checkpoint"
        ) from error


def write_trained(path: str | Path, trained: Trained) -> Path:
    """Write a controller; ``stored`` says how its numbers must be rounded before it is rated."""
    aside = ("state", "folder")
    about = {name: value for name, value in asdict(trained).items() if name not in aside}
    content = io.BytesIO()
    arrays: dict[str, Any] = {ABOUT: np.array(json.dumps(to_plain(about))), **trained.state}
    np.savez_compressed(content, **arrays)
    return write_bytes_atomic(Path(path), content.getvalue())


def stored(controller: MLPController) -> dict[str, NDArray[np.floating[Any]]]:
    """A controller's numbers as a file keeps them: weights in half, moments in single precision."""
    out: dict[str, NDArray[np.floating[Any]]] = {}
    for name, value in controller.state_dict().items():
        kind: Any = np.float32 if name.startswith("normalizer.") else np.float16
        out[name] = value.numpy().astype(np.float64 if name in _WHOLE else kind)
    return out
