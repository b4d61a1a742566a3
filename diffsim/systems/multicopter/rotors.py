"""Causes in rotors: what their speed costs, and a single one that lacks thrust or leans."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.data.study import Run
from diffsim.systems.multicopter.effects import tilt_axes, torque_allocation
from diffsim.systems.multicopter.motion import FlightMotion, by_rotor
from diffsim.systems.multicopter.scene import CopterScene, amount, vector


def drag_by_rotor_speed(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    """Force -size W_i (velocity of the hub across its axis) of each rotor, W_i its speed.

    W_i = sqrt(thrust asked for / thrust coefficient). The forces' torque is given to the vehicle
    through the thrusts that have it and no lift.
    """
    allocation = torque_allocation(scene.vehicle)

    def forces(motion: FlightMotion) -> Tensor:
        """In the body frame, (points, num_windows, length, n_rotors, 3) [N]."""
        speed = motion.rotor_speeds(scene.thrust_coefficient)
        arms, axes = (
            v[:, None, None] for v in (motion.vehicle.positions, motion.vehicle.directions)
        )
        turning = motion.body_rates[..., None, :]
        hubs = motion.body_velocity[..., None, :] + torch.linalg.cross(
            *torch.broadcast_tensors(turning, arms)
        )
        across = hubs - (hubs * axes).sum(-1, keepdim=True) * axes
        return -amount(size, 4) * speed[..., None] * across

    def drag(motion: FlightMotion) -> Tensor:
        total = forces(motion).sum(-2)
        return (motion.rotation * total[..., None, :]).sum(-1)

    def torque(motion: FlightMotion, thrusts: Tensor) -> Tensor:
        found = forces(motion)
        arms, found = torch.broadcast_tensors(motion.vehicle.positions[:, None, None], found)
        return thrusts + by_rotor(torch.linalg.cross(arms, found).sum(-2), allocation)

    return scene.with_air(drag).with_schedule(torque)


def lose_thrust(scene: CopterScene, size: Tensor, run: Run, *, rotor: str) -> CopterScene:
    """Less thrust of a rotor for the same torque: its torque per thrust grows as the thrust falls.

    Causes that depend on a rotor's speed take the lost thrust for lost speed, an error of second
    order.
    """
    kept = 1.0 - amount(size, 1) * _mark_rotor(scene, rotor)
    weaker = scene.with_command((), lambda u, grid: u * kept[..., None])
    return _scale_torques(weaker, 1.0 / kept)


def lose_torque(scene: CopterScene, size: Tensor, run: Run, *, rotor: str) -> CopterScene:
    return _scale_torques(scene, 1.0 - amount(size, 1) * _mark_rotor(scene, rotor))


def tilt_rotor(scene: CopterScene, size: Tensor, run: Run, *, rotor: str) -> CopterScene:
    return tilt_axes(scene, vector(size)[:, None] * _mark_rotor(scene, rotor)[:, None])


def _mark_rotor(scene: CopterScene, rotor: str) -> Tensor:
    """1 for a certain rotor, else 0, (n_rotors,)."""
    share = torch.zeros(scene.vehicle.num_rotors, dtype=torch.float64)
    share[list(scene.commands.rows[rotor])] = 1.0
    return share


def _scale_torques(scene: CopterScene, factor: Tensor) -> CopterScene:
    """A copy whose reaction torques per thrust are larger by factors, (points, n_rotors)."""
    return scene.with_number("torque_ratio", lambda ratios: ratios * factor.mT)
