"""A generic smooth wrench on a multicopter: a cause without a form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.interpolation import straight
from diffsim.copter.vehicle.multicopter import GRAVITY
from diffsim.core.checked import checked
from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.identify.unknown import UnknownForce, smooth_covariance
from diffsim.systems.multicopter.effects import torque_allocation
from diffsim.systems.multicopter.scene import CopterScene

_TORQUE_PER_FORCE = 0.02  # components share one unit: a torque of this per newton [m]


def _push_vehicle(
    scene: CopterScene, size: Tensor, run: Run, *, num_knots: int, spacing: float
) -> CopterScene:
    """World force [N] and body torque [0.02 N m], straight lines between knots of time.

    Components: knots fastest, then the axes of the force (NED) and of the torque.
    """
    knots = size.reshape(-1, 6, num_knots)
    # half a step before the record (which starts one early), then in the middle of steps
    times = scene.dt * (torch.arange(scene.num_samples + 1, dtype=torch.float64) - 0.5)
    hats = straight(torch.eye(num_knots, dtype=torch.float64), spacing, times)
    wrench = hats @ knots.mT
    more = _TORQUE_PER_FORCE * wrench[..., 3:] @ torque_allocation(scene.vehicle).mT
    pushed = scene.changed(world_force=scene.world_force + wrench[:, 1:, :3])
    return pushed.with_command((), lambda u, grid: u + more.mT)


@checked
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
        apply=partial(_push_vehicle, num_knots=num_knots, spacing=spacing),
        components=tuple(f"{a}_{k}" for a in axes for k in range(num_knots)),
    )


def wrench_of(runs: Sequence[Run], weight: float) -> UnknownForce:
    """The unknown wrench of a study: knots every 0.2 s, at most 30.

    Args:
        runs: Recorded runs; the longest sets the knots.
        weight: Of the vehicle [N]; sets what is usual.
    """
    longest = max(float(run.time_s[-1] - run.time_s[0]) for run in runs)
    count = min(max(2, round(longest / 0.2) + 1), 30)
    knots = np.linspace(0.0, longest, count)
    smooth = smooth_covariance(knots, 2.0 * float(knots[1]))
    covariance = np.kron(np.eye(6), smooth).astype(np.float64)
    effect = unknown_wrench(count, longest)
    effect = replace(effect, typical=effect.typical * weight / GRAVITY)
    return UnknownForce(effect, covariance, "unknown wrench")
