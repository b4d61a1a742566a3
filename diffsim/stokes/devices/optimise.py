"""Sample designs, take the best, improve it by bounded L-BFGS (thesis 4.2.6, "Optimization")."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import optimize
from torch import Tensor
from tqdm import tqdm

from diffsim._files import to_plain, write_json_atomic
from diffsim.errors import DiffsimError
from diffsim.stokes.devices.device import FAILURES, Device, quiet

_REJECTED_LOSS = 1e3  # normalised; given to the line search where a design has no flow
_MAX_REJECTED = 50  # per accepted sample


@dataclass(frozen=True)
class Optimum:
    """What ``optimise`` found.

    Losses are normalised: 1 is the average of the random samples, 0 a perfect device.

    Attributes:
        x: Best design, (num_parameters,).
        loss: Its loss.
        start: Design that L-BFGS started from, the best sample, (num_parameters,).
        samples: All sampled designs, (num_samples, num_parameters).
        sample_losses: (num_samples,), mean 1.
        unit_loss: Loss that counts as 1.
        evaluations: Designs in order of evaluation, (num_evaluations, num_parameters).
        evaluation_losses: (num_evaluations,); infinite where a design had no flow.
        num_rejected: Random designs that let no fluid through and were drawn again.
        seconds: Mean CPU time of loss and gradient [s].
        message: Why L-BFGS stopped.
    """

    x: Tensor
    loss: float
    start: Tensor
    samples: Tensor
    sample_losses: Tensor
    unit_loss: float
    evaluations: Tensor
    evaluation_losses: Tensor
    num_rejected: int
    seconds: float
    message: str


def optimise(
    device: Device,
    num_samples: int | None = None,
    seed: int = 0,
    *,
    max_evaluations: int = 50,
    ftol: float = 1e-9,
    start: Tensor | None = None,
    path: str | Path | None = None,
    progress: bool = True,
) -> Optimum:
    """Design a device.

    Random designs are drawn within the bounds, those that let no fluid through again; the best one
    starts L-BFGS-B (scipy). Every evaluation is kept in ``path``, so that an interrupted call, made
    again, goes on where it was: L-BFGS replays the evaluations it finds there.

    Args:
        device: The device.
        num_samples: Random designs; ``device.num_samples`` if None.
        seed: Of the samples.
        max_evaluations: Of loss and gradient, at most.
        ftol: Relative decrease of the loss below which L-BFGS stops.
        start: Start L-BFGS here instead (the samples still set the unit of the loss).
        path: JSON file of the state; none is kept if None.
        progress: Show bars.

    Returns:
        ``Optimum``.

    Raises:
        ValueError: the file belongs to another device, seed or start.
        DiffsimError: hardly any random design lets fluid through.
    """
    num_samples = device.num_samples if num_samples is None else num_samples
    if num_samples < 1 or max_evaluations < 1:
        raise ValueError("num_samples and max_evaluations must be at least 1")
    settings = {
        "device": device.name,
        "options": to_plain(dict(device.options)),
        "num_samples": num_samples,
        "seed": seed,
        "start": None if start is None else start.tolist(),
    }
    log = _Log(None if path is None else Path(path), settings)
    _draw(device, log, num_samples, seed, progress)
    samples = torch.tensor([s["x"] for s in log.samples], dtype=torch.float64)
    losses = torch.tensor([s["loss"] for s in log.samples], dtype=torch.float64)
    unit = float(losses.mean())
    first = samples[int(losses.argmin())] if start is None else start.detach().clone()
    search = _Search(device, log, unit, max_evaluations, progress)
    try:
        result = optimize.minimize(
            search,
            first.numpy(),
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
    used = log.evaluations[: search.count]
    values = [np.inf if e["loss"] is None else e["loss"] / unit for e in used]
    best = int(np.argmin(values))
    timed = [e["seconds"] for e in used if e["loss"] is not None]
    return Optimum(
        x=torch.tensor(used[best]["x"], dtype=torch.float64),
        loss=float(values[best]),
        start=first,
        samples=samples,
        sample_losses=losses / unit,
        unit_loss=unit,
        evaluations=torch.tensor([e["x"] for e in used], dtype=torch.float64),
        evaluation_losses=torch.tensor(values, dtype=torch.float64),
        num_rejected=sum(s["rejected"] for s in log.samples),
        seconds=float(np.mean(timed)) if timed else float("nan"),
        message=message,
    )


class _EnoughError(Exception):
    """All evaluations are used up."""


class _Log:
    """Samples and evaluations, on disk after every one of them."""

    def __init__(self, path: Path | None, settings: dict[str, Any]):
        self.path, self.settings = path, settings
        self.samples: list[dict[str, Any]] = []
        self.evaluations: list[dict[str, Any]] = []
        if path is None or not path.exists():
            return
        kept = json.loads(path.read_text(encoding="utf-8"))
        if kept.get("settings") != settings:
            raise ValueError(
                f"{path} belongs to another run ({kept.get('settings')}); delete it, or choose "
                "another path"
            )
        self.samples, self.evaluations = kept["samples"], kept["evaluations"]

    def save(self) -> None:
        if self.path is not None:
            state = {
                "settings": self.settings,
                "samples": self.samples,
                "evaluations": self.evaluations,
            }
            write_json_atomic(self.path, state)


def _draw(device: Device, log: _Log, num_samples: int, seed: int, progress: bool) -> None:
    """Fill up the log's samples; the draws before them are repeated, not their flows."""
    generator = torch.Generator().manual_seed(seed)
    for kept in log.samples:
        for _ in range(kept["rejected"] + 1):
            device.sample(generator)
    show = tqdm(
        desc="random designs", total=num_samples, initial=len(log.samples), disable=not progress
    )
    with show, quiet():
        while len(log.samples) < num_samples:
            for rejected in range(_MAX_REJECTED):
                x = device.sample(generator)
                try:
                    loss = device.value(x)
                except FAILURES as error:
                    last = error
                    continue
                log.samples.append({"x": x.tolist(), "loss": loss, "rejected": rejected})
                break
            else:
                raise DiffsimError(
                    f"{_MAX_REJECTED} random designs of {device.name} in a row have no flow; "
                    f"the last one: {last}"
                )
            log.save()
            show.update()


class _Search:
    """Normalised loss and gradient for scipy; what the log holds is not computed again."""

    def __init__(self, device: Device, log: _Log, unit: float, limit: int, progress: bool):
        self.device, self.log, self.unit, self.limit = device, log, unit, limit
        self.count, self.best = 0, np.inf
        self.bar = tqdm(desc="L-BFGS", total=limit, disable=not progress)

    def __call__(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        if self.count >= self.limit:
            raise _EnoughError
        if self.count == len(self.log.evaluations):
            self.log.evaluations.append(self._evaluate(torch.from_numpy(x.copy())))
            self.log.save()
        entry = self.log.evaluations[self.count]
        if not np.array_equal(entry["x"], x):  # another scipy or machine: go on from here
            del self.log.evaluations[self.count :]
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
            if not self.log.evaluations:
                raise  # the start itself has no flow
            return {"x": x.tolist(), "loss": None, "gradient": None, "seconds": 0.0}
        return {
            "x": x.tolist(),
            "loss": loss,
            "gradient": gradient.tolist(),
            "seconds": time.process_time() - before,
        }
