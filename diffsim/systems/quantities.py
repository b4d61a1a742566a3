"""Types of keys that are quantities, known or fitted; text with another unit is converted.

They are named by what they are, known numbers (``core/schema_numbers.py``) by their unit. A type
checker, which cannot read a call in an annotation, sees what a key holds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from diffsim.systems.description import Quantity, positive_quantity, quantity

if TYPE_CHECKING:
    Acceleration: TypeAlias = Quantity
    Angle: TypeAlias = Quantity
    Density: TypeAlias = Quantity
    Force: TypeAlias = Quantity
    Frequency: TypeAlias = Quantity
    Inertia: TypeAlias = Quantity
    Length: TypeAlias = Quantity
    Mass: TypeAlias = Quantity
    Pixels: TypeAlias = Quantity
    Plain: TypeAlias = Quantity
    PositiveDensity: TypeAlias = Quantity
    PositiveInertia: TypeAlias = Quantity
    PositiveLength: TypeAlias = Quantity
    PositiveMass: TypeAlias = Quantity
    PositivePressure: TypeAlias = Quantity
    Pressure: TypeAlias = Quantity
    Rate: TypeAlias = Quantity
    Resistance: TypeAlias = Quantity
    Speed: TypeAlias = Quantity
    Time: TypeAlias = Quantity
    Viscosity: TypeAlias = Quantity
else:
    Acceleration = quantity("m/s^2")
    Angle = quantity("rad")
    Density = quantity("kg/m^3")
    Force = quantity("N")
    Frequency = quantity("Hz")
    Inertia = quantity("kg m^2")
    Length = quantity("m")
    Mass = quantity("kg")
    Pixels = quantity("px")
    Plain = quantity("-")
    PositiveDensity = positive_quantity("kg/m^3")
    PositiveInertia = positive_quantity("kg m^2")
    PositiveLength = positive_quantity("m")
    PositiveMass = positive_quantity("kg")
    PositivePressure = positive_quantity("Pa")
    Pressure = quantity("Pa")
    Rate = quantity("1/s")
    Resistance = quantity("Pa s/m^3")
    Speed = quantity("m/s")
    Time = quantity("s")
    Viscosity = quantity("Pa s")

# anywhere in the play, as likely; it matters only while there is one
START_IN_PLAY = Quantity(value=0.0, sd=0.6, lower=-1.0, upper=1.0, per="run").as_usual()
