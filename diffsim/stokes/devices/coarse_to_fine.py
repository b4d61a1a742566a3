"""The same search for less: sample on a coarser grid, go on at full size from the best few."""

from __future__ import annotations

import math
from concurrent.futures import Executor
from functools import partial
from pathlib import Path

from torch import Tensor

from diffsim.core.checked import checked
from diffsim.core.errors import DiffsimError
from diffsim.core.files import to_plain
from diffsim.optim import Log
from diffsim.optim.multi_start import from_each
from diffsim.stokes.devices.device import Device
from diffsim.stokes.devices.optimize import check_counts, search_settings
from diffsim.stokes.devices.optimum import CoarseStage, Optimum, as_optimum
from diffsim.stokes.devices.sampling import DesignSamples, draw, values
from diffsim.stokes.devices.search import descend


@checked
def coarse_to_fine(
    device: Device,
    coarse: Device,
    num_samples: int | None = None,
    seed: int = 0,
    *,
    num_starts: int = 3,
    num_checked: int | None = None,
    max_evaluations: int = 50,
    max_coarse_evaluations: int = 50,
    ftol: float = 1e-9,
    path: str | Path | None = None,
    progress: bool = True,
    executor: Executor | None = None,
) -> Optimum:
    """Design a device; random designs are drawn and first improved on a coarser grid.

    1. Random designs on the coarse grid, as ``optimize`` draws them.
    2. L-BFGS there from each of the best ``num_starts``.
    3. Of these results, the best on the device's own grid starts L-BFGS on that.
    4. The unit of the loss on that grid, its mean over the random designs, from the first
       ``num_checked`` of them: mean_coarse(all) * mean_fine(checked) / mean_coarse(checked).

    Losses and gradients of the result are those of the device's own grid throughout; the coarse one
    only chooses the start. Resumes as ``optimize`` does.

    Args:
        device: The device.
        coarse: The same device on a coarser grid.
        num_samples: Random designs; ``device.num_samples`` if None.
        seed: Seed of the samples.
        num_starts: Number of samples that L-BFGS improves on the coarse grid, best first.
        num_checked: Number of samples that are evaluated on both grids; 8, or all if there are
            fewer, if None. More may be asked for in a later call.
        max_evaluations: Largest number of evaluations of loss and gradient.
        max_coarse_evaluations: Largest number of evaluations of each L-BFGS on the coarse grid.
        ftol: Relative decrease of the loss below which L-BFGS stops.
        path: File of the state (see ``optim.Log``); none is kept if None.
        progress: Whether to show bars.
        executor: Executor of the random designs and of L-BFGS on the coarse grid
            (``core.open_executor``); None: one after another. The result is the same.

    Returns:
        ``Optimum``; its ``coarse`` says how the grids compare.

    Raises:
        ValueError: ``coarse`` is another device or no coarser; the file belongs to another search.
        DiffsimError: too few random designs, or none of the improved designs, let fluid through.
    """
    num_samples = device.num_samples if num_samples is None else num_samples
    check_counts(
        num_samples=num_samples,
        num_starts=num_starts,
        max_evaluations=max_evaluations,
        max_coarse_evaluations=max_coarse_evaluations,
    )
    _check_coarse(device, coarse)
    num_checked = min(8, num_samples) if num_checked is None else num_checked
    if not 2 <= num_checked <= num_samples:
        raise ValueError(f"num_checked must lie in [2, {num_samples}], got {num_checked}")
    settings = search_settings(device, num_samples, seed)
    log = Log(path, {**settings, "coarse": to_plain(dict(coarse.options))})
    samples = draw(coarse, log, num_samples, seed, progress=progress, executor=executor)
    unit = float(samples.losses.mean())
    improve = partial(descend, unit=unit, ftol=ftol, progress=progress and executor is None)
    coarsely = partial(improve, coarse, max_evaluations=max_coarse_evaluations)
    named = [(f"coarse {k}", x) for k, x in enumerate(samples.best(num_starts), start=1)]
    descents = tuple(from_each(coarsely, named, log, executor))
    improved_designs = [d.x for d in descents]
    rate = partial(values, device, log, progress=progress, executor=executor)
    fine = rate("improved", improved_designs)
    start = improved_designs[int(fine.argmin())]
    descent = improve(
        device, start, log, "evaluations", max_evaluations=max_evaluations, progress=progress
    )
    checked = rate("checked", list(samples.x[:num_checked]))
    fine_unit, error = unit_on_fine_grid(samples, checked)
    stage = CoarseStage(descents, fine, unit, error, samples.losses[:num_checked], checked)
    return as_optimum(samples, start, descent, fine_unit, stage)


def unit_on_fine_grid(samples: DesignSamples, fine: Tensor) -> tuple[float, float]:
    """Mean loss of all samples on the fine grid, and its standard error, from the first few.

    The ratio estimator: designs that are bad on one grid are bad on the other, so that their ratio
    varies less than they do.

    Args:
        samples: Random designs and their losses on the coarse grid, (num_samples,).
        fine: Losses of the first of them on the fine grid; infinite ones are left out.
    """
    has_flow = fine.isfinite()
    n = int(has_flow.sum())
    if n < 2:
        raise DiffsimError(f"only {n} of {len(fine)} random designs have a flow on the fine grid")
    low, high = samples.losses[: len(fine)][has_flow], fine[has_flow]
    ratio = float(high.sum() / low.sum())
    scatter = float((high - ratio * low).square().sum()) / (n - 1)
    share = 1.0 - n / len(samples.losses)  # nothing is left to chance if all were used
    mean = float(samples.losses.mean())
    return ratio * mean, mean / float(low.mean()) * math.sqrt(scatter / n * share)


def _check_coarse(device: Device, coarse: Device) -> None:
    if [p.name for p in coarse.parameters] != [p.name for p in device.parameters]:
        raise ValueError(
            f"coarse must be the same device as device, got {coarse.name} and {device.name}"
        )
    if coarse.grid.num_nodes >= device.grid.num_nodes:
        raise ValueError(
            f"coarse must have fewer cells than device, got {coarse.grid.shape} and "
            f"{device.grid.shape}"
        )
