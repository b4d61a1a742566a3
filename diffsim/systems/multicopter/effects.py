"""Causes in the flight of a multicopter."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from diffsim.copter.effects import BodyDrag, RotorDrag
from diffsim.copter.fleet import Fleet
from diffsim.copter.vehicle import GRAVITY
from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.systems.multicopter.motion import Motion, by_rotor
from diffsim.systems.multicopter.scene import CopterScene, amount, vector
from diffsim.systems.multicopter.sensors import (
    ACCELEROMETER_SCALE,
    GYRO_OFFSET,
    IMU_TILT,
    MARKER_PLACEMENT,
    POSITION_SCALE,
)

_VOLTAGE = "voltage_V"
_WAKE_SPEED = 3.0  # forward speed at which half of the wake's loss is there [m/s]
_LEAST_HEIGHT = 0.5  # of a hub above the ground, in radii


def _rotor_drag(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    base = scene.flight_effects.rotor_drag
    total = amount(size, 0) if base is None else base.coefficient + amount(size, 0)
    return scene.with_flight_effect("rotor_drag", RotorDrag(coefficient=total))


def _parasitic_drag(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    def drag(motion: Motion) -> Tensor:
        v = motion.velocity
        # smooth at rest, where the root alone is not
        speed = ((v * v).sum(-1, keepdim=True) + 1e-12).sqrt()
        return -amount(size, 3) * speed * v

    return scene.with_air(drag)


def _body_drag(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    linear = amount(size, 1) * size.new_tensor([1.0, 1.0, 0.0])
    base = scene.flight_effects.body_drag
    quadratic = torch.zeros_like(linear)
    if base is not None:
        linear, quadratic = base.linear + linear, base.quadratic + quadratic
    return scene.with_flight_effect("body_drag", BodyDrag(linear=linear, quadratic=quadratic))


def _inflow(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    """Thrust 1 - size (speed along the thrust): what a climbing rotor loses.

    The speed is the body's; what its turning adds at the hubs is left out.
    """

    def loss(motion: Motion, thrusts: Tensor) -> Tensor:
        climb = by_rotor(motion.body_velocity, motion.vehicle.directions)
        return thrusts * (1.0 - amount(size, 3) * climb)

    return scene.with_schedule(loss)


def _wake(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    """Rotors at the rear of the motion lose the share size of their thrust in fast flight.

    The loss grows as v^2 / (v^2 + v_h^2), v the horizontal speed, v_h = 3 m/s, and as the place of
    the hub against the motion, from 0 at the center to 1 at the largest arm.
    """

    def loss(motion: Motion, thrusts: Tensor) -> Tensor:
        across = motion.body_velocity[..., :2]
        square = (across * across).sum(-1, keepdim=True)
        # v v_rear / (v^2 + v_h^2) without the direction of a vehicle at rest
        speed = (square + 1e-12).sqrt()
        hubs = motion.vehicle.positions[..., :2]
        rear = by_rotor(-across, hubs / hubs.norm(dim=-1).amax(-1)[:, None, None])
        share = rear.clamp(min=0.0) * speed / (square + _WAKE_SPEED**2)
        return thrusts * (1.0 - amount(size, 3) * share)

    return scene.with_schedule(loss)


def _gyroscopic(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
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

    def torque(motion: Motion, thrusts: Tensor) -> Tensor:
        vehicle = motion.vehicle
        speed = (motion.asked.clamp(min=1e-9) / scene.thrust_coefficient).sqrt()
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


def _wind(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    return scene.changed(world_force=scene.world_force + vector(size)[:, None])


def _body_tilt(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    axis, d = torch.broadcast_tensors(vector(size)[:, None], scene.vehicle.directions)
    turned = d + torch.linalg.cross(axis, d)
    turned = turned / turned.norm(dim=-1, keepdim=True)
    return scene.changed(vehicle=scene.vehicle.replace(directions=turned))


def _center_of_mass(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    shifted = scene.vehicle.positions - vector(size)[:, None]
    vehicle = scene.vehicle.replace(positions=shifted)
    return scene.changed(vehicle=vehicle)


def _voltage_exponent(
    scene: CopterScene, size: Tensor, run: Run, *, name: str = _VOLTAGE
) -> CopterScene:
    if name not in run.command:
        raise ValueError(f"run {run.name}: voltage_exponent needs the command {name}")
    voltage = torch.as_tensor(run.command[name], dtype=torch.float64)
    share = torch.cat([voltage[:1], voltage])[:, None] / voltage[0]  # before the record, too
    return scene.with_command(lambda u, dt: u * share ** amount(size, 2))


def _battery_sag(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    since = torch.as_tensor(run.time_s - run.time_s[0], dtype=torch.float64)
    since = torch.cat([since[:1], since])[:, None]  # before the record, too
    return scene.with_command(lambda u, dt: u * (1.0 - amount(size, 2) * since))


def _thrust_curvature(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    vehicle = scene.vehicle
    hover = vehicle.mass[:, None, None] * GRAVITY / vehicle.num_rotors
    largest = vehicle.max_thrusts[:, None]
    return scene.with_command(lambda u, dt: u * (1.0 + amount(size, 2) * (u - hover) / largest))


def _ground_effect(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    """Thrust times 1 + size (radius / 4 height)^2 of each hub above level ground.

    To first order that of Cheeseman and Bennett (1955), 1 / (1 - (radius / 4 height)^2). The ground
    is at the height ``setup["terrain_height_m"]`` of the run, 0 by default.
    """

    def cushion(motion: Motion, thrusts: Tensor) -> Tensor:
        vehicle = motion.vehicle
        radius = vehicle.radii[:, None, None]
        down = by_rotor(motion.rotation[..., 2, :], vehicle.positions) + motion.position[..., 2:]
        height = (-down - scene.terrain_height).maximum(_LEAST_HEIGHT * radius)
        return thrusts * (1.0 + amount(size, 3) * (radius / (4.0 * height)) ** 2)

    return scene.with_schedule(cushion)


def _needs_command(study: Study, *, name: str = _VOLTAGE) -> str | None:
    if all(name in run.command for run in study.runs):
        return None
    return f"the battery's voltage in every run (command {name})"


def _needs_four_rotors(study: Study) -> str | None:
    if int(study.metadata.get("num_rotors", 4)) < 4:
        return "four rotors or more"
    return None


ROTOR_DRAG = Effect(
    name="rotor_drag",
    form="In-plane force of each rotor, -size thrust (velocity of the hub across its axis).",
    family="drag",
    kind="force",
    unit="s/m",
    typical=0.01,
    signed=False,
    also_looks_like=("blade flapping", "induced drag", "parasitic drag at one speed"),
    apply=_rotor_drag,
)
PARASITIC_DRAG = Effect(
    name="parasitic_drag",
    form="Force -size |v| v, v the speed through still air.",
    family="drag",
    kind="force",
    unit="N s^2/m^2",
    typical=0.02,
    signed=False,
    also_looks_like=("rotor drag below 2 m/s",),
    apply=_parasitic_drag,
)
BODY_DRAG = Effect(
    name="body_drag",
    form="Force -size v across the body's z axis.",
    family="drag",
    kind="force",
    unit="N s/m",
    typical=0.1,
    signed=False,
    also_looks_like=("rotor drag at equal thrust", "parasitic drag at one speed"),
    apply=_body_drag,
)
INFLOW = Effect(
    name="inflow",
    form="Thrust 1 - size (speed along the thrust): what a climbing rotor loses.",
    family="thrust",
    kind="force",
    unit="s/m",
    typical=0.03,
    signed=False,
    also_looks_like=("parasitic drag along z", "thrust gain in hover"),
    apply=_inflow,
)
WAKE = Effect(
    name="wake",
    form="Rotors at the rear of the motion lose the share size of their thrust in fast flight.",
    family="thrust",
    kind="force",
    unit="-",
    shown_unit="%",
    typical=0.05,
    signed=False,
    also_looks_like=("pitching moment of the rotors in forward flight", "center of mass"),
    apply=_wake,
)
GYROSCOPIC = Effect(
    name="gyroscopic",
    form="Torque -w x h of spinning rotors, h = sum_i size W_i s_i.",
    family="torque",
    kind="force",
    unit="kg m^2",
    typical=3e-05,
    signed=False,
    also_looks_like=("products of inertia",),
    needs=_needs_four_rotors,
    apply=_gyroscopic,
)
WIND = Effect(
    name="wind",
    form="Constant force in the world, north and east.",
    family="constant",
    kind="environment",
    unit="N",
    typical=0.2,
    components=("north", "east"),
    also_looks_like=("tether", "body tilt at fixed yaw"),
    apply=_wind,
)
BODY_TILT = Effect(
    name="body_tilt",
    form="All thrusts turned about the body's x and y by a small angle; turns with yaw.",
    family="constant",
    kind="material",
    unit="rad",
    typical=0.02,
    components=("roll", "pitch"),
    also_looks_like=("tilted attitude sensor", "wind at fixed yaw"),
    apply=_body_tilt,
)
CENTER_OF_MASS = Effect(
    name="center_of_mass",
    form="The center of mass lies at size in the body frame instead of its origin.",
    family="balance",
    kind="material",
    unit="m",
    typical=0.003,
    components=("x", "y"),
    also_looks_like=("one weak rotor without yaw data", "trim of the speed controllers"),
    apply=_center_of_mass,
)
VOLTAGE_EXPONENT = Effect(
    name="voltage_exponent",
    form="Thrust times (V / V_0)^size with the measured voltage V, V_0 its value at the start.",
    family="thrust",
    kind="actuator",
    unit="-",
    typical=1.0,
    also_looks_like=("loss of thrust as motors warm", "falling mass"),
    needs=_needs_command,
    apply=_voltage_exponent,
)
BATTERY_SAG = Effect(
    name="battery_sag",
    form="Thrust times 1 - size (time since the run began): a battery that nobody recorded.",
    family="thrust",
    kind="actuator",
    unit="1/s",
    typical=2e-3,
    signed=False,
    also_looks_like=("loss of thrust as motors warm", "rising mass", "vertical wind that rises"),
    apply=_battery_sag,
)
THRUST_CURVATURE = Effect(
    name="thrust_curvature",
    form="Thrust u (1 + size (u - u_0) / u_max) instead of u; u_0 what the rotors need in hover.",
    family="thrust",
    kind="actuator",
    unit="-",
    typical=0.1,
    also_looks_like=("thrust gain at one load", "wrong exponent of the speed controller"),
    apply=_thrust_curvature,
)
GROUND_EFFECT = Effect(
    name="ground_effect",
    form="Thrust times 1 + size (radius / 4 height)^2 of each hub above level ground.",
    family="thrust",
    kind="environment",
    unit="-",
    typical=1.0,
    signed=False,
    also_looks_like=("thrust gain at one height",),
    apply=_ground_effect,
)


def voltage_exponent(command: str) -> Effect:
    """The effect of the voltage that a command of another name holds."""
    needs = partial(_needs_command, name=command)
    apply = partial(_voltage_exponent, name=command)
    return replace(VOLTAGE_EXPONENT, needs=needs, apply=apply)


COPTER: tuple[Effect, ...] = (
    ROTOR_DRAG,
    BODY_DRAG,
    PARASITIC_DRAG,
    WIND,
    BODY_TILT,
    VOLTAGE_EXPONENT,
    CENTER_OF_MASS,
    GROUND_EFFECT,
    INFLOW,
    WAKE,
    THRUST_CURVATURE,
    GYROSCOPIC,
    MARKER_PLACEMENT,
    IMU_TILT,
    POSITION_SCALE,
    ACCELEROMETER_SCALE,
    GYRO_OFFSET,
)
