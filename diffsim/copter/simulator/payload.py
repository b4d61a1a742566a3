"""Loads: what a multicopter becomes with one, and how much it can carry."""

from __future__ import annotations

import torch
from scipy.optimize import brentq

from diffsim.copter.dynamics.control_metrics import max_hover_weight
from diffsim.copter.dynamics.hover import hover_thrusts
from diffsim.copter.simulator.outputs import MotorOutputs
from diffsim.copter.vehicle.battery import Battery
from diffsim.copter.vehicle.multicopter import GRAVITY, Multicopter
from diffsim.copter.vehicle.rotor import doubles
from diffsim.core.check import require_number
from diffsim.core.checked import checked


class PayloadError(ValueError):
    """A load that the vehicle cannot hold up.

    Attributes:
        limit: Largest payload [kg]; below 0: not even the vehicle itself.
    """

    def __init__(self, message: str, *, limit: float):
        super().__init__(message)
        self.limit = limit


@checked
def with_payload(vehicle: Multicopter, payload: float, *, drop: float = 0.05) -> Multicopter:
    """The vehicle with a point mass fixed below its center of mass.

    Args:
        vehicle: Without it.
        payload: Mass of the payload [kg].
        drop: Distance from the center of mass down to the load [m].

    Returns:
        The vehicle with mass, center of mass and inertia of both. Gradients: its tensors.
    """
    require_number("payload", payload, at_least=0.0)
    mass = vehicle.mass + payload
    load = vehicle.positions.new_tensor([0.0, 0.0, drop])
    shift = load * payload / mass  # of the center of mass
    reduced = vehicle.mass * payload / mass
    eye = torch.eye(3, dtype=torch.float64)
    inertia = vehicle.inertia + reduced * (load.dot(load) * eye - torch.outer(load, load))
    return vehicle.replace(mass=mass, inertia=inertia, positions=vehicle.positions - shift)


@checked
def payload_limit(
    vehicle: Multicopter, outputs: MotorOutputs, battery: Battery, *, charge: float = 1.0
) -> float:
    """Largest load at the center of mass that hovers within the pulse clamp [kg].

    The voltage is that under the current of the hover itself. At the limit nothing is left for
    control. Below 0: the vehicle alone is too heavy by that much.

    Args:
        vehicle: Without the load.
        outputs: Outputs of the vehicle's motors.
        battery: What feeds them.
        charge: State of charge of the battery, 0 to 1.
    """
    start, rated = doubles(charge), outputs.max_thrusts

    def lift(weight: float) -> float:
        """Largest weight at the voltage that hovering this weight leaves."""
        effort = hover_thrusts(vehicle.force_matrix, vehicle.torque_matrix, doubles(weight), rated)
        thrusts = effort.thrusts  # near the limit not exactly those of least effort
        power = outputs.power(thrusts)
        if 4.0 * battery.resistance * power > battery.open_circuit(start) ** 2:
            return 0.0  # more than the battery can give: the voltage would collapse
        current = battery.current_for_power(start, power)
        limits = outputs.limits(battery.voltage(start, current))
        return float(max_hover_weight(vehicle.replace(max_thrusts=limits)))

    with torch.no_grad():
        most = float(max_hover_weight(vehicle.replace(max_thrusts=rated)))
        low = 0.05 * most
        if lift(most) >= most:
            best = most
        else:
            best = brentq(lambda weight: lift(weight) - weight, low, most, xtol=1e-4)
    return best / GRAVITY - float(vehicle.mass)


def require_payload(
    vehicle: Multicopter, payload: float, outputs: MotorOutputs, battery: Battery
) -> None:
    """Refuse a load above the limit.

    Raises:
        PayloadError: names the limit.
    """
    limit = payload_limit(vehicle, outputs, battery)
    if payload <= limit:
        return
    clamp = f"with pulses of {outputs.pwm_max:g} us, rated thrusts and a full battery"
    if limit < 0.0:
        raise PayloadError(
            f"the design does not hover {clamp}: it is {-limit:.3f} kg too heavy; raise pwm_max, "
            "take stronger rotors or fewer parts",
            limit=limit,
        )
    raise PayloadError(
        f"payload must not exceed {limit:.3f} kg ({1e3 * limit:.0f} g) {clamp}, got "
        f"{payload:g} kg; at the limit nothing is left for control",
        limit=limit,
    )
