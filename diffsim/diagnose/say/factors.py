"""Sizes that are factors of a slip: a gear counted twice, degrees for radians, a sign turned."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from statistics import fmean

import numpy as np

from diffsim.core.figures import figure
from diffsim.core.unit_slips import UNIT_SLIPS, UnitSlip
from diffsim.diagnose.judge.records import CauseRow, Interval

WIDEST = 0.06  # of a factor: a wider interval holds it by chance
SAME = 0.03  # of a factor: closer ones are one
GAINS = ("command_gain", "gain_inside", "sensor_scale")  # causes whose size is a factor less one
_COUNTED: tuple[tuple[float, str], ...] = (
    (4.0, "is a gear counted twice"),
    (0.25, "is a gear counted twice"),
    (2.0, "is one of two counted, or a diameter for a radius"),
    (0.5, "is one of two counted, or a radius for a diameter"),
    (-1.0, "is the sign turned"),
)


def _of_unit(slip: UnitSlip) -> Iterator[tuple[float, str]]:
    if slip.coarse:
        yield slip.ratio, f"are {slip.coarse} read as {slip.fine}"
        yield 1.0 / slip.ratio, f"are {slip.fine} read as {slip.coarse}"
    else:
        times = slip.words.partition(" (")[0]
        yield slip.ratio, f"is a unit {times} times too small"
        yield 1.0 / slip.ratio, f"is a unit {times} times too large"


#: Factors, and the slip that each is a sign of
SLIPS = (*_COUNTED, *(way for slip in UNIT_SLIPS for way in _of_unit(slip)))
_INERTIAS = ("kg", "g", "kg m^2", "g m^2")


def is_same_factor(value: float, factor: float) -> bool:
    """Whether two factors are one within what fits leave."""
    return abs(value - factor) <= SAME * abs(factor)


def factor_words(found: Interval) -> str:
    """What a factor is a sign of, such as "4.00 times: is a gear counted twice?"; or nothing.

    Args:
        found: Factor with its 90 % interval.
    """
    for factor, slip in SLIPS:
        if found.low <= factor <= found.high and found.high - found.low <= WIDEST * abs(factor):
            return f"{figure(found.value)} times: {slip}?"
    return ""


def gain_words(row: CauseRow) -> str:
    """What the gain of a drive or the scale of a sensor is a sign of; or nothing."""
    if not row.name.startswith(GAINS) or row.unit != "-" or len(row.size) != 1:
        return ""
    size = next(iter(row.size.values()))
    return factor_words(Interval(1.0 + size.value, 1.0 + size.low, 1.0 + size.high))


def sheet_words(rows: Sequence[tuple[CauseRow, float]], drives: Sequence[str] = ()) -> list[str]:
    """Numbers of a data sheet that are off by a factor of a slip, those by one factor as one.

    Args:
        rows: Findings in the unit in which they are read, and what the data sheet says.
        drives: Parameters that are the strengths of all drives of the model; (): unknown.
    """
    found: dict[str, tuple[float, list[CauseRow]]] = {}
    others: list[tuple[Interval, CauseRow]] = []
    for row, stated in rows:
        size = next(iter(row.size.values()))
        if stated == 0.0:
            continue
        low, high = sorted((size.low / stated, size.high / stated))
        value = size.value / stated
        if words := factor_words(Interval(value, low, high)):
            alike = (k for k, (f, _) in found.items() if is_same_factor(value, f))
            key = next(alike, words)
            found.setdefault(key, (value, []))[1].append(row)
        else:
            others.append((Interval(value, low, high), row))
    said = [_say(words, value, own, drives) for words, (value, own) in found.items()]
    return [*said, *_say_common(others, rows, drives)] if others else said


def times_all_drives(rows: Sequence[tuple[CauseRow, float]], drives: Sequence[str]) -> float | None:
    """How many times as strong as stated all drives are, where their values agree; else None.

    Args:
        rows, drives: As of ``sheet_words``.
    """
    found = {r.name: next(iter(r.size.values())).value / v for r, v in rows if v}
    values = [found[name] for name in drives if name in found]
    is_all = len(values) == len(drives) > 0
    value = fmean(values) if is_all else 0.0
    return value if is_all and np.ptp(values) <= SAME * abs(value) else None


def _say_common(
    found: Sequence[tuple[Interval, CauseRow]],
    rows: Sequence[tuple[CauseRow, float]],
    drives: Sequence[str],
) -> list[str]:
    """Numbers that one factor would put right, though it is that of no slip, as one finding; of a
    single one only where it has a twin. All drives are known against each other where nothing but
    their data sheets says how strong they are: then their values tell, not their intervals."""
    names = [row.name for _, row in found]
    if len({row.unit for _, row in found}) > 1 or (len(found) == 1 and [*drives] != names):
        return []
    low, high = max(f.low for f, _ in found), min(f.high for f, _ in found)
    if low > high:
        return []
    value, size = 0.5 * (low + high), ""
    if high - low > WIDEST * abs(low):
        times = times_all_drives(rows, drives)
        if times is None or set(names) != {*drives}:
            return []
        value, size = times, f" ({figure(low)} to {figure(high)})"
    sheets = "its data sheet" if len(found) == 1 else "their data sheets"
    own = [row for _, row in found]
    return [_say(f"{figure(value)}{size} times {sheets}.", value, own, drives)]


def _say(words: str, value: float, rows: Sequence[CauseRow], drives: Sequence[str]) -> str:
    names = [row.words for row in rows]
    several = ", ".join(names[:-1]) + f" and {names[-1]} are all" if len(names) > 1 else ""
    out = f"{several or f'{names[0]} is'} {words}"
    if value > 0.0 and all(row.unit in _INERTIAS for row in rows):
        out += (
            f" The twin of inertias {figure(value)} times as large is a drive "
            f"{figure(1.0 / value)} times as strong: a scale, or a measured force, decides."
        )
    elif value > 0.0 and drives and set(drives) <= {row.name for row in rows}:
        out += (
            f" The twin of all drives {figure(value)} times as strong is every mass, inertia and "
            f"loss {figure(1.0 / value)} times as large: a scale, or a measured force, decides."
        )
    return out[:1].upper() + out[1:]


def stated_of(row: CauseRow) -> float | None:
    """The number of the data sheet in a finding's note; None: it holds none."""
    try:
        return float(row.sheet.partition(" ")[0])
    except ValueError:
        return None
