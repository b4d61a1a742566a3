"""Units as text, taken apart by a grammar of their own: ``N m s/rad`` is N, m, s and 1/rad.

::

    product = power {[* / · per] power}              a blank multiplies
    power   = (name | 1 | "(" product ")") [(^ | **) exponent]
    exponent = [+ -] one or two digits [.5], in brackets or not; superscript digits

Nothing is evaluated but sums of exponents, so that no text takes long.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping

LONGEST = 100  # letters of a unit; the longest in common use has some forty
LARGEST_POWER = 99
_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁺", "0123456789-+")
_RAISED = re.compile("[⁺⁻]?[⁰¹²³⁴⁵⁶⁷⁸⁹]+")
_LETTER = "A-Za-z_%°µμΩΩÅ"
_TOKEN = re.compile(rf"\s*(\*\*|[*/^()·⋅]|1(?![\w.])|[{_LETTER}][{_LETTER}0-9]*)\s*")
_EXPONENT = re.compile(r"\s*(\()?\s*([+-]?[0-9]{1,2}(?:\.5)?)(?![0-9.])\s*(?(1)\)|)\s*")
_DIGIT_IS_POWER = re.compile(r"(m|mm|cm|km|s)([234])")  # "m/s2" and "mm3" are written, too
_NEWTONS = re.compile(r"([kmuM]?N)(m|cm|mm)")  # "Nm" is written for N m
_SPELLED = {"°C": "degC", "°F": "degF", "°": "deg"}
_DIVIDES, _TIMES = ("/", "per"), ("*", "·", "⋅")


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
    raised = _RAISED.sub(lambda m: "^" + m[0].translate(_SUPERSCRIPTS), text)
    reader = _Reader(raised)
    powers = reader.product()
    if reader.at < len(raised):
        raise reader.error()
    if beyond := [p for p in powers.values() if abs(p) > LARGEST_POWER]:
        raise ValueError(f"powers go up to {LARGEST_POWER}, got {beyond[0]:g}")
    return powers


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
    if newtons := _NEWTONS.fullmatch(name):
        return Counter({newtons[1]: 1, newtons[2]: 1})
    return Counter([name])
