"""Types of keys that are quantities, known or fitted; text with another unit is converted.

They are named by what they are, known numbers (``core/schema_numbers.py``) by their unit.
"""

from __future__ import annotations

from typing import Annotated, TypeAlias

from diffsim.systems.description import ABOVE_ZERO, Quantity, quantity_in

Acceleration: TypeAlias = Annotated[Quantity, quantity_in("m/s^2")]
Angle: TypeAlias = Annotated[Quantity, quantity_in("rad")]
Density: TypeAlias = Annotated[Quantity, quantity_in("kg/m^3")]
Force: TypeAlias = Annotated[Quantity, quantity_in("N")]
Frequency: TypeAlias = Annotated[Quantity, quantity_in("Hz")]
Inertia: TypeAlias = Annotated[Quantity, quantity_in("kg m^2")]
Length: TypeAlias = Annotated[Quantity, quantity_in("m")]
Mass: TypeAlias = Annotated[Quantity, quantity_in("kg")]
Pixels: TypeAlias = Annotated[Quantity, quantity_in("px")]
Plain: TypeAlias = Annotated[Quantity, quantity_in("-")]
PositiveDensity: TypeAlias = Annotated[Quantity, quantity_in("kg/m^3"), ABOVE_ZERO]
PositiveInertia: TypeAlias = Annotated[Quantity, quantity_in("kg m^2"), ABOVE_ZERO]
PositiveLength: TypeAlias = Annotated[Quantity, quantity_in("m"), ABOVE_ZERO]
PositiveMass: TypeAlias = Annotated[Quantity, quantity_in("kg"), ABOVE_ZERO]
PositivePressure: TypeAlias = Annotated[Quantity, quantity_in("Pa"), ABOVE_ZERO]
Pressure: TypeAlias = Annotated[Quantity, quantity_in("Pa")]
Rate: TypeAlias = Annotated[Quantity, quantity_in("1/s")]
Resistance: TypeAlias = Annotated[Quantity, quantity_in("Pa s/m^3")]
Speed: TypeAlias = Annotated[Quantity, quantity_in("m/s")]
Time: TypeAlias = Annotated[Quantity, quantity_in("s")]
Viscosity: TypeAlias = Annotated[Quantity, quantity_in("Pa s")]

# anywhere in the play, as likely; it matters only while there is one
START_IN_PLAY = Quantity(value=0.0, sd=0.6, lower=-1.0, upper=1.0, per="run").as_usual()
