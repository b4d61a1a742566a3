"""Causes in rotors whose speed is known."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from diffsim.causes.commands import HELD_LAG
from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.multicopter.effects import torque_allocation
from diffsim.systems.multicopter.lag import speed_lagged
from diffsim.systems.multicopter.motion import Motion, by_rotor
from diffsim.systems.multicopter.scene import CopterScene, amount

_LEAST_N = 1e-9  # of a thrust: its root has no slope at zero


def _rotor_speed_drag(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    """Force -size W_i (velocity of the hub across its axis) of each rotor, W_i its speed.

    W_i = sqrt(thrust asked for / thrust coefficient). The forces' torque is given to the vehicle
    through the thrusts that have it and no lift.
    """
    allocation = torque_allocation(scene.vehicle)

    def forces(motion: Motion) -> Tensor:
        """In the body frame, (points, num_windows, length, n_rotors, 3) [N]."""
        speed = (motion.asked.clamp(min=_LEAST_N) / scene.thrust_coefficient).sqrt()
        arms, axes = (
            v[:, None, None] for v in (motion.vehicle.positions, motion.vehicle.directions)
        )
        turning = motion.body_rates[..., None, :]
        hubs = motion.body_velocity[..., None, :] + torch.linalg.cross(
            *torch.broadcast_tensors(turning, arms)
        )
        across = hubs - (hubs * axes).sum(-1, keepdim=True) * axes
        return -amount(size, 4) * speed[..., None] * across

    def drag(motion: Motion) -> Tensor:
        total = forces(motion).sum(-2)
        return (motion.rotation * total[..., None, :]).sum(-1)

    def torque(motion: Motion, thrusts: Tensor) -> Tensor:
        found = forces(motion)
        arms, found = torch.broadcast_tensors(motion.vehicle.positions[:, None, None], found)
        return thrusts + by_rotor(torch.linalg.cross(arms, found).sum(-2), allocation)

    return scene.with_air(drag).with_schedule(torque)


def _speed_lag(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    return scene.with_command(lambda u, dt: speed_lagged(u, dt, size[..., 0]))


ROTOR_SPEED_DRAG = Effect(
    name="rotor_speed_drag",
    form="Force of each rotor -size W (velocity of the hub across its axis), W its speed.",
    family="drag",
    kind="force",
    unit="N s^2/(m rad)",
    typical=1e-4,
    signed=False,
    also_looks_like=("rotor drag at equal thrust", "body drag", "blade flapping"),
    apply=_rotor_speed_drag,
)
SPEED_LAG = replace(
    HELD_LAG,
    form="First-order lag of the rotors' speed, with the time constant size.",
    apply=_speed_lag,
)
