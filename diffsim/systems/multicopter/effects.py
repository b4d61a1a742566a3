"""Causes in the flight of a multicopter that need more than a number or a map of its commands."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from diffsim.copter.vehicle.multicopter import GRAVITY, Fleet
from diffsim.data.study import Run
from diffsim.systems.multicopter.estimator import BlindEstimator
from diffsim.systems.multicopter.motion import FlightMotion, by_rotor, stack_points
from diffsim.systems.multicopter.scene import CopterScene, amount, vector

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


Moment = Callable[[FlightMotion], Tensor]


def with_moment(scene: CopterScene, moment: Moment) -> CopterScene:
    """A copy on which a moment acts.

    It is given to the vehicle through the thrusts that have this torque and no lift, which is exact
    up to forces across for level rotors.

    Args:
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


SLING_M = 0.5  # of a string whose length nobody stated


def hang_load(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    """A point mass on a string below the center of mass, at rest when the record starts.

    For small swings d of the load, d'' = -g / l d - a with the recorded acceleration a of the
    vehicle; the string pulls with m g / l d to the side and with m (g - a_z) downwards.
    """
    mass, dt = amount(size, 2), scene.dt
    length = scene.numbers.get("sling_length", torch.full_like(mass, SLING_M))
    stiffness = GRAVITY / length.reshape(-1, 1, 1)
    swing = _swing_pendulum(scene.windows.acceleration, dt, stiffness.sqrt())
    sideways = mass * stiffness * swing * swing.new_tensor([1.0, 1.0, 0.0])

    def weight(motion: FlightMotion) -> Tensor:
        down = motion.acceleration.new_tensor([0.0, 0.0, 1.0])
        return amount(size, 3) * (GRAVITY - motion.acceleration) * down

    return scene.changed(world_force=scene.world_force + sideways).with_air(weight)


def _swing_pendulum(acceleration: Tensor, dt: float, rate: Tensor) -> Tensor:
    """Swing of a pendulum in the middle of every step, (points, num_samples, 3) [m].

    Exact for accelerations that are held over steps; a convolution, by Fourier transforms.

    Args:
        acceleration: Of the point of suspension at every sample, (num_samples, 3) [m/s^2].
        dt: Time between two samples [s].
        rate: Natural rate of the pendulum, (points, 1, 1) [rad/s].
    """
    held = torch.cat([0.5 * (acceleration[1:] + acceleration[:-1]), acceleration[-1:]])
    count = len(held)
    n = torch.arange(count, dtype=torch.float64)[:, None]
    kernel = torch.cos(rate * (n - 0.5).clamp(min=0.0) * dt) - torch.cos(rate * (n + 0.5) * dt)
    size = 2 * count
    product = torch.fft.rfft(kernel, size, 1) * torch.fft.rfft(held, size, 0)
    return -torch.fft.irfft(product, size, 1)[:, :count] / rate**2


def push_in_gusts(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    """Force in the world along x and y: sines and cosines of 2 pi f t, t the recording's clock."""
    middle = torch.as_tensor(run.time_s, dtype=torch.float64) + 0.5 * scene.dt
    angle = 2.0 * torch.pi * scene.number("gust_frequency").reshape(-1, 1) * middle
    parts = size.reshape(-1, 4)[:, None]
    sine, cosine = angle.sin()[..., None], angle.cos()[..., None]
    across = parts[..., 0::2] * sine + parts[..., 1::2] * cosine
    force = torch.nn.functional.pad(across, (0, 1))
    return scene.changed(world_force=scene.world_force + scene.frames.in_world(force))
