"""Causes in the flight of a multicopter that need more than a number or a map of its commands."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.copter.vehicle.fleet import Fleet
from diffsim.copter.vehicle.multicopter import GRAVITY
from diffsim.data.study import Run
from diffsim.systems.multicopter.estimator import BlindEstimator
from diffsim.systems.multicopter.motion import FlightMotion, by_rotor
from diffsim.systems.multicopter.scene import CopterScene, amount, vector
from diffsim.systems.multicopter.vectors import stack_points

ESTIMATOR_GAINS = ("velocity", "tilt", "heading")  # numbers, as ``BlindEstimator`` has them
VOLTAGE = "voltage_V"  # command that is the battery's, where none is named
_WAKE_SPEED = 3.0  # forward speed at which half of the wake's loss is there [m/s]
_LEAST_HEIGHT = 0.5  # of a hub above the ground, in radii


def drag_by_square(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    def drag(motion: FlightMotion) -> Tensor:
        v = motion.velocity
        # smooth at rest, where the root alone is not
        speed = ((v * v).sum(-1, keepdim=True) + 1e-12).sqrt()
        return -amount(size, 3) * speed * v

    return scene.with_air(drag)


def lose_thrust_in_climb(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    """Thrust 1 - size (speed along the thrust): what a climbing rotor loses.

    The speed is the body's; what its turning adds at the hubs is left out.
    """

    def loss(motion: FlightMotion, thrusts: Tensor) -> Tensor:
        climb = by_rotor(motion.body_velocity, motion.vehicle.directions)
        return thrusts * (1.0 - amount(size, 3) * climb)

    return scene.with_schedule(loss)


def lose_thrust_in_wake(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    """Rotors at the rear of the motion lose the share size of their thrust in fast flight.

    The loss grows as v^2 / (v^2 + v_h^2), v the horizontal speed, v_h = 3 m/s, and as the place of
    the hub against the motion, from 0 at the center to 1 at the largest arm.
    """

    def loss(motion: FlightMotion, thrusts: Tensor) -> Tensor:
        across = motion.body_velocity[..., :2]
        square = (across * across).sum(-1, keepdim=True)
        # v v_rear / (v^2 + v_h^2) without the direction of a vehicle at rest
        speed = (square + 1e-12).sqrt()
        hubs = motion.vehicle.positions[..., :2]
        rear = by_rotor(-across, hubs / hubs.norm(dim=-1).amax(-1)[:, None, None])
        share = rear.clamp(min=0.0) * speed / (square + _WAKE_SPEED**2)
        return thrusts * (1.0 - amount(size, 3) * share)

    return scene.with_schedule(loss)


def turn_with_spin(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    """Torque -w x h of spinning rotors, h = sum_i size W_i s_i: size their inertia about the shaft.

    The angular momentum of vehicle and rotors is J w + h in the body frame, which turns with w:
    its change J w' + w x (J w + h) is the torque from outside (h' is left out), so that rotors add
    -w x h. A rotor whose reaction on the vehicle is along its thrust (spins +1) turns the other
    way, s_i = -spins_i thrust direction: about +z, clockwise from above, if its thrust is upwards.
    W_i = sqrt(thrust asked for / thrust coefficient).

    Given to the vehicle through the thrusts that have this torque and no lift, which is exact up to
    forces across for level rotors.
    """
    allocation = torque_allocation(scene.vehicle)

    def torque(motion: FlightMotion, thrusts: Tensor) -> Tensor:
        vehicle = motion.vehicle
        speed = motion.rotor_speeds(scene.thrust_coefficient)
        shafts = -vehicle.spins[..., None] * vehicle.directions
        momentum = amount(size, 3) * (speed @ shafts[:, None])
        rates, momentum = torch.broadcast_tensors(motion.body_rates, momentum)
        return thrusts + by_rotor(-torch.linalg.cross(rates, momentum), allocation)

    return scene.with_schedule(torque)


def torque_allocation(vehicle: Fleet) -> Tensor:
    """(points, n_rotors, 3): thrusts of least size with a given torque and no force along z."""
    lift, torque = torch.broadcast_tensors(vehicle.directions[..., 2:], vehicle.torque_matrix.mT)
    wrench = torch.cat([lift[..., :1], torque], -1)
    return torch.linalg.pinv(wrench.mT)[..., 1:]


def tilt_axes(scene: CopterScene, turns: Tensor) -> CopterScene:
    """A copy whose rotors' axes are turned by small rotation vectors.

    Args:
        scene: Run to be flown.
        turns: In the body frame of the recording, (points, n_rotors or 1, 3) [rad].
    """
    turns, axes = torch.broadcast_tensors(scene.frames.in_body(turns), scene.vehicle.directions)
    turned = axes + torch.linalg.cross(turns, axes)
    turned = turned / turned.norm(dim=-1, keepdim=True)
    return scene.changed(fleet=scene.fleet.replace(directions=turned))


def tilt_rotors(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    return tilt_axes(scene, vector(size)[:, None])


def follow_voltage(
    scene: CopterScene, size: Tensor, run: Run, *, name: str = VOLTAGE
) -> CopterScene:
    if name not in run.command:
        raise ValueError(f"run {run.name}: voltage_exponent needs the command {name}")
    voltage = torch.as_tensor(run.command[name], dtype=torch.float64)
    share = torch.cat([voltage[:1], voltage]) / voltage[0]  # before the record, too
    return scene.with_command((), lambda u, grid: u * share ** amount(size, 2))


def curve_thrust(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    vehicle = scene.vehicle
    hover = vehicle.mass[:, None, None] * GRAVITY / vehicle.num_rotors
    largest = vehicle.max_thrusts[..., None]
    return scene.with_command(
        (), lambda u, grid: u * (1.0 + amount(size, 2) * (u - hover) / largest)
    )


def push_near_ground(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    """Thrust times 1 + size (radius / 4 height)^2 of each hub above level ground.

    To first order that of Cheeseman and Bennett (1955), 1 / (1 - (radius / 4 height)^2). The ground
    is at the height ``setup["terrain_height_m"]`` of the run, 0 by default.
    """

    def cushion(motion: FlightMotion, thrusts: Tensor) -> Tensor:
        vehicle = motion.vehicle
        radius = vehicle.radii[:, None, None]
        down = by_rotor(motion.rotation[..., 2, :], vehicle.positions) + motion.position[..., 2:]
        height = (-down - scene.terrain_height).maximum(_LEAST_HEIGHT * radius)
        return thrusts * (1.0 + amount(size, 3) * (radius / (4.0 * height)) ** 2)

    return scene.with_schedule(cushion)


def estimate_without_drag(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    drag, record = amount(size, 0), scene.windows
    gains = stack_points(scene.number(f"estimator_{name}") for name in ESTIMATOR_GAINS)
    points = max(len(drag), len(gains))
    known = drag.expand(points), gains.expand(points, -1)
    force = scene.force_by_record()
    blind = BlindEstimator.of(record.states, record.acceleration, force, scene.dt, known)
    return scene.changed(estimator=blind)
