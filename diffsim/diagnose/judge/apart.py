"""What groups of runs share and in what they differ: devices of one type, motors, propellers.

A study states what may differ by a fact of its runs: parameters ``per: servo`` have a value of
their own for each servo, causes a size for all and a departure of each. Here these numbers stand
beside each other, with their differences: numbers that are uncertain alike may differ for sure.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from scipy.special import chdtri, ndtri
from torch import Tensor

from diffsim.core.figures import figure, limits
from diffsim.core.units import after_number, small_scale
from diffsim.diagnose.judge.own_values import words_of
from diffsim.diagnose.judge.records import HALF_LEVEL, SURE, Interval
from diffsim.identify import Fit
from diffsim.identify.effect import effect_coordinates
from diffsim.identify.ranges import FittedNumbers, Numbers, Range, range_of

ALL = "all"  # component of a cause that all groups have


@dataclass(frozen=True)
class ApartRow:
    """A number of one group, beside those of the others."""

    name: str  # name of the parameter or cause
    fact: str  # fact of the runs by which it may differ, such as "servo"
    label: str  # value of that fact: the group; of several, their values
    unit: str  # SI unit of the number, "-" if none
    size: Interval  # the group's number with its 90 % interval, in ``unit``
    over: Interval  # the same less the median of all other groups, in ``unit``
    differs: bool  # whether ``over`` is not zero, of all such rows with 99 % probability
    others: str = ""  # all other groups, where the row is of several; empty: of one

    def as_read(self) -> tuple[Interval, Interval, str]:
        """Number, difference and the unit in which a user reads them."""
        ends = [end for i in (self.size, self.over) for end in (i.low, i.high)]
        unit, times = small_scale(self.unit, ends)
        size, over = (
            Interval(times * i.value, times * i.low, times * i.high) for i in (self.size, self.over)
        )
        return size, over, unit


def apart_rows(numbers: Numbers, units: Mapping[str, str]) -> tuple[ApartRow, ...]:
    """A row for each number and group, of all numbers that groups have of their own.

    Args:
        numbers: All that an extended model holds.
        units: SI units by name of parameter or component.
    """
    groups = _numbers_of_groups(numbers.values)
    count = sum(len(own) if len(own) > 2 else 1 for own in groups.values())
    limit = float(ndtri(1.0 - (1.0 - SURE) / (2.0 * max(count, 1))))
    out: list[ApartRow] = []
    for (name, fact), own in groups.items():
        made = partial(_row, numbers, name, fact, own=own, units=units)
        rows = [made([label], limit=limit) for label in own]
        if not any(row.differs for row in rows):
            # two batches: the median of the others lies between them. What is chosen among all
            # contrasts is held against the limit of all contrasts (Scheffe)
            order = [row.label for row in sorted(rows, key=lambda row: row.size.value)]
            most = float(np.sqrt(chdtri(len(own) - 1, (1.0 - SURE) / len(groups))))
            parted = [made(order[k:], limit=most) for k in range(2, len(order) - 1)]
            rows += sorted((r for r in parted if r.differs), key=lambda r: -r.over.low)[:1]
        out += rows
    return tuple(out)


def apart_in_fit(fit: Fit, ranges: Mapping[str, Range]) -> tuple[ApartRow, ...]:
    """Rows of a fit, with the intervals of an answer.

    Args:
        ranges: 90 % intervals by name of parameter or component.
    """
    units = {p.name: p.unit for p in fit.problem.model.base}
    units |= {name: e.unit for e in fit.problem.effects for name in effect_coordinates([e])}
    return apart_rows(FittedNumbers(fit, ranges), units)


def _numbers_of_groups(
    names: Iterable[str],
) -> dict[tuple[str, str], dict[str, list[str]]]:
    """By name and fact: the saved numbers whose sum a group has, by label."""
    found: dict[tuple[str, str], dict[str, list[str]]] = {}
    for name in names:
        parts = re.fullmatch(r"(.+?)(\.?)\[(\w+)=(.*)\]", name)
        if parts is None or parts[3] == "run":
            continue
        common = [f"{parts[1]}.{ALL}"] if parts[2] else []
        found.setdefault((parts[1], parts[3]), {})[parts[4]] = [*common, name]
    return {key: own for key, own in found.items() if len(own) > 1}


def _row(
    numbers: Numbers,
    name: str,
    fact: str,
    labels: Sequence[str],
    own: Mapping[str, Sequence[str]],
    units: Mapping[str, str],
    limit: float,
) -> ApartRow:
    needed = list(dict.fromkeys(n for names in own.values() for n in names))
    labels = [label for label in own if label in labels]
    groups = [own[label] for label in labels]
    rest = [label for label in own if label not in labels]
    others = [own[label] for label in rest]
    many = ", ".join(rest) if len(labels) > 1 else ""
    here = list(dict.fromkeys(n for names in groups for n in names))
    size = Interval(*range_of(lambda values: _sums_of(values, groups).mean(0), here, numbers))
    # one odd group does not move a median; of two batches the means are the surer ones
    middle = partial(torch.mean, dim=0) if many else partial(torch.quantile, q=0.5, dim=0)
    over = Interval(
        *range_of(
            lambda values: _sums_of(values, groups).mean(0) - middle(_sums_of(values, others)),
            needed,
            numbers,
        )
    )
    nearer = over.value - over.low if over.value > 0.0 else over.high - over.value
    differs = abs(over.value) > limit * nearer / HALF_LEVEL
    unit = units.get(needed[-1], "-")
    return ApartRow(name, fact, ", ".join(labels), unit, size, over, differs, many)


def _sums_of(values: Mapping[str, Tensor], groups: Sequence[Sequence[str]]) -> Tensor:
    return torch.stack([torch.stack([values[n] for n in names]).sum(0) for names in groups])


def apart_words(rows: Sequence[ApartRow], shared: Sequence[str]) -> tuple[str, ...]:
    """What groups share and in what they differ, in sentences; none where nothing may differ.

    Args:
        rows: Numbers of groups.
        shared: Names of parameters and causes that are one number for all.
    """
    if not rows:
        return ()
    out: list[str] = []
    named = dict.fromkeys((row.name, row.fact) for row in rows)
    for key in named:
        own = [row for row in rows if (row.name, row.fact) == key]
        if len(own) == 2:  # one is as much over the other as that is below
            out += [_say_difference(own[1], f"{own[0].fact} {own[0].label}")] * own[1].differs
        else:
            apart = [row for row in own if row.differs]
            out += [_say_difference(row, row.others or "the others") for row in apart]
    differing = {row.name for row in rows if row.differs}
    if alike := [words_of(name) for name, _ in named if name not in differing]:
        out.append(f"No difference is seen in {', '.join(alike)}.")
    if shared:
        out.append(f"One number for all: {', '.join(words_of(name) for name in shared)}.")
    return tuple(out)


def _say_difference(row: ApartRow, others: str) -> str:
    _, over, unit = row.as_read()
    sign = 1.0 if over.value > 0.0 else -1.0
    low, high = sorted((sign * over.low, sign * over.high))
    within = limits(abs(over.value), low, high)
    word = "more" if over.value > 0.0 else "less"
    verb = "have" if row.others else "has"
    return (
        f"{row.fact.capitalize()} {row.label} {verb} {figure(abs(over.value))}{after_number(unit)} "
        f"{word} {words_of(row.name)} than {others} "
        f"({within}; 90 % interval)."
    )
