"""Random designs of a device, and what they are worth on its grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from diffsim.core.errors import DiffsimError
from diffsim.optim import Log, progress_bar, screen
from diffsim.stokes.devices.device import FAILURES, Device, quiet

_MAX_REJECTED = 50  # per accepted sample


@dataclass(frozen=True)
class Samples:
    """Random designs that let fluid through.

    Attributes:
        x: Parameters of the designs, (num_samples, num_parameters).
        losses: Losses, not normalized, (num_samples,).
        num_rejected: Designs without flow that were drawn again.
    """

    x: Tensor
    losses: Tensor
    num_rejected: int

    def best(self, count: int) -> Tensor:
        """The best ones, best first, (count, num_parameters)."""
        return self.x[self.losses.argsort(stable=True)[:count]]


def draw(device: Device, log: Log, count: int, seed: int, *, progress: bool) -> Samples:
    """Random designs, those without flow drawn again; the log's are repeated, not their flows."""
    generator = torch.Generator().manual_seed(seed)
    kept = list(log["samples"])
    for entry in kept:
        for _ in range(entry["rejected"] + 1):
            device.sample(generator)
    show = tqdm(desc="random designs", total=count, initial=len(kept), disable=not progress)
    with show, quiet():
        while len(kept) < count:
            for rejected in range(_MAX_REJECTED):
                x = device.sample(generator)
                try:
                    loss = device.value(x)
                except FAILURES as error:
                    last = error
                    continue
                entry = {"x": x.tolist(), "loss": loss, "rejected": rejected}
                kept.append(log.append("samples", entry))
                break
            else:
                raise DiffsimError(
                    f"{_MAX_REJECTED} random designs of {device.name} in a row have no flow; "
                    f"the last one: {last}"
                )
            show.update()
    return Samples(
        torch.tensor([s["x"] for s in kept], dtype=torch.float64),
        torch.tensor([s["loss"] for s in kept], dtype=torch.float64),
        sum(s["rejected"] for s in kept),
    )


def values(
    device: Device, log: Log, name: str, designs: Sequence[Tensor], *, progress: bool
) -> Tensor:
    """Losses of given designs, (len(designs),), infinite without flow; kept in the log's list."""

    def loss(x: np.ndarray) -> float:
        return device.value(torch.from_numpy(x))

    label = f"{name}, {device.grid.shape}"
    with quiet(), progress_bar(label, len(designs), show=progress) as bar:
        found = screen(
            loss,
            [x.numpy() for x in designs],
            log=log,
            name=name,
            failures=FAILURES,
            callback=bar,
        )
    return torch.tensor([e.value for e in found], dtype=torch.float64)
