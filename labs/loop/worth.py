"""What it would buy a swimmer to mend a cause: its farthest way with it, half of it, and none."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from diffsim.sim_to_real.worth import TaskByShare, Worth
from labs.loop.command import Command, Limits
from labs.loop.model import Starfish
from labs.loop.trajectory import TrajectorySettings, optimize, travel_loss


def worth_of_travel(
    model: Starfish,
    values: Mapping[str, float],
    start: Command,
    limits: Limits,
    settings: TrajectorySettings | None = None,
) -> tuple[Worth, ...]:
    """What each cause of a swimmer costs its travel: the farthest way with it, half, and none [m].

    Args:
        model: Robot with causes, as ``Starfish.extended`` makes it.
        values: Values of its parameters, by name, sizes of causes among them.
        start: Command to start at; its period is kept.
        limits: Limits of the servo.
        settings: Periods, knots and budget of each search.
    """
    chosen = settings or TrajectorySettings()

    def unaware(command: Command) -> float:
        with torch.no_grad():
            period = torch.from_numpy(command.contraction_m)
            return -float(travel_loss(model, values, period, chosen.periods))

    return TaskByShare(
        best=lambda share, causes, last: optimize(
            model,
            model.mended(values, share, causes),
            start if last is None else last.command,
            limits,
            chosen,
        ),
        score=lambda found: -found.loss_after,
        unaware=lambda found: unaware(found.command),
        of="travel",
    ).worth([effect.name for effect in model.causes])
