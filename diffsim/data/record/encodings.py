"""Numbers that are words of a sensor: counts that wrap, sign bits, sizes without a sign, codes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.figures import counted
from diffsim.data.codes import from_sign_bit, from_twos_complement
from diffsim.data.command_jumps import MAX_JUMP_SHARE
from diffsim.data.record.finding import Finding, rows_shown
from diffsim.data.record.signals import FEW, Record, Samples, Signal

COUNTS = tuple(2.0**k for k in range(7, 33))
TURNS = (360.0, 2.0 * np.pi, 1.0, 3600.0, 36000.0, 400.0, 6400.0)
CODES = (
    0.0,
    -1.0,
    255.0,
    999.0,
    -999.0,
    9999.0,
    -9999.0,
    99999.0,
    -99.0,
    65535.0,
    -32768.0,
    32767.0,
)
SURE_CODES = tuple(c for c in CODES if abs(c) > 90.0)
FULL_SCALES = (255.0, 65535.0, -32768.0, 32767.0)  # of words, by which a drive is fully on
SWITCHED = 100.0  # times the range of other levels: no further apart are those of one switch
DISTINCT = 8  # values of a word, from which on it moves
CONTINUES = 0.2  # of a jump that is left of it where it is none
WORDS = {"sign_bit": (7, 9, 10, 11, 15, 23, 31), "signed": (8, 10, 12, 16, 24, 32)}
WITHIN = 0.25  # of a period: how far from its ends a column wraps
OUTSIDE = 0.15  # of the range of other values: how far off a code lies at least
TOUCHES = 0.08  # of the largest value: where a size touches 0
UNSIGNED = ("abs(", "sqrt(", "hypot(", "max(", "**")  # of models whose readings have no sign


def find_signs(record: Record) -> Iterator[Finding]:
    """Words whose sign is a bit, or that were read without their sign."""
    for signal in record.signals:
        if (found := _sign_of(signal)) is None:
            continue
        key, number, least = found
        where = _decode(signal, f"{{{key}: {number}}}")
        if key == "signed":
            says = f"two's complements of {number} bits that were read without their sign"
            where += f", or `{{wrap: {2**number}}}` of a counter that goes round"
        else:
            says = f"words whose bit {number} is the sign"
        high = f"{signal.high:.6g}"
        yield Finding(
            signal.where,
            f"column {signal.column} holds {says}: it goes to {high}, and jumps where it should "
            f"pass 0 (down to {least:.4g})",
            where,
            True,
        )


def _decode(signal: Signal, keys: str) -> str:
    return f"`decode: {keys}` in {signal.where}"


def _sign_of(signal: Signal) -> tuple[str, int, float] | None:
    if signal.low < 0.0 or not signal.high > 1.0:
        return None
    if max((s.largest_change for s in signal.runs), default=0.0) < 0.25 * signal.high:
        return None
    step = signal.whole_step
    if step is None or len(np.unique(signal.all_values[:100_000])) < DISTINCT:
        return None
    top = int(np.floor(np.log2(signal.high / step + 0.5)))
    if top < 6:
        return None
    ways = (
        ("sign_bit", top, lambda v: from_sign_bit(v, top, step)),
        ("signed", top + 1, lambda v: from_twos_complement(v, top + 1, step)),
    )
    best: tuple[float, str, int, float] | None = None
    for key, number, decode in ways:
        before, after, least = [], [], 0.0
        for samples in signal.runs:
            is_set = samples.values >= step * (2.0**top - 0.5)
            at = np.flatnonzero(is_set[1:] != is_set[:-1])
            decoded = decode(samples.values)
            least = min(least, float(decoded.min()))
            before += [np.abs(samples.changes[at])]
            after += [np.abs(np.diff(decoded)[at])]
        raw, left = np.concatenate(before), np.concatenate(after)
        if not len(raw) or least > -2.0 * step or (step != 1.0 and number not in WORDS[key]):
            continue
        ratio = float(left.mean() / raw.mean()) if raw.mean() > 0.0 else 1.0
        if np.quantile(left / np.maximum(raw, 1e-300), 0.9) < 2.0 * CONTINUES and ratio < CONTINUES:
            best = min(best or (np.inf, "", 0, 0.0), (ratio, key, number, least))
    if best is None or (best[1] == "signed" and best[2] % 8 and _wraps_of(signal)):
        return None
    return best[1:]


def find_wraps(record: Record) -> Iterator[Finding]:
    """Columns that count modulo something, and go on over its ends."""
    for signal in record.signals:
        found = _wraps_of(signal)
        if found is None or (_sign_of(signal) is not None):
            continue
        period, times = found
        shown = f"{period:g}" if period != 2.0 * np.pi else "6.283185307"
        yield Finding(
            signal.where,
            f"column {signal.column} counts modulo {shown}: it jumps from one end to the other "
            f"{len(times)} times, {rows_shown(times)}, and goes on in its direction",
            _decode(signal, f"{{wrap: {shown}}}"),
            True,
        )


def _periods(signal: Signal) -> Iterator[float]:
    is_whole = signal.whole_step == 1.0
    yield from (p for p in COUNTS if is_whole)
    is_angle = signal.unit in ("rad", "-", None)
    if is_angle:
        yield from TURNS if is_whole or signal.unit != "-" else TURNS[:3]
    if signal.unit == "rad" and signal.scale:
        yield 2.0 * np.pi / abs(signal.scale)


def _wraps_of(signal: Signal) -> tuple[float, list[float]] | None:
    jump = max((s.largest_change for s in signal.runs), default=0.0)
    if not jump > 0.6 * signal.range:
        return None
    for period in _periods(signal):
        if not 0.8 * signal.range < period < 1.7 * jump or signal.range > 1.01 * period:
            continue
        times: list[float] = []
        good, up, down = 0, 0, 0
        for samples in signal.runs:
            if len(samples) < 2:
                continue
            gaps = np.diff(samples.at)
            # what was left out between two samples went either way
            is_far = (np.abs(samples.changes) > 0.5 * period) & (gaps < 2.0 * np.median(gaps))
            at = np.flatnonzero(is_far)
            if len(at) > 0.4 * len(samples):
                return None
            for k in at[:200]:
                if _goes_on(samples, int(k), period, signal.low):
                    good += 1
                    times.append(float(samples.times[k + 1]))
                up, down = up + (samples.changes[k] > 0.0), down + (samples.changes[k] < 0.0)
        is_periodic = signal.role == "command" and not signal.is_measured and not (up and down)
        if good and good >= 0.8 * (up + down) and not is_periodic:
            return period, times
    return None


def _goes_on(samples: Samples, k: int, period: float, low: float) -> bool:
    """Whether the k-th change is one over the ends of a period."""
    d, around = samples.changes[k], samples.around(k)
    around = around[np.abs(around) < 0.5 * period]
    if not len(around):
        return False
    left = d - np.sign(d) * period
    before, after = samples.values[k], samples.values[k + 1]
    bottom = low if low > -0.01 * period else -period / 2.0
    ends = sorted(((before - bottom) / period, (after - bottom) / period))
    at_ends = ends[0] < WITHIN and ends[1] > 1.0 - WITHIN
    heads = -np.sign(d) * float(np.sum(around))
    near = abs(left) < max(4.0 * np.abs(around).max(), 6.0 * samples.noise)
    return bool(at_ends and heads > 0.0 and near and abs(left) < 0.4 * period)


def find_folded(record: Record) -> Iterator[Finding]:
    """Channels that touch 0 with cusps and are never below, under two-sided commands."""
    two_sided = [
        c
        for c in record.commands
        if c.range > 0.0 and c.low < -0.15 * c.range < 0.15 * c.range < c.high
    ]
    text = _readings(record)
    for signal in record.channels if two_sided else ():
        if signal.low < 0.0 or any(mark in text.get(signal.name, "") for mark in UNSIGNED):
            continue
        if _sign_of(signal) is not None:
            continue  # a bit holds it
        touches = [t for samples in signal.runs for t in _touches(samples, signal.high)]
        if len(touches) >= 3:
            name = two_sided[0].name
            yield Finding(
                signal.where,
                f"column {signal.column} is never negative, though command {name} has both signs: "
                f"it touches 0 with a cusp {len(touches)} times, {rows_shown(touches)}; its sign "
                "was lost",
                f"{_decode(signal, '{folded: 1}')} finds it (-1 where the runs begin below 0), or "
                "a model whose reading has abs()",
                True,
            )


def _readings(record: Record) -> dict[str, str]:
    """What the model's formula of each channel says, with what it is defined by."""
    model = record.study.model or {}
    readings = model.get("readings")
    if not isinstance(readings, dict):
        return {c.name: str(model) for c in record.channels}
    defined = str(model.get("define", ""))
    return {str(name): f"{text} {defined}" for name, text in readings.items()}


