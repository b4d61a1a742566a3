"""Random designs of a device, and what they are worth on its grid."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.core.errors import DiffsimError
from diffsim.core.progress import show_progress
from diffsim.core.runs import run_each
from diffsim.optim import Log, progress_bar, screen
from diffsim.stokes.devices.device import FAILURES, Device, quiet

_MAX_REJECTED = 50  # per accepted sample


@dataclass(frozen=True)
class DesignSamples:
    """Random designs that let fluid through."""

    x: Tensor  # parameters of the designs, (num_samples, num_parameters)
    losses: Tensor  # losses, not normalized, (num_samples,)
    num_rejected: int  # designs without flow that were drawn again

    def best(self, count: int) -> Tensor:
        """The best ones, best first, (count, num_parameters)."""
        return self.x[self.losses.argsort(stable=True)[:count]]


def draw(
    device: Device,
    log: Log,
    count: int,
    seed: int,
    *,
    progress: bool,
    executor: Executor | None = None,
) -> DesignSamples:
    """Random designs, those without flow drawn again; the log's are repeated, not their flows.

    Designs are drawn one after another and accepted in that order, whoever computes their flows.
    """
    generator = torch.Generator().manual_seed(seed)
    kept = list(log["samples"])
    for entry in kept:
        for _ in range(entry["rejected"] + 1):
            device.sample(generator)
    with show_progress(
        desc="random designs", total=count, initial=len(kept), disable=not progress
    ) as bar:
        accepted = _AcceptedSamples(device.name, log, kept, bar.update)
        while (lacking := count - len(kept)) > 0:
            designs = [device.sample(generator) for _ in range(lacking)]
            accepted.begin(designs)
            run_each(partial(_try_design, device), designs, executor, done=accepted.take)
    return DesignSamples(
        torch.tensor([s["x"] for s in kept], dtype=torch.float64),
        torch.tensor([s["loss"] for s in kept], dtype=torch.float64),
        sum(s["rejected"] for s in kept),
    )


class _AcceptedSamples:
    """Designs that let fluid through, kept in the order in which they were drawn."""

    def __init__(
        self, device: str, log: Log, kept: list[Mapping[str, Any]], count: Callable[[], object]
    ):
        self.device, self.log, self.kept, self.count = device, log, kept, count
        self.rejected = 0  # since the last that was accepted

    def begin(self, designs: Sequence[Tensor]) -> None:
        """A round of designs."""
        self.designs, self.next = designs, 0
        self.early: dict[int, float | str] = {}  # ended before one that was drawn earlier

    def take(self, k: int, outcome: float | str) -> None:
        """A design of the round ended: with a loss, or with why it has no flow."""
        self.early[k] = outcome
        while self.next in self.early:
            self._accept(self.designs[self.next], self.early.pop(self.next))
            self.next += 1

    def _accept(self, x: Tensor, outcome: float | str) -> None:
        if isinstance(outcome, str):
            self.rejected += 1
            if self.rejected == _MAX_REJECTED:
                raise DiffsimError(
                    f"{_MAX_REJECTED} random designs of {self.device} in a row have no flow; "
                    f"the last one: {outcome}"
                )
            return
        entry = {"x": x.tolist(), "loss": outcome, "rejected": self.rejected}
        self.kept.append(self.log.append("samples", entry))
        self.rejected = 0
        self.count()


def _try_design(device: Device, x: Tensor) -> float | str:
    """The loss of a design, or why it has no flow."""
    with quiet():
        try:
            return device.value(x)
        except FAILURES as error:
            return str(error)


def _value(device: Device, x: np.ndarray) -> float:
    with quiet():
        return device.value(torch.from_numpy(x))


def values(
    device: Device,
    log: Log,
    name: str,
    designs: Sequence[Tensor],
    *,
    progress: bool,
    executor: Executor | None = None,
) -> Tensor:
    """Losses of given designs, (len(designs),), infinite without flow; kept in the log's list."""
    label = f"{name}, {device.grid.shape}"
    with progress_bar(label, len(designs), show=progress) as bar:
        found = screen(
            partial(_value, device),
            [x.numpy() for x in designs],
            log=log,
            name=name,
            failures=FAILURES,
            callback=bar,
            executor=executor,
        )
    return torch.tensor([e.value for e in found], dtype=torch.float64)
