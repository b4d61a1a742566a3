"""Causes between a command and what it pulls, as they are said; a pull that nothing explains."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from diffsim.causes.commands import COMMAND_GAIN, RATE_LIMIT, SLACK
from diffsim.causes.interpolation import straight
from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.soft_body.scene import SoftScene

PULLING: tuple[Effect, ...] = (replace(COMMAND_GAIN, typical=0.2), RATE_LIMIT, SLACK)


def _pull(scene: SoftScene, size: Tensor, run: Run, *, spacing: float) -> SoftScene:
    def changed(u: Tensor, dt: float) -> Tensor:
        times = dt * torch.arange(len(u), dtype=u.dtype)
        return u + straight(size[:, None], spacing, times)

    return scene.with_command(changed)


def unknown_pull(num_knots: int, spacing: float) -> Effect:
    """A change of the command that nothing explains, knots in time every ``spacing`` [s]."""
    return Effect(
        name="unknown_pull",
        family="unknown",
        kind="actuator",
        unit="command",
        typical=0.01,
        apply=partial(_pull, spacing=spacing),
        components=tuple(f"knot_{k}" for k in range(num_knots)),
    )
