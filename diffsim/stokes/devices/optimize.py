"""Sample designs, take the best, improve it by bounded L-BFGS (thesis 4.2.6, "Optimization")."""

from __future__ import annotations

from concurrent.futures import Executor
from pathlib import Path
from typing import Any

from torch import Tensor

from diffsim.core.checked import checked
from diffsim.core.files import to_plain
from diffsim.optim import Log
from diffsim.stokes.devices.device import Device
from diffsim.stokes.devices.optimum import Optimum, as_optimum
from diffsim.stokes.devices.sampling import draw
from diffsim.stokes.devices.search import descend


@checked
def optimize(
    device: Device,
    num_samples: int | None = None,
    seed: int = 0,
    *,
    max_evaluations: int = 50,
    ftol: float = 1e-9,
    start: Tensor | None = None,
    path: str | Path | None = None,
    progress: bool = True,
    executor: Executor | None = None,
) -> Optimum:
    """Design a device.

    Random designs are drawn within the bounds, those that let no fluid through again; the best one
    starts L-BFGS-B (scipy). Every evaluation is kept in ``path``, so that an interrupted call, made
    again, goes on where it was: L-BFGS replays the evaluations it finds there.

    Args:
        device: The device.
        num_samples: Random designs; ``device.num_samples`` if None.
        seed: Seed of the samples.
        max_evaluations: Largest number of evaluations of loss and gradient.
        ftol: Relative decrease of the loss below which L-BFGS stops.
        start: Start L-BFGS here instead (the samples still set the unit of the loss).
        path: File of the state (see ``optim.Log``); none is kept if None.
        progress: Whether to show bars.
        executor: Executor of the random designs (``core.open_executor``); None: one after another.
            The result is the same.

    Returns:
        ``Optimum``.

    Raises:
        ValueError: the file belongs to another device, seed or start.
        DiffsimError: hardly any random design lets fluid through.
    """
    num_samples = device.num_samples if num_samples is None else num_samples
    check_counts(num_samples=num_samples, max_evaluations=max_evaluations)
    settings = search_settings(device, num_samples, seed)
    log = Log(path, {**settings, "start": None if start is None else start.tolist()})
    samples = draw(device, log, num_samples, seed, progress=progress, executor=executor)
    unit = float(samples.losses.mean())
    first = samples.best(1)[0] if start is None else start.detach().clone()
    descent = descend(
        device,
        first,
        log,
        "evaluations",
        unit=unit,
        max_evaluations=max_evaluations,
        ftol=ftol,
        progress=progress,
    )
    return as_optimum(samples, first, descent, unit)


def check_counts(**counts: int) -> None:
    """Refuse counts below 1, by their names."""
    for name, count in counts.items():
        if count < 1:
            raise ValueError(f"{name} must be at least 1, got {count}")


def search_settings(device: Device, num_samples: int, seed: int) -> dict[str, Any]:
    """What the entries of a log depend on."""
    return {
        "device": device.name,
        "options": to_plain(dict(device.options)),
        "num_samples": num_samples,
        "seed": seed,
    }
