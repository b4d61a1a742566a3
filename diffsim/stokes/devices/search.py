"""Bounded L-BFGS (scipy) on the loss of a device, every evaluation kept."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy import optimize
from torch import Tensor
from tqdm import tqdm

from diffsim.stokes.devices.device import FAILURES, Device, quiet
from diffsim.stokes.devices.log import Log

_REJECTED_LOSS = 1e3  # in units of the loss; given to the line search where a design has no flow


@dataclass(frozen=True)
class Descent:
    """Evaluations of L-BFGS from one start.

    Attributes:
        designs: In order of evaluation, (num_evaluations, num_parameters).
        losses: Not normalized, (num_evaluations,); infinite where a design had no flow.
        seconds: Mean CPU time of loss and gradient [s].
        message: Why it stopped.
    """

    designs: Tensor
    losses: Tensor
    seconds: float
    message: str

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
    log: Log,
    name: str,
    *,
    unit: float,
    max_evaluations: int,
    ftol: float = 1e-9,
    progress: bool = True,
) -> Descent:
    """Improve a design; what the log's list ``name`` holds is replayed, not computed again.

    Args:
        device: The device.
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
    search = _Search(device, log, name, unit, max_evaluations, progress)
    try:
        result = optimize.minimize(
            search,
            start.numpy(),
            jac=True,
            method="L-BFGS-B",
            bounds=list(zip(device.lower.tolist(), device.upper.tolist(), strict=True)),
            options={
                "ftol": ftol,
                "gtol": 1e-10,
                "maxfun": max_evaluations,
                "maxiter": max_evaluations,
                "maxls": 10,
            },
        )
        message = str(result.message)
    except _EnoughError:
        message = f"{max_evaluations} evaluations"
    finally:
        search.bar.close()
    used = log[name][: search.count]
    timed = [e["seconds"] for e in used if e["loss"] is not None]
    losses = [np.inf if e["loss"] is None else e["loss"] for e in used]
    return Descent(
        designs=torch.tensor([e["x"] for e in used], dtype=torch.float64),
        losses=torch.tensor(losses, dtype=torch.float64),
        seconds=float(np.mean(timed)),
        message=message,
    )


class _EnoughError(Exception):
    """All evaluations are used up."""


class _Search:
    """Loss and gradient in units for scipy; what the log holds is not computed again."""

    def __init__(
        self, device: Device, log: Log, name: str, unit: float, limit: int, progress: bool
    ):
        self.device, self.log, self.name, self.unit, self.limit = device, log, name, unit, limit
        self.count, self.best = 0, np.inf
        self.bar = tqdm(desc=f"L-BFGS, {device.grid.shape}", total=limit, disable=not progress)

    def __call__(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        if self.count >= self.limit:
            raise _EnoughError
        kept = self.log[self.name]
        if self.count == len(kept):
            self.log.append(self.name, self._evaluate(torch.from_numpy(x.copy())))
        entry = kept[self.count]
        if not np.array_equal(entry["x"], x):  # another scipy or machine: go on from here
            del kept[self.count :]
            return self(x)
        self.count += 1
        self.bar.update()
        if entry["loss"] is None:
            return max(_REJECTED_LOSS, 10.0 * self.best), np.zeros_like(x)
        value = entry["loss"] / self.unit
        self.best = min(self.best, value)
        self.bar.set_postfix(loss=f"{self.best:.3g}")
        return value, np.array(entry["gradient"]) / self.unit

    def _evaluate(self, x: Tensor) -> dict[str, Any]:
        before = time.process_time()
        try:
            with quiet():
                loss, gradient = self.device.value_and_gradient(x)
        except FAILURES:
            if not self.log[self.name]:
                raise  # the start itself has no flow
            return {"x": x.tolist(), "loss": None, "gradient": None, "seconds": 0.0}
        return {
            "x": x.tolist(),
            "loss": loss,
            "gradient": gradient.tolist(),
            "seconds": time.process_time() - before,
        }
