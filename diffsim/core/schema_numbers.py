"""Types of keys that are known numbers; text with another unit is converted."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from diffsim.core.schema import number

Degrees: TypeAlias = Annotated[float, number("deg")]
DegreesPerSecond: TypeAlias = Annotated[float, number("deg/s")]
Hertz: TypeAlias = Annotated[float, number("Hz")]
KilogramSquareMeters: TypeAlias = Annotated[float, number("kg m^2")]
Kilograms: TypeAlias = Annotated[float, number("kg")]
KilogramsPerCubicMeter: TypeAlias = Annotated[float, number("kg/m^3")]
Meters: TypeAlias = Annotated[float, number("m")]
MetersPerSecond: TypeAlias = Annotated[float, number("m/s")]
MetersPerSquareSecond: TypeAlias = Annotated[float, number("m/s^2")]
MilliampHours: TypeAlias = Annotated[float, number("mA h")]
Newtons: TypeAlias = Annotated[float, number("N")]
Ohms: TypeAlias = Annotated[float, number("ohm")]
Pascals: TypeAlias = Annotated[float, number("Pa")]
PerSecond: TypeAlias = Annotated[float, number("1/s")]
Radians: TypeAlias = Annotated[float, number("rad")]
RadiansPerSecond: TypeAlias = Annotated[float, number("rad/s")]
Ratio: TypeAlias = Annotated[float, number("-")]
Seconds: TypeAlias = Annotated[float, number("s")]
Volts: TypeAlias = Annotated[float, number("V")]
Watts: TypeAlias = Annotated[float, number("W")]
