"""Numbers of pages as text: digits that matter, intervals whose ends can be told apart."""

from __future__ import annotations

import math
from collections.abc import Sequence

DIGITS = 3  # of a number that stands alone
MOST_DIGITS = 7  # of the ends of a narrow interval
_PLAIN = 1e7  # numbers below it are written without an exponent
#: times: an end of an interval that is so far off its value limits nothing
NO_LIMIT = 10.0


def figure(value: float, digits: int = DIGITS) -> str:
    """A number such as "2130", "0.0664", "1.66e-9"; a dash where there is none.

    Args:
        digits: Digits that are kept; of 1e7 and more, and below 1e-4, with an exponent.
    """
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0.0 else "-∞"
    text = f"{value:.{digits}g}"
    number = float(text)
    if number == 0.0:
        return "0"
    if "e" not in text:
        return text
    if 1.0 <= abs(number) < _PLAIN:
        return f"{number:.0f}"
    mantissa, _, exponent = text.partition("e")
    return f"{mantissa}e{int(exponent)}"


def percent(share: float) -> str:
    """A share such as "44 %" or "0.5 %", as exact as it is small.

    Args:
        share: 1 is 100 %.
    """
    digits = 0 if abs(share) >= 0.095 or share == 0.0 else 1
    return f"{100.0 * share:.{digits}f} %"


def counted(number: int, noun: str) -> str:
    """How many there are, such as "1 run" or "3 runs".

    Args:
        noun: Of one; more have an "s".
    """
    return f"{number} {noun}{'' if number == 1 else 's'}"


def with_interval(value: float, low: float, high: float) -> str:
    """A value with its interval, in as many digits as tell the ends apart."""
    digits = digits_of(low, high)
    return f"{figure(value, digits)} ({limits(value, low, high, digits)})"


def limits(value: float, low: float, high: float, digits: int = DIGITS, unit: str = "") -> str:
    """The ends of an interval in words: "1.1 to 1.3 N", "at least 1.1 N; the data give no upper
    limit". An end limits nothing where an interval of one sign ends far off its value.

    Args:
        value: Lies between the ends.
        low, high: Ends, which may be infinite.
        digits: Digits of either end.
        unit: As it follows a number, with its space.
    """
    below, above = math.isinf(low), math.isinf(high)
    if low > 0.0:
        below, above = value > NO_LIMIT * low, high > NO_LIMIT * value
    elif high < 0.0:
        below, above = low < NO_LIMIT * value, value < NO_LIMIT * high
    if above and not below:
        return f"at least {figure(low, digits)}{unit}; the data give no upper limit"
    if below and not above:
        return f"at most {figure(high, digits)}{unit}; the data give no lower limit"
    said = f"{figure(low, digits)} to {figure(high, digits)}{unit}"
    return f"{said}; the data give no limit" if below else said


def with_sd(value: float, sd: float) -> str:
    """A value with its standard deviation, in as many digits as the latter asks for."""
    return f"{figure(value, digits_of(value - sd, value + sd))} ± {figure(sd)}"


def digits_of(low: float, high: float) -> int:
    """Digits in which the width of an interval is right to a tenth, ``DIGITS`` at least."""
    width = high - low
    if not math.isfinite(width) or width <= 0.0:
        return DIGITS
    for digits in range(DIGITS, MOST_DIGITS):
        shown = float(f"{high:.{digits}g}") - float(f"{low:.{digits}g}")
        if abs(shown - width) <= 0.1 * width:
            return digits
    return MOST_DIGITS


def unit_of(unit: str) -> str:
    """A unit as it is written after a number."""
    return "" if unit == "-" else unit


def signed(value: float) -> str:
    """One decimal with its sign; zero has none."""
    text = f"{value:+.1f}"
    return "0" if float(text) == 0.0 else text


def probability(value: float) -> str:
    """A probability in two digits; one that is next to zero is not counted out."""
    if math.isnan(value):
        return "–"
    return "< 0.001" if value < 1e-3 else f"{value:.2g}"


def fold_alike(sentences: Sequence[str]) -> list[str]:
    """Sentences that say the same of several, as one: "a.mat, b.mat and 3 more: a single value"."""
    by: dict[str, list[str]] = {}
    for sentence in sentences:
        who, colon, what = sentence.partition(": ")
        by.setdefault(what if colon else sentence, []).append(who)
    return [
        f"{list_first(whose, 2)}: {what}" if what != whose[0] else what
        for what, whose in by.items()
    ]


def list_first(names: Sequence[str], most: int = 8, between: str = ", ") -> str:
    """The first names, and how many more there are: "a, b and 3 more"; one more is named, too."""
    if (more := len(names) - most) <= 1:
        return between.join(names)
    return f"{between.join(names[:most])} and {more} more"
