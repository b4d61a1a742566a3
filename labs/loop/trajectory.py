"""Trajectory optimization (thesis eqs. 5.10-5.12): a cyclic command that travels far."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim import optim
from diffsim.core.errors import DiffsimError
from labs.loop.command import (
    RATE_HZ,
    Command,
    Limits,
    followed,
    interpolation,
)
from labs.loop.model import Starfish

Array = NDArray[np.float64]
_UNIT_M = 0.01  # scale of the travel, so that L-BFGS' tolerances fit
_WALL = optim.Wall(height=1e3, over_first=0.0, failures=(DiffsimError, ValueError))


@dataclass(frozen=True, kw_only=True)
class TrajectorySettings:
    """How the command is optimized.

    Attributes:
        periods: Simulated from rest; travel counts from the first sample to the last.
        num_knots: Per period, with straight lines between them.
        max_evaluations: Largest number of evaluations of the travel with its gradient.
    """

    periods: int = 2
    num_knots: int = 60
    max_evaluations: int = 25


@dataclass(frozen=True, eq=False, kw_only=True)
class OptimizedCommand:
    """A command with what the simulation promises."""

    command: Command  # within bounds and rate
    # loss_before, loss_after: L_a, thesis eq. 5.11 [m]; negative is forwards.
    loss_before: float
    loss_after: float
    num_evaluations: int  # number of evaluations of L_a and its gradient
    message: str  # the solver's reason to stop

    def plain(self) -> dict[str, Any]:
        """For JSON, the command apart."""
        return {k: v for k, v in asdict(self).items() if k != "command"}


def travel_loss(
    model: Starfish, values: Mapping[str, float | Tensor], period: Tensor, periods: int
) -> Tensor:
    """L_a = COM_x(s_N) - COM_x(s_0) [m], thesis eq. 5.11; gradient: period, values.

    Args:
        model: Model of the robot.
        values: Parameters of the model.
        period: (num_samples,) contraction of one period [m].
        periods: Number of periods that are simulated.
    """
    # one sample more: N is the end of the last period
    contraction = torch.cat([period.repeat(periods), period[:1]])
    center = model.motion(values, contraction)[:, -1]
    return center[-1] - center[0]


def optimize(
    model: Starfish,
    values: Mapping[str, float] | Sequence[Mapping[str, float]],
    start: Command,
    limits: Limits,
    settings: TrajectorySettings,
) -> OptimizedCommand:
    """Minimize L_a over the knots of a period by L-BFGS-B; theta stays fixed.

    Bounds of the knots are the solver's; what is too fast for the servo is turned into what it can
    follow (:func:`~labs.loop.followed`), through which gradients flow.

    Args:
        model: Model of the robot.
        values: Identified parameters theta, by name; several: draws, to travel far in the mean.
        start: Command to start at; its period is kept.
        limits: Limits of the servo.
        settings: Periods, knots and budget of the search.
    """
    thetas = [values] if isinstance(values, Mapping) else list(values)
    num_samples = len(start.contraction_m)
    rows = interpolation(min(settings.num_knots, num_samples), num_samples)
    lines = torch.from_numpy(rows)
    knots = np.linalg.lstsq(rows, start.contraction_m, rcond=None)[0] / limits.contraction_m

    def cost(u: Array) -> optim.Sample:
        leaf = torch.tensor(u, dtype=torch.float64, requires_grad=True)
        period = followed(lines @ leaf * limits.contraction_m, limits)
        each = [travel_loss(model, one, period, settings.periods) for one in thetas]
        loss = torch.stack(each).mean() / _UNIT_M
        (slope,) = torch.autograd.grad(loss, leaf)
        return optim.Sample(loss.item(), slope.numpy(), {"period": period.detach().numpy()})

    count = rows.shape[1]
    found = optim.minimize(
        cost,
        np.asarray(knots, dtype=np.float64),
        (np.zeros(count), np.ones(count)),
        optim.Options(
            budget=optim.Budget(settings.max_evaluations, finish_line_search=True),
            tolerances=optim.Tolerances(ftol=1e-5, gtol=1e-5),
            wall=_WALL,
        ),
    )
    return OptimizedCommand(
        command=Command(found.best.notes["period"]),
        loss_before=found.history[0].value * _UNIT_M,
        loss_after=found.value * _UNIT_M,
        num_evaluations=found.num_evaluations,
        message=found.message,
    )


def speed(times: Array, x: Array, period_s: float) -> float:
    """Mean forward speed [m/s] between the second period and the last; forwards is -x.

    Means over whole periods, so that the phase within a period does not count; the first period
    gets the robot going. With two periods, between these.

    Args:
        times: (n,) [s], from 0.
        x: (n,) or (n, num_markers) places along the rail [m]; NaN where not seen.
        period_s: [s].
    """
    count = int((times[-1] + 1.0 / RATE_HZ) / period_s + 1e-6)
    if count < 2:
        raise ValueError(f"a speed needs two periods of {period_s:g} s, got {times[-1]:g} s")
    first, last = (1 if count > 2 else 0), count - 1

    def mean_of(k: int) -> float:
        inside = (times >= k * period_s - 1e-6) & (times < (k + 1) * period_s - 1e-6)
        return float(np.nanmean(x[inside]))

    return -(mean_of(last) - mean_of(first)) / ((last - first) * period_s)
