"""Types of keys that are known numbers; text with another unit is converted."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from diffsim.core.schema import number

if TYPE_CHECKING:
    Acceleration: TypeAlias = float
    Angle: TypeAlias = float
    Density: TypeAlias = float
    Kilograms: TypeAlias = float
    Meters: TypeAlias = float
    MilliampHours: TypeAlias = float
    Newtons: TypeAlias = float
    Ohms: TypeAlias = float
    Pascals: TypeAlias = float
    PerSecond: TypeAlias = float
    Rate: TypeAlias = float
    Ratio: TypeAlias = float
    Seconds: TypeAlias = float
    ShearRate: TypeAlias = float
    Volts: TypeAlias = float
else:
    Acceleration = number("m/s^2")
    Angle = number("rad")
    Density = number("kg/m^3")
    Kilograms = number("kg")
    Meters = number("m")
    MilliampHours = number("mA h")
    Newtons = number("N")
    Ohms = number("ohm")
    Pascals = number("Pa")
    PerSecond = number("Hz")
    Rate = number("rad/s")
    Ratio = number("-")
    Seconds = number("s")
    ShearRate = number("1/s")
    Volts = number("V")

__all__ = [
    "Acceleration",
    "Angle",
    "Density",
    "Kilograms",
    "Meters",
    "MilliampHours",
    "Newtons",
    "Ohms",
    "Pascals",
    "PerSecond",
    "Rate",
    "Ratio",
    "Seconds",
    "ShearRate",
    "Volts",
]
