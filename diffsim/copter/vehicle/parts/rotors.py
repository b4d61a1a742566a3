"""Propellers with motors: what the parts need of a rotor's model, masses and prices.

Radius, torque ratio and greatest thrust of ``kde2814_10in`` and ``kde2814_14in`` are those of the
models fitted to the public bench tables (``diffsim.copter.vehicle.rotor``). The other two sizes
were never measured: their numbers are the power laws in the diameter through the two measured ones,
exponents 0.414 for the torque ratio and 1.428 for the thrust.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

from diffsim.copter.vehicle.rotor import rotor_model
from diffsim.core.check import require_choice
from diffsim.core.checked import checked


@checked
@dataclass(frozen=True)
class RotorData:
    """A propeller with its motor.

    Attributes:
        name: Name of the rotor's model.
        radius: Radius of the propeller [m].
        torque_ratio: lambda, torque per thrust [m].
        max_thrust: u_max [N].
        motor_mass: Motor with its mounting ring [kg].
        propeller_mass: Mass of the propeller [kg].
        motor_price, propeller_price: [EUR].
        measured: Whether torque ratio and thrust come from a bench.
    """

    name: str
    radius: float
    torque_ratio: float
    max_thrust: float
    motor_mass: float
    propeller_mass: float
    motor_price: float
    propeller_price: float
    measured: bool


MOTOR_MASS = 0.149718705946  # of the public tool's motor [kg]
MOTOR_PRICE = 70.0  # [EUR]
_MEASURED = ("kde2814_10in", "kde2814_14in")
_ESTIMATED = {"kde2814_8in": 0.1016, "kde2814_12in": 0.1524}  # radius [m]
_PROPELLERS = {  # mass [kg], price [EUR]
    "kde2814_8in": (0.007, 4.0),
    "kde2814_10in": (0.011, 5.0),
    "kde2814_12in": (0.016, 7.0),
    "kde2814_14in": (0.022, 9.0),
}
ROTOR_NAMES = tuple(_PROPELLERS)


@checked
@cache
def rotor_data(name: str) -> RotorData:
    """The propeller and motor of this name.

    Raises:
        ValueError: unknown name; the message offers the closest ones.
    """
    mass, price = _PROPELLERS[require_choice("rotor", name, ROTOR_NAMES)]
    radius = _ESTIMATED.get(name)
    physics = {
        key: _value(name, key) if radius is None else _between(key, radius)
        for key in ("torque_ratio", "max_thrust")
    }
    return RotorData(
        name=name,
        radius=_value(name, "radius") if radius is None else radius,
        **physics,
        motor_mass=MOTOR_MASS,
        propeller_mass=mass,
        motor_price=MOTOR_PRICE,
        propeller_price=price,
        measured=radius is None,
    )


def _value(name: str, key: str) -> float:
    return float(getattr(rotor_model(name), key))


def _between(key: str, radius: float) -> float:
    """On the power law in the radius through the two measured sizes."""
    (r0, y0), (r1, y1) = ((_value(n, "radius"), _value(n, key)) for n in _MEASURED)
    return y0 * (radius / r0) ** (math.log(y1 / y0) / math.log(r1 / r0))
