"""A multicopter of numbers: the record, and a rotor of few facts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.distance import pdist

from diffsim.copter.vehicle.battery import LIPO_NOMINAL, Battery
from diffsim.copter.vehicle.multicopter import Multicopter
from diffsim.copter.vehicle.rotor import RotorModel
from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.core.inertia import size_mistake

AIR_DENSITY = 1.225  # [kg/m^3], standard atmosphere at sea level
# Thrust coefficient T / (rho n^2 D^4) of usual propellers of multirotors near hover, and the share
# of the electric power that ends in the ideal wake: propeller 0.65 times motor and controller 0.8.
USUAL_THRUST_COEFFICIENT = 0.11
USUAL_EFFICIENCY = 0.52
USUAL_TIME_CONSTANT = 0.03  # [s]
DEFAULT_CELLS = 3
FRD = np.diag([1.0, -1.0, -1.0])  # from forward, left, up: MJCF's, URDF's and SDF's
# Propellers do not overlap; builders leave about a tenth of the distance of two hubs free.
_RADIUS_PER_DISTANCE = 0.45


@checked(kinds_only=True)
@dataclass(frozen=True, eq=False)
class FlyingVehicle:
    """A multicopter with all that a flight in closed loop needs.

    Attributes:
        name: What logs and pictures call it.
        vehicle: For the layers: ``fly``, ``hover``, ``lqr`` and others.
        rotors: One model per rotor.
        battery: None: not said.
        center_of_mass: In the file's frame, turned to forward, right, down, (3,) [m].
    """

    name: str
    vehicle: Multicopter
    rotors: tuple[RotorModel, ...]
    battery: Battery | None
    center_of_mass: Array

    @property
    def assumed(self) -> tuple[str, ...]:
        """What the file does not say and usual values stand in for, such as "time_constant"."""
        names = [name for rotor in self.rotors for name in rotor.assumed]
        return tuple(dict.fromkeys([*names, *(["battery"] if self.battery is None else [])]))


@dataclass(frozen=True, eq=False)
class Body:
    """Mass properties, and places by name."""

    mass: float  # mass [kg]
    inertia: Array  # about the center of mass, (3, 3) [kg m^2]
    center_of_mass: Array  # center of mass, (3,) [m]
    places: dict[str, Array]  # position of each link, body or site, (3,) [m]
    axes: dict[str, Array]  # their z axes, (3,)


def usual_radius(places: Array) -> float:
    """Radius of propellers at such hubs, as builders choose it [m].

    Args:
        places: Of two rotors or more, (n_rotors, 3) [m].
    """
    return _RADIUS_PER_DISTANCE * float(pdist(places).min())


def assembled(
    body: Body,
    turn: Array,
    places: Sequence[Array],
    axes: Sequence[Array],
    spins: Sequence[float],
    rotors: tuple[RotorModel, ...],
    battery: Battery | None,
    name: str,
    source: str,
) -> FlyingVehicle:
    """The record that the layers take, of a body and its rotors in the file's frame.

    Args:
        body: Mass properties.
        turn: From the file's frame to forward, right, down, (3, 3).
        places: Of the rotors, (3,) each [m].
        axes: Directions of thrust, (3,) each.
        spins: +1 clockwise seen against the thrust, else -1.
        battery: None: not said.
        name: What logs and pictures call it.
        source: What messages call the file.

    Raises:
        ValueError: values that no body has, with ``source``.
    """

    def numbers(attribute: str) -> torch.Tensor:
        return torch.tensor([float(getattr(r, attribute)) for r in rotors], dtype=torch.float64)

    for rotor in rotors:
        if rotor.torque_ratio is None:
            raise ValueError(
                f"{source}: the torque of {rotor.name} was not measured; give radius, max_thrust "
                "and torque_ratio in place of model"
            )
    inertia = turn @ body.inertia @ turn.T
    positions = (np.array(places) - body.center_of_mass) @ turn.T
    reach = float(np.max(np.linalg.norm(positions, axis=1) + [float(r.radius) for r in rotors]))
    if mistake := size_mistake(body.mass, inertia, reach):
        raise ValueError(f"{source}: {mistake}")
    try:
        vehicle = Multicopter(
            mass=torch.tensor(float(body.mass), dtype=torch.float64),
            inertia=torch.as_tensor(inertia, dtype=torch.float64),
            positions=torch.as_tensor(positions, dtype=torch.float64),
            directions=torch.as_tensor(np.array(axes) @ turn.T, dtype=torch.float64),
            spins=torch.tensor(spins, dtype=torch.float64),
            torque_ratios=numbers("torque_ratio"),
            max_thrusts=numbers("max_thrust"),
            radii=numbers("radius"),
            rotor_models=tuple(r.name for r in rotors),
        )
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error
    return FlyingVehicle(name, vehicle, rotors, battery, turn @ body.center_of_mass)


def own_rotor(
    *,
    radius: float,
    max_thrust: float,
    torque_ratio: float,
    cells: int = DEFAULT_CELLS,
    thrust_exponent: float = 2.0,
    max_speed: float | None = None,
    time_constant: float | None = None,
    assumed: Sequence[str] = (),
) -> RotorModel:
    """A rotor of few facts; what is missing is usual for its size, and listed in ``assumed``.

    The speed at full signal follows from T = C_T rho n^2 D^4, the current from the ideal power of a
    hovering rotor, P = T^1.5 / sqrt(2 rho A), over a usual efficiency (Leishman, Principles of
    Helicopter Aerodynamics, 2006, ch. 2).

    Its name is that of its kind: rotors that share it go through their model together.

    Args:
        radius: Of the propeller [m].
        max_thrust: At full signal and nominal voltage [N].
        torque_ratio: Reaction torque over thrust [m].
        cells: Of the battery in series, whose nominal voltage max_thrust is for.
        max_speed: At full signal [rad/s]; None: usual.
        time_constant: Lag of the thrust [s]; None: usual.
        assumed: What the caller assumed of these.
    """
    name = f"{1e3 * radius:.0f} mm, {max_thrust:g} N"
    name += "" if max_speed is None else f" at {max_speed:g} rad/s"
    name += f", {torque_ratio:g} m" + ("" if time_constant is None else f", {time_constant:g} s")
    name += "" if thrust_exponent == 2.0 else f", exponent {thrust_exponent:g}"
    nominal_voltage = cells * LIPO_NOMINAL
    lacking = [*assumed, "current_coefficient", "speed_exponent"]
    if max_speed is None:
        turns = np.sqrt(max_thrust / (USUAL_THRUST_COEFFICIENT * AIR_DENSITY * (2.0 * radius) ** 4))
        max_speed = float(2.0 * np.pi * turns)
        lacking.append("thrust_coefficient")
    if time_constant is None:
        time_constant = USUAL_TIME_CONSTANT
        lacking.append("time_constant")
    wake = np.sqrt(2.0 * AIR_DENSITY * np.pi * radius**2)
    return RotorModel(
        name=name,
        radius=radius,
        thrust_coefficient=max_thrust / max_speed**thrust_exponent,
        thrust_exponent=thrust_exponent,
        thrust_offset=0.0,
        torque_ratio=torque_ratio,
        max_thrust=max_thrust,
        current_coefficient=float(1.0 / (USUAL_EFFICIENCY * wake * nominal_voltage)),
        current_exponent=1.5,
        current_offset=0.0,
        nominal_voltage=nominal_voltage,
        duty_offset=0.0,
        speed_coefficient=max_speed / nominal_voltage,
        speed_exponent=1.0,
        time_constant=time_constant,
        assumed=tuple(sorted({*lacking})),
    )
