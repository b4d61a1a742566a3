"""Units as people write them, read by pint: ``mm``, ``m/s^2``, ``N m``, ``mbar``, ``deg``, ``rpm``.

The library itself works in SI units and radians; this module is the door through which numbers with
other units come in.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Any

from diffsim.core.check import did_you_mean

NO_UNIT = "-"
_COMMON = ("m", "mm", "kg", "g", "s", "ms", "N", "Pa", "kPa", "mbar", "rad", "deg", "rpm", "V", "A")
_SI = ("m", "s", "kg", "N", "Pa", "rad/s", "rad", "V", "A", "K", "Hz", "N m", "W", "m/s", "m/s^2")
_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")


@lru_cache(maxsize=1)
def _registry() -> Any:
    from pint import UnitRegistry  # a third of a second: only for those who write units

    registry: Any = UnitRegistry(autoconvert_offset_to_baseunit=True)
    registry.define("px = [picture]")
    return registry


@lru_cache(maxsize=512)
def _parsed(unit: str) -> Any:
    """Unit as pint has it.

    Raises:
        ValueError: nobody knows such a unit.
    """
    registry = _registry()
    text = unit.strip()
    if text in ("", NO_UNIT, "1"):
        return registry.dimensionless
    # "N m" and "Nm" are both written; pint reads a space as a product
    text = re.sub(r"(?<=[A-Za-z0-9)])\s+(?=[A-Za-z(])", "*", text.replace("·", "*"))
    for one, other in (("Nm", "N*m"), ("²", "^2"), ("³", "^3"), ("µ", "u")):
        text = text.replace(one, other)
    try:
        return registry.parse_units(text)
    except Exception as error:  # pint raises errors of its parser, of tokenize and of its own
        raise ValueError(
            f"unit {unit!r} is unknown{did_you_mean(unit, _COMMON)}; write it as in m/s^2, N m, "
            f"mbar, deg, or - for none"
        ) from error


def factor(unit: str, into: str) -> float:
    """Number of ``into`` in one ``unit``, such as 0.001 for mm into m.

    Args:
        unit: Unit that a number has, such as "mbar".
        into: Unit that it is wanted in, such as "Pa".

    Raises:
        ValueError: an unknown unit, or units of different quantities.
    """
    have, want = _parsed(unit), _parsed(into)
    if have.dimensionality != want.dimensionality:
        raise ValueError(f"unit {unit!r} is no unit of the quantity that is wanted in {into!r}")
    return float(_registry().Quantity(1.0, have).to(want).magnitude)


def si_unit(unit: str) -> str:
    """The SI unit for the quantity of a unit: "mbar" -> "Pa", "N m" stays.

    Args:
        unit: Unit as a user wrote it.

    Raises:
        ValueError: an unknown unit.
    """
    parsed = _parsed(unit)
    scale = _registry().Quantity(1.0, parsed).to_base_units()
    if scale.magnitude == 1.0 or parsed == _registry().pixel:
        return unit.strip() or NO_UNIT
    for known in _SI:
        if _parsed(known).dimensionality == parsed.dimensionality:
            return known
    return f"{scale.units:~C}".replace("**", "^")


def in_si(value: float | int | str, unit: str = NO_UNIT) -> tuple[float, str]:
    """A number, or a number with a unit as text, in SI, and the unit that it then has.

    Args:
        value: 0.003, or "3 mm".
        unit: Unit of a bare number.

    Raises:
        ValueError: not a number, or an unknown unit.
    """
    matched = _QUANTITY.fullmatch(str(value))
    own = matched.group(2) if matched is not None else ""
    into = si_unit(own or unit)
    return in_unit(value if own else f"{value} {unit}", into), into


def in_unit(value: float | int | str, unit: str) -> float:
    """A number, or a number with a unit as text, in a given unit.

    Args:
        value: 0.003, or "3 mm".
        unit: Unit of a bare number, and of the result.

    Raises:
        ValueError: not a number, an unknown unit, or one of another quantity.
    """
    if isinstance(value, bool):
        raise ValueError(f"must be a number in {unit}, got {value}")
    if isinstance(value, (int, float)):
        return float(value)
    matched = _QUANTITY.fullmatch(str(value))
    if matched is None:
        raise ValueError(f"must be a number in {unit}, or one with its unit, got {value!r}")
    number, own = matched.groups()
    return float(number) * (factor(own, unit) if own else 1.0)
