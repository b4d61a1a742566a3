"""A pull of the actuators that nothing explains."""

from __future__ import annotations

from functools import partial

from torch import Tensor

from diffsim.causes.interpolation import straight
from diffsim.causes.signals import Grid
from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.soft_body.scene import SoftScene


def _pull_more(scene: SoftScene, size: Tensor, run: Run, *, spacing: float) -> SoftScene:
    def add(u: Tensor, grid: Grid) -> Tensor:
        return u + straight(size[:, None], spacing, grid.times).mT

    return scene.with_command((), add)


def unknown_pull(num_knots: int, spacing: float) -> Effect:
    """A change of the command that nothing explains, knots in time every ``spacing`` [s]."""
    return Effect(
        name="unknown_pull",
        family="unknown",
        kind="actuator",
        unit="command",
        typical=0.01,
        apply=partial(_pull_more, spacing=spacing),
        components=tuple(f"knot_{k}" for k in range(num_knots)),
    )
