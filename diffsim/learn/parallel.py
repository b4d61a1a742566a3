"""One controller trained by several processes: each differentiates some episodes of every batch.

All processes draw the same starts and hold the same network. Gradients, rewards and observations
are summed over them by ``torch.distributed`` (gloo), and all take the same step: the gradient is
that of one process with the whole batch, up to the order of sums.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn

from diffsim.envs.task import TaskState

T = TypeVar("T")


class LostProcessError(ConnectionError):
    """Another process of the training ended."""


@dataclass(frozen=True)
class Batch:
    """What a differentiated batch of episodes leaves besides its gradient."""

    reward: Tensor  # mean over steps and episodes, without gradient
    seen: Tensor  # (n, num_observations) before failures
    # numbers for the log, beside those of all batches
    scalars: dict[str, float] = field(default_factory=dict)


def num_processes() -> int:
    """Processes that train together; 1 without a process group."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def rank() -> int:
    """Number of this process among them; 0 writes the files."""
    return dist.get_rank() if num_processes() > 1 else 0


def launched_together() -> bool:
    """Whether ``torchrun`` has started this process beside others."""
    return int(os.environ.get("WORLD_SIZE", "1")) > 1


def own_members(batch: int) -> slice:
    """The episodes of a batch that are this process's.

    Raises:
        ValueError: there are fewer episodes than processes.
    """
    count, k = num_processes(), rank()
    if batch < count:
        raise ValueError(f"batch must be at least {count}, an episode per process, got {batch}")
    return slice(k * batch // count, (k + 1) * batch // count)


def members_of(state: TaskState, members: slice) -> TaskState:
    """Some episodes of a batch of states."""
    return {name: value[members] for name, value in state.items()}


def merged(batch: Batch | None, parameters: Iterable[nn.Parameter], share: float) -> Batch | None:
    """The whole batch from all processes' parts, its gradient in ``parameters``.

    Args:
        batch: This process's part, its gradient in ``parameters``; None where it broke down.
        share: Part of the batch's episodes that this process has.

    Returns:
        None where it broke down in any process.

    Raises:
        LostProcessError: another process ended.
    """
    if num_processes() == 1:
        return batch
    trained = list(parameters)
    flat = [share * _gradient(p).flatten() for p in trained] if batch is not None else []
    sizes = [p.numel() for p in trained]
    row = torch.zeros(sum(sizes) + 2, dtype=torch.float64)
    if batch is not None:
        row = torch.cat([*flat, share * batch.reward.reshape(1), row.new_ones(1)])
    seen: list[Any] = [None] * num_processes()
    _together(lambda: dist.all_reduce(row))
    if int(row[-1]) < num_processes():
        return None
    assert batch is not None
    _together(lambda: dist.all_gather_object(seen, batch.seen))
    for p, gradient in zip(trained, row[:-2].split(sizes), strict=True):
        p.grad = gradient.view_as(p).clone()
    return Batch(row[-2], torch.cat(seen), batch.scalars)


def _gradient(p: nn.Parameter) -> Tensor:
    return torch.zeros_like(p) if p.grad is None else p.grad


def _together(talk: Callable[[], T]) -> T:
    try:
        return talk()
    except RuntimeError as error:  # gloo has no kind of its own for a peer that is gone
        raise LostProcessError(
            f"another process of this training ended ({error}); start all again with --resume"
        ) from error
