"""Bounded L-BFGS on the loss of a device, every evaluation kept."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from diffsim import optim
from diffsim.stokes.devices.device import FAILURES, Device, quiet

# what the line search sees where a design has no flow, in units of the loss
_WALL = optim.Wall(height=1e3, over_first=0.0, over_best=10.0, failures=FAILURES)


@dataclass(frozen=True)
class DesignDescent:
    """Evaluations of L-BFGS from one start."""

    designs: Tensor  # designs in order of evaluation, (num_evaluations, num_parameters)
    losses: Tensor  # not normalized, (num_evaluations,); infinite where a design had no flow
    seconds: float  # mean CPU time of loss and gradient [s]
    message: str  # reason of L-BFGS to stop

    @property
    def x(self) -> Tensor:
        """Best design, (num_parameters,)."""
        return self.designs[int(self.losses.argmin())]

    @property
    def loss(self) -> float:
        """Its loss, not normalized."""
        return float(self.losses.min())


def descend(
    device: Device,
    start: Tensor,
    log: optim.Log,
    name: str,
    *,
    unit: float,
    max_evaluations: int,
    ftol: float = 1e-9,
    progress: bool = True,
) -> DesignDescent:
    """Improve a design; what the log's list ``name`` holds is replayed, not computed again.

    Args:
        start: Design to start from, (num_parameters,).
        log: Log of the search, in which every evaluation is kept.
        name: Name of the list of evaluations in the log.
        unit: Loss that counts as 1 in ``ftol``.
        max_evaluations: Largest number of evaluations of loss and gradient.
        ftol: Relative decrease of the loss below which to stop.
        progress: Show a progress bar.

    Raises:
        ValueError, DiffsimError: the start has no flow.
    """

    def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
        with quiet():
            loss, gradient = device.value_and_gradient(torch.from_numpy(x))
        return loss, gradient.numpy()

    options = optim.Options(
        budget=optim.Budget(max_evaluations),
        tolerances=optim.Tolerances(ftol=ftol, gtol=1e-10, line_search=10),
        wall=_WALL,
        unit=unit,
    )
    label = f"L-BFGS, {device.grid.shape}"
    with optim.progress_bar(label, max_evaluations, unit=unit, show=progress) as bar:
        found = optim.minimize(
            objective,
            start.numpy(),
            (device.lower.numpy(), device.upper.numpy()),
            options,
            log=log,
            name=name,
            callback=bar,
        )
    timed = [e.cpu_s for e in found.history if not e.failure]
    return DesignDescent(
        designs=torch.tensor(np.array([e.x for e in found.history])),
        losses=torch.tensor([e.value for e in found.history], dtype=torch.float64),
        seconds=float(np.mean(timed)),
        message=found.message,
    )
