"""Units as people write them: ``mm``, ``m/s^2``, ``N m``, ``mbar``, ``deg``, ``rpm``.

They are taken apart by a grammar of their own, and pint is asked for single names::

    product  = power {[* / · . per] power}           a blank multiplies
    power    = (name | 1 | "(" product ")") [(^ | **) exponent]
    exponent = [+ -] one or two digits [.5], in brackets or not; superscript digits

Nothing is evaluated but sums of exponents, so that no text takes long.

The library itself works in SI units and radians; this module is the door through which numbers with
other units come in.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

GRAVITY = 9.81  # acceleration of free fall [m/s^2]
NO_UNIT = "-"
_RELATIVE = (NO_UNIT, "", "command", "channel")  # units that say nothing after a number
_COMMON = ("m", "mm", "kg", "g", "s", "ms", "N", "Pa", "kPa", "mbar", "rad", "deg", "rpm", "V", "A")
_LARGEST = 1e100  # of a unit in SI units, and of its inverse: the square has room in float64
LONGEST = 100  # letters of a unit; the longest in common use has some forty
LARGEST_POWER = 99
_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁺", "0123456789-+")
_RAISED = re.compile("[⁺⁻]?[⁰¹²³⁴⁵⁶⁷⁸⁹]+")
_LETTER = "A-Za-z_%°µμΩΩÅ"
_TOKEN = re.compile(rf"\s*(\*\*|[*/^()·⋅.]|1(?![\w.])|[{_LETTER}][{_LETTER}0-9]*)\s*")
_EXPONENT = re.compile(r"\s*(\()?\s*([+-]?[0-9]{1,2}(?:\.5)?)(?![0-9.])\s*(?(1)\)|)\s*")
_DIGIT_IS_POWER = re.compile(r"(m|mm|cm|km|s)([234])")  # "m/s2" and "mm3" are written, too
#: Products without a blank: Nm, Nms, Vs, and kgm^2 with its power; pint has textile numbers, Nm,
#: and milliseconds
_GLUED_NAMES = re.compile(
    r"(?<![A-Za-z])(?:([kmucM]?N)(m|cm|mm)(s?)|([kmu]?[NVA])(s)()|(k?g)(m|cm|mm)()(?=\^?\d))"
    r"(\d|\^-?\d+)?(?![A-Za-z0-9])"
)
#: Torques with a dash, as makers of motors write them: N-m, kg-cm, oz-in, ft-lbs; no momentum
_DASHED_TORQUE = re.compile(
    r"(?<![A-Za-z0-9-])(?:(k?gf?|oz|lbf?|[kmucM]?N)-(in|ft|cm|mm|m)|(in|ft)-(oz|lbf?)s?)"
    r"(?![A-Za-z0-9^-])(?!\s*/\s*s)"
)
#: A temperature in two words, deg C and degrees Celsius: no angle times a charge
_TEMPERATURE = re.compile(
    r"(?<![A-Za-z])(?:deg(?:ree)?s?\.?|°)\s+(c|f)(?:elsius|ahrenheit)?(?![A-Za-z])", re.I
)
_WEIGHTS = {"g": "gf", "kg": "kgf", "oz": "ozf", "lb": "lbf"}  # of such a product
#: Powers without a mark, as in "m s-1" and "kg m-3"; alone, "A-1" is a label
_BARE_POWER = re.compile(r"(?<=[A-Za-z])-(?=\d(?!\d))")
_ALONE = ("s-1", "min-1", "h-1")
_SPELLED = {"°C": "degC", "°F": "degF", "°": "deg"}
_DIVIDES, _TIMES = ("/", "per"), ("*", "·", "⋅", ".")  # "N.m" is written in France
#: Symbols of names that are spelled out, or abbreviated otherwise
_SYMBOLS = {
    "meter": "m", "second": "s", "kilogram": "kg", "ampere": "A", "kelvin": "K", "radian": "rad",
    "newton": "N", "pascal": "Pa", "joule": "J", "watt": "W", "volt": "V", "ohm": "ohm",
    "hertz": "Hz", "tesla": "T", "coulomb": "C", "henry": "H", "farad": "F", "lux": "lx",
}  # fmt: skip
_SI_FACTOR = rf"(?:{'|'.join(_SYMBOLS.values())})(?:\^\d)?"
_SI = re.compile(rf"-|(?:1|{_SI_FACTOR}(?: {_SI_FACTOR})*)(?:/{_SI_FACTOR})?")  # as SI writes it
#: Words that are units, with their plurals; no symbol is one, whose case has a meaning
_WORDS = frozenset(
    word + end
    for word in (*_SYMBOLS, "gram", "degree", "minute", "hour", "liter", "bar", "amp", "celsius")
    for end in ("", "s")
)
_ROTATIONS = re.compile(r"(tr|u|umdr|об)\s*/\s*(min|мин)", re.I)  # tours, Umdrehungen, oboroty
#: Symbols in Cyrillic letters, GOST 8.417; a prefix is the letter before
_GOST = {
    "мин": "min", "рад": "rad", "град": "deg", "Гц": "Hz", "Па": "Pa", "Вт": "W", "Дж": "J",
    "Ом": "ohm", "кг": "kg", "мк": "u", "с": "s", "м": "m", "Н": "N", "В": "V", "А": "A", "г": "g",
    "к": "k", "М": "M", "К": "K",
}  # fmt: skip
_CYRILLIC = re.compile("|".join(_GOST))
_LONGEST = 2 * LONGEST  # letters of a number with its unit
#: Coherent SI units by what pint makes of them; others are spelled out in base units.
_COHERENT = {
    "dimensionless": NO_UNIT,
    "kilogram * meter / second ** 2": "N",
    "kilogram / meter / second ** 2": "Pa",
    "kilogram * meter ** 2 / second ** 2": "N m",
    "kilogram * meter ** 2 / second ** 3": "W",
    "kilogram * meter ** 2 / ampere / second ** 3": "V",
    "kilogram * meter ** 2 / ampere ** 2 / second ** 3": "ohm",
    "kilogram / second ** 2": "N/m",
    "kilogram / second": "N s/m",
    "1 / second": "Hz",
}
#: Names of recordings and data sheets that pint lacks or takes for others, pct as 2e-16 kg, cts as
#: carats, points of an encoder as a printer's; pulses and steps are counts
_AS_LOGS_WRITE = (
    "px = [picture]",
    "@alias turn = rev = revs",
    "@alias revolutions_per_minute = RPM",
    "@alias count = tick = ticks = LSB = pulse = pulses = step = steps = cts = inc = points = pts",
    "@alias percent = pct",
    "@alias ampere = amps",
    "dps = degree / second",
    "lpm = liter / minute = LPM",
)
_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")


@lru_cache(maxsize=1)
def _registry() -> Any:
    from pint import UnitRegistry  # a third of a second: only for those who write units

    registry: Any = UnitRegistry(
        autoconvert_offset_to_baseunit=True,
        on_redefinition="ignore",  # px is a pixel of a picture, not 1/96 inch of a style sheet
    )
    for written in _AS_LOGS_WRITE:
        registry.define(written)
    return registry


@lru_cache(maxsize=512)
def _parse_unit(unit: str) -> Any:
    """Unit as pint has it.

    Raises:
        ValueError: nobody knows such a unit.
    """
    text = unit.strip()
    if text == NO_UNIT:
        text = "1"
    if _ROTATIONS.fullmatch(text):
        text = "rpm"
    if text.lower() in ("slm", "slpm", "sccm"):  # pint makes watts of the first
        raise ValueError(
            f"unit {unit!r} is unknown: a standard flow is a mass flow; write it in kg/s, or as "
            "L/min of the gas as it was"
        )
    if text.lower() == "grad":  # pint has gons and, of "Grad", 1e9 rad; a German degree is neither
        raise ValueError(f"unit {unit!r} is unknown; write deg for degrees, gon for gradians")
    from pint import PintError

    try:
        return _unit_of(powers_of(text or "1"))
    except (ValueError, PintError) as error:
        from diffsim.core.check import did_you_mean  # brings torch, which `info` does without

        shown = text if len(text) <= LONGEST else f"{text[:20]}..."
        why = f" ({error})" if isinstance(error, ValueError) else did_you_mean(shown, _COMMON)
        raise ValueError(
            f"unit {shown!r} is unknown{why}; write it as in m/s^2, N m, mbar, deg, or - for none"
        ) from error


def _unit_of(powers: Mapping[str, float]) -> Any:
    """The unit of pint, which is asked for single names alone: it would evaluate 9**9**9."""
    registry = _registry()
    is_alone = list(powers.values()) == [1]
    made: dict[str, float] = {}
    for said, power in powers.items():
        name = registry.get_name(said)
        if not _is_straight(name):
            raise ValueError(f"{said} is logarithmic; convert such numbers first")
        difference = f"delta_{name}"  # W/degC is one of differences
        name = difference if not is_alone and difference in registry else name
        made[name] = made.get(name, 0) + power
    made.pop("", None)  # of dimensionless
    return registry.Unit(registry.UnitsContainer(made))


def _is_straight(name: str) -> bool:
    """Whether a factor and an offset lead into SI units; to what decibels stand for, none do."""
    at = [_registry().Quantity(v, name).to_base_units().magnitude for v in (0.0, 1.0, 2.0)]
    return math.isclose(at[2] - at[1], at[1] - at[0], rel_tol=1e-9)


def powers_of(text: str) -> Mapping[str, float]:
    """Names of a unit and the powers that they are raised to.

    Args:
        text: Such as "m/s^2".

    Returns:
        Power by name, whole or a half, at most 99; names whose power is 0 are kept.

    Raises:
        ValueError: it is longer than ``LONGEST``, or no product of powers of names; it says why,
            without the text.
    """
    if len(text) > LONGEST:
        raise ValueError(f"a unit has at most {LONGEST} letters, got {len(text)}")
    text = _CYRILLIC.sub(lambda m: _GOST[m[0]], text)
    text = _RAISED.sub(lambda m: "^" + m[0].translate(_SUPERSCRIPTS), text)
    if " " in text.strip() or text.strip() in _ALONE:
        text = _BARE_POWER.sub("^-", text)
    text = _TEMPERATURE.sub(lambda m: f"deg{m[1].upper()}", text)
    text = _DASHED_TORQUE.sub(_torque, text)
    reader = _Reader(_GLUED_NAMES.sub(_product, text))
    powers = reader.product()
    if reader.at < len(reader.text):
        raise reader.error()
    if beyond := [p for p in powers.values() if abs(p) > LARGEST_POWER]:
        raise ValueError(f"powers go up to {LARGEST_POWER}, got {beyond[0]:g}")
    return powers


def _torque(matched: re.Match[str]) -> str:
    names = filter(None, matched.groups())
    return f"({' '.join(_WEIGHTS.get(name, name) for name in names)})"


def _product(matched: re.Match[str]) -> str:
    *names, power = matched.groups("")
    return f"({' '.join(filter(None, names))}{power})"


class _Reader:
    """One walk over the text."""

    def __init__(self, text: str):
        self.text, self.at = text, 0

    def product(self) -> Counter[str]:
        powers = self.power()
        while (token := self._peek()) not in ("", ")", "^", "**"):
            if token in _DIVIDES or token in _TIMES:
                self._take()
            sign = -1 if token in _DIVIDES else 1
            for name, power in self.power().items():
                powers[name] += sign * power
        return powers

    def power(self) -> Counter[str]:
        token = self._take()
        if token == "(":
            powers = self.product()
            if self._take() != ")":
                raise self.error()
        elif token == "1":
            powers = Counter()
        elif token and (token[0].isalpha() or token[0] in "_%°") and token not in _DIVIDES:
            powers = _powers_of_name(token)
        else:
            raise self.error()
        if self._peek() not in ("^", "**"):
            return powers
        self._take()
        matched = _EXPONENT.match(self.text, self.at)
        if matched is None:
            raise self.error()
        self.at = matched.end()
        exponent = float(matched[2]) if "." in matched[2] else int(matched[2])
        return Counter({name: power * exponent for name, power in powers.items()})

    def error(self) -> ValueError:
        at = min(self.at, len(self.text) - 1)
        return ValueError(
            f"column {at + 1}: a unit is names, *, /, brackets, and powers of one or two digits"
        )

    def _peek(self) -> str:
        matched = _TOKEN.match(self.text, self.at)
        return "" if matched is None else matched[1]

    def _take(self) -> str:
        matched = _TOKEN.match(self.text, self.at)
        if matched is None:
            return ""
        self.at = matched.end()
        return matched[1]


def _powers_of_name(name: str) -> Counter[str]:
    name = name.replace("µ", "u").replace("μ", "u").replace("Ohm", "ohm")
    name = _SPELLED.get(name, name)
    if raised := _DIGIT_IS_POWER.fullmatch(name):
        return Counter({raised[1]: int(raised[2])})
    if name[:1].isupper() and name[1:].islower() and name.lower() in _WORDS:  # Meters
        name = name.lower()
    return Counter([name])


def factor(unit: str, into: str) -> float:
    """Number of ``into`` in one ``unit``, such as 0.001 for mm into m; of differences: a kelvin is
    one degree Celsius.

    Args:
        unit: Unit that a number has, such as "mbar".
        into: Unit that it is wanted in, such as "Pa".

    Raises:
        ValueError: an unknown unit, or units of different quantities.
    """
    have, want = _parse_unit(unit), _parse_unit(into)
    if have.dimensionality != want.dimensionality:
        raise ValueError(f"unit {unit!r} is no unit of the quantity that is wanted in {into!r}")
    ours, theirs = to_si(unit), to_si(into)
    if ours.offset or theirs.offset:
        return ours.factor / theirs.factor
    return float(_registry().Quantity(1.0, have).to(want).magnitude)


class SI(NamedTuple):
    """SI unit of a quantity, and the way to it: value_SI = factor value + offset."""

    unit: str  # coherent SI unit, radians for angles, pixels for places in pictures
    factor: float  # number of ``unit`` in one of the unit that was asked for
    offset: float  # value in ``unit`` of a zero; not 0 for degrees Celsius only


@lru_cache(maxsize=512)
def to_si(unit: str) -> SI:
    """SI unit of the quantity that a unit measures; a coherent one is kept, in SI's own symbols.

    Args:
        unit: Unit as people write it, such as "mm", "rpm", "mbar", "N m".

    Raises:
        ValueError: an unknown unit.
    """
    parsed = _parse_unit(unit)
    try:
        zero = _registry().Quantity(0.0, parsed).to_base_units()
        one = _registry().Quantity(1.0, parsed).to_base_units()
        offset = float(zero.magnitude)
        size = float(one.magnitude) - offset
    except OverflowError:
        size = math.inf
    if not 1.0 / _LARGEST <= abs(size) <= _LARGEST:
        raise ValueError(
            f"unit {unit!r} must lie between {1.0 / _LARGEST:g} and {_LARGEST:g} of its SI unit; "
            "look at its powers"
        )
    if size == 1.0 and offset == 0.0:
        short = unit.strip() or NO_UNIT
        return SI(short if _SI.fullmatch(short) else _in_symbols(short), 1.0, 0.0)
    name = str(one.units)
    short = f"{one.units:~}".replace(" ** ", "^").replace(" * ", " ").replace(" / ", "/")
    return SI(_COHERENT.get(name, short), size, offset)


def _in_symbols(unit: str) -> str:
    """A unit as SI writes it, so that "meters/sec", "m s-1" and "m/s" are one; with brackets it is
    kept as it is."""
    if "(" in unit:
        return unit
    over, under = list[str](), list[str]()
    for name, power in powers_of(unit).items():
        symbol = _SYMBOLS.get(_registry().get_name(name), name)
        raised = symbol if abs(power) == 1 else f"{symbol}^{abs(power):g}"
        if power:
            (over if power > 0 else under).append(raised)
    return "/".join([" ".join(over) or "1", *under]) if over or under else unit


def in_si(
    value: float | int | str, unit: str = NO_UNIT, *, difference: bool = False
) -> tuple[float, str]:
    """A number, or a number with a unit as text, in SI, and the unit that it then has.

    Args:
        value: 0.003, "3 mm", or "22 degC", which are 295.15 K.
        difference: Whether it is one, such as a standard deviation: 2 degC are 2 K then.

    Raises:
        ValueError: not a number, or an unknown unit.
    """
    matched = _match_quantity(value)
    if matched is None or isinstance(value, bool) or matched.group(2).startswith(","):
        comma = "; use a decimal point" if matched and matched.group(2).startswith(",") else ""
        raise ValueError(f"must be a number, or one with its unit, got {value!r}{comma}")
    si = to_si(matched.group(2) or unit)
    return si.factor * float(matched.group(1)) + (0.0 if difference else si.offset), si.unit


def in_unit(value: float | int | str, unit: str, *, difference: bool = False) -> float:
    """A number, or a number with a unit as text, in a given unit.

    Args:
        value: 0.003, or "3 mm".
        unit: Unit of a bare number, and of the result.
        difference: Whether it is one, such as a standard deviation: 2 degC are 2 K then.

    Raises:
        ValueError: not a number, an unknown unit, or one of another quantity.
    """
    if isinstance(value, bool):
        raise ValueError(f"must be a number in {unit}, got {value}")
    if isinstance(value, (int, float)):
        return float(value)
    matched = _match_quantity(value)
    if matched is None:
        raise ValueError(f"must be a number in {unit}, or one with its unit, got {value!r}")
    number, own = matched.groups()
    if not own:
        return float(number)
    scale, ours, theirs = factor(own, unit), to_si(own), to_si(unit)
    shift = 0.0 if difference else (ours.offset - theirs.offset) / theirs.factor
    return float(number) * scale + shift


def _match_quantity(value: float | int | str) -> re.Match[str] | None:
    """Number and unit; the pattern would walk a text without end for as long as its square."""
    text = str(value)
    if len(text) > _LONGEST:
        raise ValueError(f"must be a number, or one with its unit, got {len(text):,} letters")
    return _QUANTITY.fullmatch(text)


SMALL = 0.1  # what is below is read in the first smaller unit that keeps it above, else in the last
#: What takes a prefix, alone or per second; a damping or a stiffness keeps the unit of its formula.
_TAKES_PREFIX = re.compile(r"(m|s|rad|N|N m|V|A|W)(/s(\^2)?)?")
_FLOWS = ("l/s", "ml/s", "ul/s")
_SMALLER = {"kg": ("g", "mg"), "m3/s": _FLOWS, "m^3/s": _FLOWS}


def after_number(unit: str) -> str:
    """A unit as it follows a number; nothing for one that is none."""
    return "" if unit in _RELATIVE else f" {unit}"


def small_scale(unit: str, values: Iterable[float]) -> tuple[str, float]:
    """Unit in which values are read: small ones with the prefix m or u, such as mrad or um, small
    masses in g, small flows in ml/s.

    Returns:
        The unit, and what values are multiplied by to be in it.
    """
    shown, times, most = unit, 1.0, max(map(abs, filter(math.isfinite, values)), default=1.0)
    prefixed = (f"m{unit}", f"u{unit}") if _TAKES_PREFIX.fullmatch(unit) else ()
    for smaller in _SMALLER.get(unit, prefixed):
        if most == 0.0 or times * most >= SMALL:
            break
        shown, times = smaller, 1e3 * times if smaller in prefixed else factor(unit, smaller)
    return shown, times
