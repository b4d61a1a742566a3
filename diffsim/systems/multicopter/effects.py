"""Causes in the flight of a multicopter."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

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
    AccelerometerScale,
    GyroOffset,
    ImuTilt,
    MarkerPlacement,
    PositionScale,
)

_VOLTAGE = "voltage_V"
_WAKE_SPEED = 3.0  # forward speed at which half of the wake's loss is there [m/s]
_LEAST_HEIGHT = 0.5  # of a hub above the ground, in radii


class RotorDragEffect(Effect):
    """In-plane force of each rotor, -size thrust (velocity of the hub across its axis)."""

    name, family, kind, unit, typical = "rotor_drag", "drag", "force", "s/m", 0.01
    signed = False
    also_looks_like = ("blade flapping", "induced drag", "parasitic drag at one speed")

    def apply(self, scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
        base = scene.flight_effects.rotor_drag
        total = amount(size, 0) if base is None else base.coefficient + amount(size, 0)
        return scene.with_flight_effect("rotor_drag", RotorDrag(coefficient=total))


class ParasiticDrag(Effect):
    """Force -size |v| v, v the speed through still air."""

    name, family, kind, unit, typical = "parasitic_drag", "drag", "force", "N s^2/m^2", 0.02
    signed = False
    also_looks_like = ("rotor drag below 2 m/s",)

    def apply(self, scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
        def drag(motion: Motion) -> Tensor:
            v = motion.velocity
            # smooth at rest, where the root alone is not
            speed = ((v * v).sum(-1, keepdim=True) + 1e-12).sqrt()
            return -amount(size, 3) * speed * v

        return scene.with_air(drag)


class LinearDrag(Effect):
    """Force -size v across the body's z axis."""

    name, family, kind, unit, typical = "linear_drag", "drag", "force", "N s/m", 0.1
    signed = False
    also_looks_like = ("rotor drag at equal thrust", "parasitic drag at one speed")

    def apply(self, scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
        linear = amount(size, 1) * size.new_tensor([1.0, 1.0, 0.0])
        base = scene.flight_effects.body_drag
        quadratic = torch.zeros_like(linear)
        if base is not None:
            linear, quadratic = base.linear + linear, base.quadratic + quadratic
        return scene.with_flight_effect("body_drag", BodyDrag(linear=linear, quadratic=quadratic))


class Inflow(Effect):
    """Thrust 1 - size (speed along the thrust): what a climbing rotor loses.

    The speed is the body's; what its turning adds at the hubs is left out.
    """

    name, family, kind, unit, typical = "inflow", "thrust", "force", "s/m", 0.03
    signed = False
    also_looks_like = ("parasitic drag along z", "thrust gain in hover")

    def apply(self, scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
        def loss(motion: Motion, thrusts: Tensor) -> Tensor:
            climb = by_rotor(motion.body_velocity, motion.vehicle.directions)
            return thrusts * (1.0 - amount(size, 3) * climb)

        return scene.with_schedule(loss)


class Wake(Effect):
    """Rotors at the rear of the motion lose the share size of their thrust in fast flight.

    The loss grows as v^2 / (v^2 + v_h^2), v the horizontal speed, v_h = 3 m/s, and as the place of
    the hub against the motion, from 0 at the centre to 1 at the largest arm.
    """

    name, family, kind, unit, typical = "wake", "thrust", "force", "-", 0.05
    signed = False
    also_looks_like = ("pitching moment of the rotors in forward flight", "centre of mass")

    def apply(self, scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
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


class Gyroscopic(Effect):
    """Torque -w x h of spinning rotors, h = sum_i size W_i s_i: size their inertia about the shaft.

    The angular momentum of vehicle and rotors is J w + h in the body frame, which turns with w:
    its change J w' + w x (J w + h) is the torque from outside (h' is left out), so that rotors add
    -w x h. A rotor whose reaction on the vehicle is along its thrust (spins +1) turns the other
    way, s_i = -spins_i thrust direction: about +z, clockwise from above, if its thrust is upwards.
    W_i = sqrt(thrust / thrust coefficient).

    Given to the vehicle through the thrusts that have this torque and no lift, which is exact up to
    forces across for level rotors.
    """

    name, family, kind, unit, typical = "gyroscopic", "torque", "force", "kg m^2", 3e-5
    signed = False
    also_looks_like = ("products of inertia",)

    def needs(self, study: Study) -> str | None:
        if int(study.metadata.get("num_rotors", 4)) < 4:
            return "four rotors or more"
        return None

    def apply(self, scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
        allocation = torque_allocation(scene.vehicle)

        def torque(motion: Motion, thrusts: Tensor) -> Tensor:
            vehicle = motion.vehicle
            speed = (thrusts.clamp(min=1e-9) / scene.thrust_coefficient).sqrt()
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


class Wind(Effect):
    """Constant force in the world, north and east."""

    name, family, kind, unit, typical = "wind", "constant", "environment", "N", 0.2
    components = ("north", "east")
    also_looks_like = ("tether", "body tilt at fixed yaw")

    def apply(self, scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
        return scene.changed(world_force=scene.world_force + vector(size)[:, None])


class BodyTilt(Effect):
    """All thrusts turned about the body's x and y by a small angle; turns with yaw."""

    name, family, kind, unit, typical = "body_tilt", "constant", "material", "rad", 0.02
    components = ("roll", "pitch")
    also_looks_like = ("tilted attitude sensor", "wind at fixed yaw")

    def apply(self, scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
        axis, d = torch.broadcast_tensors(vector(size)[:, None], scene.vehicle.directions)
        turned = d + torch.linalg.cross(axis, d)
        turned = turned / turned.norm(dim=-1, keepdim=True)
        return scene.changed(vehicle=scene.vehicle.replace(directions=turned))


class CentreOfMass(Effect):
    """The centre of mass lies at size in the body frame instead of its origin."""

    name, family, kind, unit, typical = "centre_of_mass", "balance", "material", "m", 3e-3
    components = ("x", "y")
    also_looks_like = ("one weak rotor without yaw data", "trim of the speed controllers")

    def apply(self, scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
        shifted = scene.vehicle.positions - vector(size)[:, None]
        vehicle = scene.vehicle.replace(positions=shifted)
        return scene.changed(vehicle=vehicle)


class WeakRotor(Effect):
    """One rotor gives the share 1 - size of its thrust; see :func:`weak_rotor`."""

    name, family, kind, unit, typical = "weak_rotor", "balance", "actuator", "-", 0.05
    also_looks_like = ("centre of mass without yaw data", "damaged or swapped propeller")
    index: ClassVar[int] = 0

    def apply(self, scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
        share = torch.zeros(scene.vehicle.num_rotors, dtype=size.dtype)
        share[self.index] = 1.0
        return scene.with_command(lambda u, dt: u * (1.0 - amount(size, 2) * share))

    def __reduce__(self) -> tuple[Callable[[int], WeakRotor], tuple[int]]:
        return weak_rotor, (self.index,)  # its class has no name that another process could find


def weak_rotor(index: int) -> WeakRotor:
    """The effect of a certain rotor, counted from 0; named weak_rotor_1 for the first."""
    own = {"name": f"weak_rotor_{index + 1}", "index": index, "__doc__": WeakRotor.__doc__}
    return type(f"WeakRotor{index + 1}", (WeakRotor,), own)()


class VoltageExponent(Effect):
    """Thrust times (V / V_0)^size with the measured voltage V, V_0 its value at the start."""

    name, family, kind, unit, typical = "voltage_exponent", "thrust", "actuator", "-", 1.0
    also_looks_like = ("loss of thrust as motors warm", "falling mass")

    def needs(self, study: Study) -> str | None:
        if all(_VOLTAGE in run.command for run in study.runs):
            return None
        return f"the battery's voltage in every run (command {_VOLTAGE})"

    def apply(self, scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
        if _VOLTAGE not in run.command:
            raise ValueError(f"run {run.name}: voltage_exponent needs the command {_VOLTAGE}")
        voltage = torch.as_tensor(run.command[_VOLTAGE], dtype=torch.float64)
        share = torch.cat([voltage[:1], voltage])[:, None] / voltage[0]  # before the record, too
        return scene.with_command(lambda u, dt: u * share ** amount(size, 2))


class ThrustCurvature(Effect):
    """Thrust u (1 + size (u - u_0) / u_max) instead of u; u_0 what the rotors need in hover."""

    name, family, kind, unit, typical = "thrust_curvature", "thrust", "actuator", "-", 0.1
    also_looks_like = ("thrust gain at one load", "wrong exponent of the speed controller")

    def apply(self, scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
        vehicle = scene.vehicle
        hover = vehicle.mass[:, None, None] * GRAVITY / vehicle.num_rotors
        largest = vehicle.max_thrusts[:, None]
        return scene.with_command(lambda u, dt: u * (1.0 + amount(size, 2) * (u - hover) / largest))


class GroundEffectCause(Effect):
    """Thrust times 1 + size (radius / 4 height)^2 of each hub above level ground.

    To first order that of Cheeseman and Bennett (1955), 1 / (1 - (radius / 4 height)^2). The ground
    is at the height ``setup["terrain_height_m"]`` of the run, 0 by default.
    """

    name, family, kind, unit, typical = "ground_effect", "thrust", "environment", "-", 1.0
    signed = False
    also_looks_like = ("thrust gain at one height",)

    def apply(self, scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
        def cushion(motion: Motion, thrusts: Tensor) -> Tensor:
            vehicle = motion.vehicle
            radius = vehicle.radii[:, None, None]
            down = (
                by_rotor(motion.rotation[..., 2, :], vehicle.positions) + motion.position[..., 2:]
            )
            height = (-down - scene.terrain_height).maximum(_LEAST_HEIGHT * radius)
            return thrusts * (1.0 + amount(size, 3) * (radius / (4.0 * height)) ** 2)

        return scene.with_schedule(cushion)


COPTER: tuple[Callable[[], Effect], ...] = (
    RotorDragEffect,
    LinearDrag,
    ParasiticDrag,
    Wind,
    BodyTilt,
    VoltageExponent,
    CentreOfMass,
    GroundEffectCause,
    Inflow,
    Wake,
    ThrustCurvature,
    Gyroscopic,
    MarkerPlacement,
    ImuTilt,
    PositionScale,
    AccelerometerScale,
    GyroOffset,
)
