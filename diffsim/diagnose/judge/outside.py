"""How far runs lie outside of what was fitted: levels, strokes, rates and frequencies, facts of
the set-up.

A model is fitted where it was excited: the misfit of a lag is seen at any amplitude, that of a
speed limit only above it. So an error on a test run means little without its distance from the
range of the fitted runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diffsim.data.study import Channel, Command, Run
from diffsim.diagnose.judge.records import RATIOS, OutsideRow

Array = NDArray[np.float64]
TAIL = 0.01  # share of samples on either side that a range leaves out: spikes are none
MARGIN = 1.02  # of the distance from the middle of the range: rounding is not outside
LEAST_WIDTH = 0.1  # half-width of a range over its middle, where all fitted runs are alike
LEVEL = "level of"  # smallest and largest value alike: what lies between was passed through
FEW = 8  # samples; fewer have no rate and no frequency


@dataclass(frozen=True)
class Span:
    """What the fitted runs covered of one quantity.

    Attributes:
        low, high: Smallest and largest value; None for labels.
        labels: Labels that occurred; empty for numbers.
        unit: Unit of the quantity.
    """

    low: float | None
    high: float | None
    labels: tuple[str, ...] = ()
    unit: str = ""


def spans_of(
    runs: Sequence[Run], channels: Sequence[Channel], commands: Sequence[Command] = ()
) -> dict[str, Span]:
    """Range of every quantity over runs, by name of the quantity.

    Args:
        runs: Runs that were fitted.
        channels: Columns of their ``measured``.
        commands: What is known of commands: their units.
    """
    found: dict[str, list[tuple[float | str, str]]] = {}
    for run in runs:
        for what, value, unit in _quantities(run, channels, commands):
            found.setdefault(what, []).append((value, unit))
    out = {}
    for what, values in found.items():
        numbers = [v for v, _ in values if not isinstance(v, str)]
        labels = sorted({v for v, _ in values if isinstance(v, str)})
        low, high = (min(numbers), max(numbers)) if numbers else (None, None)
        out[what] = Span(low, high, tuple(labels), values[0][1])
    return out


def outside_rows(
    runs: Sequence[Run],
    channels: Sequence[Channel],
    spans: Mapping[str, Span],
    commands: Sequence[Command] = (),
) -> tuple[OutsideRow, ...]:
    """Quantities of runs outside of fitted ranges, the farthest first.

    Args:
        runs: Runs that are judged.
        channels: Columns of their ``measured``.
        spans: Ranges of the fitted runs, as ``spans_of`` returns them.
        commands: What is known of commands: their units.
    """
    rows: dict[tuple[str, str], OutsideRow] = {}
    for run in runs:
        for what, value, unit in _quantities(run, channels, commands):
            if what in spans and (times := _times(what, value, spans[what])) > MARGIN:
                span, key = spans[what], (run.name, what)
                if key not in rows or rows[key].times < times:
                    rows[key] = OutsideRow(run.name, what, value, span.low, span.high, times, unit)
    return tuple(sorted(rows.values(), key=lambda row: -row.times))


def _times(what: str, value: float | str, span: Span) -> float:
    """How far outside a value is; at most 1 is inside.

    Strokes and rates over the largest one that was fitted: smaller ones were passed through. All
    else by its distance from the middle of the range over half the width, a tenth of the middle at
    least where all fitted runs are alike.
    """
    if isinstance(value, str):
        return 1.0 if value in span.labels else float("inf")
    if span.low is None or span.high is None:
        return float("inf")
    if what.startswith(RATIOS):
        return value / span.high if span.high > 0.0 else (1.0 if value <= 0.0 else float("inf"))
    middle, half = 0.5 * (span.low + span.high), 0.5 * (span.high - span.low)
    if span.low <= value <= span.high:
        return 1.0
    half = max(half, LEAST_WIDTH * abs(middle))
    return abs(value - middle) / half if half > 0.0 else float("inf")


def _quantities(
    run: Run, channels: Sequence[Channel], commands: Sequence[Command]
) -> list[tuple[str, float | str, str]]:
    """Name, value and unit of everything that says where a run lies."""
    out: list[tuple[str, float | str, str]] = []
    units = {c.name: c.unit for c in commands if c.unit not in (None, "-")}
    for name, values in run.command.items():
        unit = units.get(name) or ""
        out += _of_signal(name, np.asarray(values, dtype=np.float64), run.time_s, unit)
    for channel, values in zip(channels, run.measured.T, strict=True):
        seen = values[np.isfinite(values)]
        if len(seen):
            low, high = np.quantile(seen, [TAIL, 1.0 - TAIL])
            out.append((f"stroke of {channel.name}", float(high - low), channel.unit))
            out += [(f"{LEVEL} {channel.name}", float(v), channel.unit) for v in (low, high)]
    for name, fact in run.setup.items():
        if name.startswith("_"):  # found by the system, such as a start state
            continue
        is_number = isinstance(fact, (int, float)) and not isinstance(fact, bool)
        out.append((name, float(fact) if is_number else str(fact), ""))
    return out


def _of_signal(
    name: str, values: Array, time_s: Array, unit: str
) -> list[tuple[str, float | str, str]]:
    """Ends, rate and frequency of a command; a constant has no frequency."""
    valid = np.isfinite(values)
    values, time_s = values[valid], time_s[valid]
    if not len(values):
        return []
    low, high = np.quantile(values, [TAIL, 1.0 - TAIL])
    out: list[tuple[str, float | str, str]] = [
        (f"{LEVEL} {name}", float(low), unit),
        (f"{LEVEL} {name}", float(high), unit),
    ]
    if len(values) < FEW or not high > low:
        return out
    slope = np.diff(values) / np.diff(time_s)
    out.append(
        (
            f"rate of {name}",
            float(np.quantile(np.abs(slope), 1.0 - TAIL)),
            f"{unit}/s" if unit else "",
        )
    )
    middle = 0.5 * (values[1:] + values[:-1])
    spread = float(np.average((middle - middle.mean()) ** 2, weights=np.diff(time_s)))
    if spread > 0.0:
        power = float(np.average(slope**2, weights=np.diff(time_s)))
        # a step has no rate of its own: limited by a sample, its frequency is that of the clock
        out.append((f"frequency of {name}", float(np.sqrt(power / spread) / (2 * np.pi)), "Hz"))
    return out