def _touches(samples: Samples, high: float) -> list[float]:
    """Times of cusps at 0."""
    x = samples.values
    if len(x) < FEW or samples.low > TOUCHES * high:
        return []
    usual = max(samples.usual_change, 1e-300)
    w = int(np.clip(np.ceil(6.0 * samples.noise / usual), 2, 8))
    if len(x) < 4 * w + 2:
        return []
    middle = np.arange(w, len(x) - w)
    left, right = (x[middle] - x[middle - w]) / w, (x[middle + w] - x[middle]) / w
    bend = right - left
    lowest = np.array([x[k - w : k + w + 1].min() for k in middle[x[middle] < TOUCHES * high]])
    there = middle[x[middle] < TOUCHES * high]
    if not len(there):
        return []
    is_low = x[there] <= lowest
    out, last = [], -2 * w
    typical = float(np.quantile(np.abs(bend), 0.5))
    for k in there[is_low]:
        falls, rises = -left[k - w], right[k - w]
        least = 4.0 * max(typical, samples.noise / w)
        is_cusp = min(falls, rises) > 0.0 and falls + rises > least and 0.4 < falls / rises < 2.5
        if is_cusp and x[k] < 1.2 * max(falls, rises) and k - last > 2 * w:
            out.append(float(samples.times[k]))
            last = int(k)
    return out


