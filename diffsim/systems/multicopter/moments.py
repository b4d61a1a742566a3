"""Moments of air and rotors that thrusts alone do not give."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from diffsim.data.study import Run
from diffsim.systems.multicopter.effects import torque_allocation
from diffsim.systems.multicopter.motion import FlightMotion, by_rotor
from diffsim.systems.multicopter.scene import CopterScene, amount, vector

Moment = Callable[[FlightMotion], Tensor]


def with_moment(scene: CopterScene, moment: Moment) -> CopterScene:
    """A copy on which a moment acts.

    It is given to the vehicle through the thrusts that have this torque and no lift, which is exact
    up to forces across for level rotors.

    Args:
        scene: Run to be flown.
        moment: Function of the motion, in the body frame of the model,
            (points, num_windows, length, 3) [N m].
    """
    allocation = torque_allocation(scene.vehicle)
    return scene.with_schedule(
        lambda motion, thrusts: thrusts + by_rotor(moment(motion), allocation)
    )


def _find_lever(velocity: Tensor) -> Tensor:
    """Direction of the moment of a force against the velocity that acts one meter above the center
    of mass: -e_up x v, in the model's frame (z down)."""
    x, y, z = velocity.unbind(-1)
    return torch.stack([-y, x, torch.zeros_like(z)], -1)


def pitch_in_flow(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    sizes = vector(size)[:, None, None]
    return with_moment(scene, lambda motion: sizes * _find_lever(motion.body_velocity))


def pitch_less_in_climb(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    sizes = vector(size)[:, None, None]

    def moment(motion: FlightMotion) -> Tensor:
        velocity = motion.body_velocity
        return -sizes * -velocity[..., 2:] * _find_lever(velocity)

    return with_moment(scene, moment)


def damp_rates(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    sizes, inertia = vector(size)[:, None, None], scene.vehicle.inertia

    def moment(motion: FlightMotion) -> Tensor:
        return -by_rotor(sizes * motion.body_rates, inertia)

    return with_moment(scene, moment)


def turn_with_rotor_speed(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    """Torque -h' of rotors whose speed changes, h = sum_i size W_i s_i: size their inertia.

    s_i is the sense of rotation, as in ``gyroscopic``, which has the other part, -w x h. The change
    of W_i = sqrt(thrust asked for / thrust coefficient) is a central difference over two steps.
    """

    def moment(motion: FlightMotion) -> Tensor:
        vehicle = motion.vehicle
        speed = motion.rotor_speeds(scene.thrust_coefficient)
        shafts = -vehicle.spins[..., None] * vehicle.directions
        (change,) = torch.gradient(speed, spacing=scene.dt, dim=-2)
        return -amount(size, 3) * (change @ shafts[:, None])

    return with_moment(scene, moment)
