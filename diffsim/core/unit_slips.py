"""Factors between units that are taken for each other: one list for records and for answers."""

from __future__ import annotations

import math
import re
from typing import NamedTuple


class UnitSlip(NamedTuple):
    """A factor between two units."""

    ratio: float  # number in the finer unit over that in the coarser one, above 1
    words: str  # what the factor is, such as "60/(2 pi) (rpm)"
    # coarse, fine: units that a number may have been read as; "": none is usual
    coarse: str = ""
    fine: str = ""
    of: tuple[str, ...] = ()  # SI units of what may be so, or parts of them; none: of all

    def suits(self, unit: str | None) -> bool:
        """Whether a quantity of a unit may be so; one of which no unit is stated may.

        Args:
            unit: SI unit, such as "rad/s".
        """
        if unit is None or not self.of:
            return True
        return bool({*self.of} & {unit, *re.split(r"[^A-Za-z]+", unit)})


RPM = 30.0 / math.pi
UNIT_SLIPS: tuple[UnitSlip, ...] = (
    UnitSlip(180.0 / math.pi, "180/pi (degrees)", "radians", "degrees", ("rad",)),
    UnitSlip(RPM, "60/(2 pi) (rpm)", "rad/s", "rpm", ("rad",)),
    UnitSlip(2.0 * math.pi, "2 pi (turns)", "turns", "radians", ("rad",)),
    UnitSlip(9.80665, "g", "kilograms-force", "newtons", ("N", "m/s^2")),
    UnitSlip(1000.0, "a thousand (milli or kilo)"),
    UnitSlip(100.0, "a hundred (centi or percent)"),
    UnitSlip(1e6, "a million (micro or mega)"),
    UnitSlip(25.4, "25.4 (inches)", "inches", "millimeters", ("m",)),
    UnitSlip(360.0, "360 (turns)", "turns", "degrees", ("rad",)),
    UnitSlip(RPM**2, "the square of 60/(2 pi) (rpm)", of=("rad",)),
)
"""In the order in which a factor that suits several is said."""

LESSER_SLIPS: tuple[UnitSlip, ...] = (
    UnitSlip(60.0, "60 (minutes)", "minutes", "seconds", ("s",)),
    UnitSlip(3600.0, "3600 (hours)", "hours", "seconds", ("s",)),
    UnitSlip(3.6, "3.6 (km/h)", "m/s", "km/h", ("m",)),
    UnitSlip(1.852, "1.852 (knots, km/h)", "knots", "km/h", ("m",)),
    UnitSlip(1.94384, "1.944 (knots, m/s)", "m/s", "knots", ("m",)),
    UnitSlip(3.28084, "3.281 (feet)", "meters", "feet", ("m",)),
    UnitSlip(4.44822, "4.448 (pounds of force)", "pounds", "newtons", ("N",)),
    UnitSlip(6894.76, "6895 (psi)", "psi", "pascals", ("Pa",)),
    UnitSlip(10.0, "ten (centi and milli)", "centimeters", "millimeters"),
)
"""Likewise, too near to what a gain may be: only where one run is held against others."""
