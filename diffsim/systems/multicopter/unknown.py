"""A generic smooth wrench on a multicopter: a cause without a form."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.multicopter.effects import torque_allocation
from diffsim.systems.multicopter.scene import CopterScene
from diffsim.systems.signals import straight

_TORQUE_PER_FORCE = 0.02  # components share one unit: a torque of this per newton [m]


def _pushed(
    scene: CopterScene, size: Tensor, run: Run, *, num_knots: int, spacing: float
) -> CopterScene:
    """World force [N] and body torque [0.02 N m], straight lines between knots of time.

    Components: knots fastest, then the axes of the force (NED) and of the torque.
    """
    knots = size.reshape(-1, 6, num_knots)
    # half a step before the record (which starts one early), then in the middle of steps
    times = scene.dt * (torch.arange(scene.commands.shape[1] + 1, dtype=torch.float64) - 0.5)
    hats = straight(torch.eye(num_knots, dtype=torch.float64), spacing, times)
    wrench = hats @ knots.mT
    more = _TORQUE_PER_FORCE * wrench[..., 3:] @ torque_allocation(scene.vehicle).mT
    pushed = scene.changed(world_force=scene.world_force + wrench[:, 1:, :3])
    return pushed.with_command(lambda u, dt: u + more)


def unknown_wrench(num_knots: int, until_s: float) -> Effect:
    """The effect with ``num_knots`` >= 2 knots from 0 to ``until_s`` [s]."""
    axes = ("north", "east", "down", "roll", "pitch", "yaw")
    spacing = until_s / (num_knots - 1)
    return Effect(
        name="unknown_wrench",
        form="World force [N] and body torque [0.02 N m], straight lines between knots of time.",
        family="unknown",
        kind="force",
        unit="N",
        typical=0.1,
        also_looks_like=("anything",),
        apply=partial(_pushed, num_knots=num_knots, spacing=spacing),
        components=tuple(f"{a}_{k}" for a in axes for k in range(num_knots)),
    )
