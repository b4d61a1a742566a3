"""Types of keys that are quantities, known or fitted; text with another unit is converted."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from diffsim.systems.description import Quantity, positive_quantity, quantity

if TYPE_CHECKING:
    Hertz: TypeAlias = Quantity
    Inertia: TypeAlias = Quantity
    Length: TypeAlias = Quantity
    Mass: TypeAlias = Quantity
    Moment: TypeAlias = Quantity
    PerSecond: TypeAlias = Quantity
    Plain: TypeAlias = Quantity
    Resistance: TypeAlias = Quantity
    Time: TypeAlias = Quantity
    Viscosity: TypeAlias = Quantity
else:
    Hertz = quantity("Hz")
    Inertia = quantity("kg m^2")
    Length = quantity("m")
    Mass = positive_quantity("kg")
    Moment = positive_quantity("kg m^2")
    PerSecond = quantity("1/s")
    Plain = quantity("-")
    Resistance = quantity("Pa s/m^3")
    Time = quantity("s")
    Viscosity = quantity("Pa s")

__all__ = [
    "Hertz",
    "Inertia",
    "Length",
    "Mass",
    "Moment",
    "PerSecond",
    "Plain",
    "Resistance",
    "Time",
    "Viscosity",
]
