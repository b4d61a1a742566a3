"""What a search for a device returns."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from diffsim.core.checked import checked
from diffsim.stokes.devices.sampling import DesignSamples
from diffsim.stokes.devices.search import DesignDescent


@checked(kinds_only=True)
@dataclass(frozen=True)
class CoarseStage:
    """What the coarse grid contributed, and how its losses compare; none is normalized.

    Attributes:
        descents: L-BFGS on the coarse grid, from the best sample first.
        fine_losses: Losses of the coarse results on the fine grid, (num_starts,).
        unit_loss: Mean of all samples on the coarse grid.
        unit_error: Standard error of the fine grid's unit, for which only some samples were used.
        checked_coarse: Losses of those samples on the coarse grid, (num_checked,).
        checked_fine: Losses of the same designs on the fine grid, (num_checked,); infinite without
            flow.
    """

    descents: tuple[DesignDescent, ...]
    fine_losses: Tensor
    unit_loss: float
    unit_error: float
    checked_coarse: Tensor
    checked_fine: Tensor


@checked(kinds_only=True)
@dataclass(frozen=True)
class Optimum:
    """The result of ``optimize`` or ``coarse_to_fine``.

    Losses are normalized: 1 is the average of the random samples, 0 a perfect device.

    Attributes:
        x: Best design, (num_parameters,).
        loss: Normalized loss of the best design.
        start: Design that L-BFGS started from, (num_parameters,).
        samples: All sampled designs, (num_samples, num_parameters).
        sample_losses: Losses of these, (num_samples,), mean 1; on the coarse grid where there was
            one.
        unit_loss: Loss that counts as 1.
        evaluations: Designs in order of evaluation, (num_evaluations, num_parameters).
        evaluation_losses: Losses of these, (num_evaluations,); infinite where a design had no flow.
        num_rejected: Random designs that let no fluid through and were drawn again.
        seconds: Mean CPU time of loss and gradient [s].
        message: Why L-BFGS stopped.
        coarse: What was done on a coarser grid before.
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
    coarse: CoarseStage | None = None


def as_optimum(
    samples: DesignSamples,
    start: Tensor,
    descent: DesignDescent,
    unit: float,
    coarse: CoarseStage | None = None,
) -> Optimum:
    """Normalize."""
    return Optimum(
        x=descent.x,
        loss=descent.loss / unit,
        start=start,
        samples=samples.x,
        sample_losses=samples.losses / samples.losses.mean(),
        unit_loss=unit,
        evaluations=descent.designs,
        evaluation_losses=descent.losses / unit,
        num_rejected=samples.num_rejected,
        seconds=descent.seconds,
        message=descent.message,
        coarse=coarse,
    )
