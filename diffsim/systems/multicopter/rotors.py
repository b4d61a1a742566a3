"""Causes in rotors whose speed is known."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.actuator import HELD_LAG
from diffsim.systems.multicopter.lag import speed_lagged
from diffsim.systems.multicopter.motion import Motion
from diffsim.systems.multicopter.scene import CopterScene, amount

_LEAST_N = 1e-9  # of a thrust: its root has no slope at zero


def _rotor_speed_drag(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    """Force -size W_i (velocity across its axis) of each rotor, W_i its speed.

    W_i = sqrt(thrust / thrust coefficient). The velocity is the body's, and the force acts at the
    center of mass: exact but for the turning of the body.
    """

    def drag(motion: Motion) -> Tensor:
        speed = (motion.thrusts.clamp(min=_LEAST_N) / scene.thrust_coefficient).sqrt()
        axes = motion.vehicle.directions[:, None, None]
        velocity = motion.body_velocity[..., None, :]
        velocity, axes = torch.broadcast_tensors(velocity, axes)
        across = velocity - (velocity * axes).sum(-1, keepdim=True) * axes
        force = -amount(size, 3) * (speed[..., None] * across).sum(-2)
        return (motion.rotation * force[..., None, :]).sum(-1)

    return scene.with_air(drag)


def _speed_lag(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    return scene.with_command(lambda u, dt: speed_lagged(u, dt, size[..., 0]))


ROTOR_SPEED_DRAG = Effect(
    name="rotor_speed_drag",
    form="Force of each rotor -size W (velocity across its axis), W its speed.",
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
