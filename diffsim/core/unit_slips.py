"""Factors between units that are taken for each other: one list for records and for answers."""

from __future__ import annotations

import math
from typing import NamedTuple


class UnitSlip(NamedTuple):
    """A factor between two units.

    Attributes:
        ratio: Number in the finer unit over that in the coarser one, above 1.
        words: What the factor is, such as "60/(2 pi) (rpm)".
        coarse, fine: Units that a number may have been read as; "": none is usual.
    """

    ratio: float
    words: str
    coarse: str = ""
    fine: str = ""


RPM = 30.0 / math.pi
UNIT_SLIPS: tuple[UnitSlip, ...] = (
    UnitSlip(180.0 / math.pi, "180/pi (degrees)", "radians", "degrees"),
    UnitSlip(RPM, "60/(2 pi) (rpm)", "rad/s", "rpm"),
    UnitSlip(2.0 * math.pi, "2 pi (turns)", "turns", "radians"),
    UnitSlip(9.80665, "g", "kilograms-force", "newtons"),
    UnitSlip(1000.0, "a thousand (milli or kilo)"),
    UnitSlip(100.0, "a hundred (centi or percent)"),
    UnitSlip(1e6, "a million (micro or mega)"),
    UnitSlip(25.4, "25.4 (inches)", "inches", "millimeters"),
    UnitSlip(360.0, "360 (turns)", "turns", "degrees"),
    UnitSlip(RPM**2, "the square of 60/(2 pi) (rpm)"),
)
"""In the order in which a factor that suits several is said."""
