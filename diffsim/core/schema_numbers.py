"""Types of keys that are known numbers; text with another unit is converted."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from diffsim.core.schema import number

if TYPE_CHECKING:
    Degrees: TypeAlias = float
    DegreesPerSecond: TypeAlias = float
    Hertz: TypeAlias = float
    KilogramSquareMeters: TypeAlias = float
    Kilograms: TypeAlias = float
    KilogramsPerCubicMeter: TypeAlias = float
    Meters: TypeAlias = float
    MetersPerSecond: TypeAlias = float
    MetersPerSquareSecond: TypeAlias = float
    MilliampHours: TypeAlias = float
    Newtons: TypeAlias = float
    Ohms: TypeAlias = float
    Pascals: TypeAlias = float
    PerSecond: TypeAlias = float
    Radians: TypeAlias = float
    RadiansPerSecond: TypeAlias = float
    Ratio: TypeAlias = float
    Seconds: TypeAlias = float
    Volts: TypeAlias = float
    Watts: TypeAlias = float
else:
    Degrees = number("deg")
    DegreesPerSecond = number("deg/s")
    Hertz = number("Hz")
    KilogramSquareMeters = number("kg m^2")
    Kilograms = number("kg")
    KilogramsPerCubicMeter = number("kg/m^3")
    Meters = number("m")
    MetersPerSecond = number("m/s")
    MetersPerSquareSecond = number("m/s^2")
    MilliampHours = number("mA h")
    Newtons = number("N")
    Ohms = number("ohm")
    Pascals = number("Pa")
    PerSecond = number("1/s")
    Radians = number("rad")
    RadiansPerSecond = number("rad/s")
    Ratio = number("-")
    Seconds = number("s")
    Volts = number("V")
    Watts = number("W")