def find_codes(record: Record) -> Iterator[Finding]:
    """Numbers that stand for nothing measured."""
    for signal in record.signals:
        for code in _candidates(signal):
            if (found := _code(signal, code)) is not None:
                yield found
                break


def _candidates(signal: Signal) -> Iterator[float]:
    if not signal.range > 0.0:
        return
    yield from (v for v in (signal.low, signal.high))
    if signal.role == "channel" and signal.low < 0.0 < signal.high:
        yield 0.0


def _are_levels(others: Array, off: float) -> bool:
    """Whether what lies ``off`` beyond other values is a level of a switch, as these are."""
    levels = np.unique(others)
    is_near = off <= SWITCHED * float(np.ptp(levels))
    return len(levels) == 1 or (is_near and len(levels) < DISTINCT)


def _code(signal: Signal, code: float) -> Finding | None:
    jump = max((s.largest_change for s in signal.runs), default=0.0)
    if jump < 0.1 * signal.range:
        return None
    values = signal.all_values
    is_code = values == code
    count, others = int(is_code.sum()), values[~is_code]
    is_known = code in CODES
    if not count or len(others) < FEW or (count < 2 and not is_known):
        return None
    low, high = np.quantile(others, [0.002, 0.998])
    size = max(float(high - low), 1e-12)
    off = max(low - code, code - high)
    share = count / len(values)
    is_level = _are_levels(others, off)
    if signal.role == "command" and (off < size or code not in SURE_CODES):
        return None
    if signal.role == "command" and code in FULL_SCALES and is_level:
        return None
    if share > (0.2 if is_level or signal.role == "command" else 0.5):
        return None
    is_inside = code == 0.0 and off <= 0.0
    if is_inside:
        off = OUTSIDE * size  # only jumps tell, there and back
    elif off < (OUTSIDE if is_known else 1.0) * size:
        return None
    stretches, jumps, times, longest = 0, 0, [], 0
    for samples in signal.runs:
        at = np.flatnonzero(samples.values == code)
        if not len(at):
            continue
        usual = float(np.quantile(np.abs(samples.changes), 0.75)) if len(samples) > 1 else 0.0
        limit = max(6.0 * usual, 6.0 * samples.noise, 0.5 * off)
        for part in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1):
            ends = [k for k in (part[0] - 1, part[-1]) if 0 <= k < len(samples.changes)]
            stretches += 1
            is_told = len(ends) == 2 if is_inside else bool(ends)  # a rest at zero has no end
            jumps += is_told and all(abs(samples.changes[k]) > limit for k in ends)
            longest = max(longest, len(part))
            times.append(float(samples.times[part[0]]))
    needed = 2 if code == 0.0 else 1
    if jumps < max(needed, 0.8 * stretches):
        return None
    return Finding(
        signal.where,
        f"column {signal.column} is {code:g} in {counted(count, 'sample')} ({share:.2g} of all), "
        f"far from those around, {rows_shown(times)}: a number for nothing measured",
        _decode(signal, f"{{missing: {code:g}}}"),
        share > MAX_JUMP_SHARE or longest > 2 or signal.role == "command",
    )
