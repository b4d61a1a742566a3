"""Propellers with motors: what the parts need of a rotor's model.

``kde2814_10in`` and ``kde2814_14in`` carry the numbers of the public bench tables (torque ratio and
greatest thrust as the public tool fits them). The other two sizes were never measured: their
numbers are the power laws in the diameter through the two measured ones, exponents
log(0.016855/0.014664)/log 1.4 = 0.414 for the torque ratio and 1.428 for the thrust.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from diffsim._check import require_choice


@dataclass(frozen=True)
class RotorData:
    """A propeller with its motor.

    Attributes:
        name: Of the rotor's model.
        radius: Of the propeller [m].
        torque_ratio: lambda, torque per thrust [m].
        max_thrust: u_max [N].
        motor_mass: Motor with its mounting ring [kg].
        propeller_mass: [kg].
        motor_price, propeller_price: [EUR].
        measured: Whether torque ratio and thrust come from a bench.
    """

    name: str
    radius: float
    torque_ratio: float
    max_thrust: float
    motor_mass: float = 0.149718705946  # of the public tool's motor
    propeller_mass: float = 0.01
    motor_price: float = 70.0
    propeller_price: float = 5.0
    measured: bool = True


_TEN = RotorData("kde2814_10in", 0.127, 0.014663975250, 7.2182, propeller_mass=0.011)
_FOURTEEN = RotorData(
    "kde2814_14in", 0.1778, 0.0168552041004, 11.672, propeller_mass=0.022, propeller_price=9.0
)


def _estimated(name: str, radius: float, propeller_mass: float, price: float) -> RotorData:
    """Between the measured sizes by power laws in the radius."""
    ratio = radius / _TEN.radius
    between = {
        key: getattr(_TEN, key) * ratio ** _exponent(getattr(_FOURTEEN, key) / getattr(_TEN, key))
        for key in ("torque_ratio", "max_thrust")
    }
    return RotorData(
        name,
        radius,
        **between,
        propeller_mass=propeller_mass,
        propeller_price=price,
        measured=False,
    )


def _exponent(growth: float) -> float:
    return math.log(growth) / math.log(_FOURTEEN.radius / _TEN.radius)


ROTORS = {
    rotor.name: rotor
    for rotor in (
        _TEN,
        _FOURTEEN,
        _estimated("kde2814_8in", 0.1016, 0.007, 4.0),
        _estimated("kde2814_12in", 0.1524, 0.016, 7.0),
    )
}


def rotor_data(name: str) -> RotorData:
    """The propeller and motor of this name.

    Raises:
        ValueError: unknown name; the message offers the closest ones.
    """
    return ROTORS[require_choice("rotor", name, ROTORS)]
