"""A generic smooth wrench on a multicopter: a cause without a form."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.multicopter.effects import torque_allocation
from diffsim.systems.multicopter.scene import CopterScene
from diffsim.systems.signals import straight

_TORQUE_PER_FORCE = 0.02  # components share one unit: a torque of this per newton [m]


class _UnknownWrench(Effect):
    """World force [N] and body torque [0.02 N m], straight lines between knots of time.

    Components: knots fastest, then the axes of the force (NED) and of the torque.
    """

    name, family, kind, unit, typical = "unknown_wrench", "unknown", "force", "N", 0.1
    also_looks_like = ("anything",)

    def __init__(self, num_knots: int, until_s: float):
        self._num_knots, self._spacing = num_knots, until_s / (num_knots - 1)

    def apply(self, scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
        knots = size.reshape(-1, 6, self._num_knots)
        # half a step before the record (which starts one early), then in the middle of steps
        times = scene.dt * (torch.arange(scene.commands.shape[1] + 1, dtype=torch.float64) - 0.5)
        hats = straight(torch.eye(self._num_knots, dtype=torch.float64), self._spacing, times)
        wrench = hats @ knots.mT
        more = _TORQUE_PER_FORCE * wrench[..., 3:] @ torque_allocation(scene.vehicle).mT
        pushed = scene.changed(world_force=scene.world_force + wrench[:, 1:, :3])
        return pushed.with_command(lambda u, dt: u + more)


def unknown_wrench(num_knots: int, until_s: float) -> Effect:
    """The effect with ``num_knots`` >= 2 knots from 0 to ``until_s`` [s]."""
    axes = ("north", "east", "down", "roll", "pitch", "yaw")
    names = tuple(f"{a}_{k}" for a in axes for k in range(num_knots))
    return type("UnknownWrench", (_UnknownWrench,), {"components": names})(num_knots, until_s)
