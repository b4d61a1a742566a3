"""What a training keeps of itself: reading it, and its controller."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from diffsim.control import MLPController
from diffsim.envs.task import Task

CHECKPOINT = "checkpoint.pt"


def read_checkpoint(folder: str | Path) -> dict[str, Any]:
    """A checkpoint of a training: tensors and plain values, no objects that would run code.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is cut, or no checkpoint of a training.
    """
    path = Path(folder) / CHECKPOINT
    try:
        state = torch.load(path, weights_only=True)
    except OSError:
        raise
    except Exception as error:  # torch's own, pickle's and zip's
        raise ValueError(
            f"{path}: cannot be read as a checkpoint ({type(error).__name__}): it is cut, or holds "
            "objects, which are not loaded since they could run code"
        ) from error
    missing = {"setup", "rows", "counters", "learner", "controller"} - set(state)
    if missing:
        raise ValueError(
            f"{path}: no checkpoint of a training, {', '.join(sorted(missing))} missing"
        )
    return dict(state)


def controller_of(folder: str | Path, task: Task) -> MLPController:
    """The controller of an earlier run, to go on with; its observations are normalized as there.

    Args:
        task: That it shall steer from now on: as many observations and actions, such as of the
            same robot on another mesh.

    Raises:
        FileNotFoundError, ValueError: as ``read_checkpoint``; other numbers of observations or
            actions.
    """
    state = read_checkpoint(folder)["controller"]
    controller = MLPController(task.num_observations, task.num_actions)
    shapes = {name: tuple(value.shape) for name, value in controller.state_dict().items()}
    found = {name: tuple(value.shape) for name, value in state.items()}
    if found != shapes:
        wanted = f"{task.num_observations} observations and {task.num_actions} actions"
        first = next(n for n in {**shapes, **found} if shapes.get(n) != found.get(n))
        raise ValueError(
            f"start: the controller of {folder} must be one of {wanted}, as {task.name} has them; "
            f"its {first} has shape {found.get(first)}, not {shapes.get(first)}"
        )
    controller.load_state_dict(state)
    return controller
