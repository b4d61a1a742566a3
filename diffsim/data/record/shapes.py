"""Courses that no sensor shows: far values, flat tops, a stop, lines, jumps that stay."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from scipy.ndimage import median_filter

from diffsim.core.arrays import Array, IntArray
from diffsim.core.figures import counted, list_first
from diffsim.core.numbers import SD_OVER_MAD
from diffsim.core.units import after_number, factor
from diffsim.data.command_jumps import MAX_JUMP_SHARE, Jumps, jumps_of
from diffsim.data.record.finding import Finding, rows_shown
from diffsim.data.record.signals import FEW, Record, Samples, Signal
from diffsim.data.signal import rest_and_jump
from diffsim.data.study import Command

BURST = 6  # far samples that may be alike: more are a place where it stays
MOST_TOGETHER = 2  # samples off both sides that are told from what a model lacks
USUAL_SPREADS = 2.0  # spreads beyond which a value is none of the usual ones
OUTSIDE = 0.5  # of the range of the others: how far a value must leap
UNANSWERED = 10.0  # such leaps, beyond which no command is the reason
ALONE = 4.0  # largest changes around, beyond which a sample lies off both sides
SPIKY = ("m/s^2", "rad/s^2", "N", "N m", "A", "V", "W")  # SI units of what an impact makes jump
PLACES = ("m", "rad", "-", None, "K", "Pa")  # SI units of what cannot jump and stay
# of the least jump of a meter that cuts off, within which all begin or end where readings end: a
# turbine's cut-off had 0.04 of it, markers that slip from rest and back in one run are no meter
NEAR_AN_END = 0.1
SMALL = 0.1  # of the range of a command: a goal so near is none
HELD = 0.8  # share of rows in which a command of goals keeps its value
REACTION = 5  # rows after which a channel moves to a new goal, at most
NOISY = 0.1  # of its samples equal the one before, at most, where noise makes them differ
FEW_DIGITS = 4.5  # of a sensor, by which what comes to rest changes at most
FROZEN = 6  # samples of which a stop can be told
CHANCE = 1e-8  # of so long a stop where neighbors differ
MAX_RATE = 20  # rows on one line
MOST_NEW = 0.7  # of the rows of a slow sensor have new readings
EVEN = 0.95  # of its new readings come after as many rows as usual
LOOK = 4000  # samples that show first that they lie on none


def find_far(record: Record) -> Iterator[Finding]:
    """Values far outside of all others, at any share of the rows."""
    for signal in record.channels:
        values = signal.all_values
        if len(values) < FEW:
            continue
        # a rest counts once: what moves a tenth of the time is far from no usual value
        kept = [x.values[np.concatenate([[True], x.changes != 0.0])] for x in signal.runs if len(x)]
        low, high = np.quantile(np.concatenate(kept), [0.1, 0.9])
        reach = USUAL_SPREADS * float(high - low)
        inside = values[(values >= low - reach) & (values <= high + reach)]
        if len(inside) == len(values):
            continue
        low, high = float(inside.min()), float(inside.max())
        least = OUTSIDE * (high - low)
        both = ((-1.0, -low), (1.0, high))
        sides = [(s, end) for s, end in both if not _is_reached(s * values - end, least)]
        if not sides:
            continue
        times, count, worst, share, longest = [], 0, 0.0, 0.0, 0
        for samples in signal.runs:
            off = np.max([s * samples.values - end for s, end in sides], axis=0)
            far = _leaping(record, signal, samples, off, least)
            if len(far):
                count += len(far)
                times += samples.times[far].tolist()
                worst = max(worst, float(off[far].max()))
                share = max(share, len(far) / len(samples))
                parts = np.split(far, np.flatnonzero(np.diff(far) > 1) + 1)
                longest = max(longest, *map(len, parts))
        if not count or count > 0.4 * len(values):
            continue
        margin = 0.5 * least
        yield Finding(
            signal.where,
            f"column {signal.column} is far outside of all other values in "
            f"{counted(count, 'sample')} (up to {share:.2g} of a run), by up to {worst:.4g}, "
            f"{rows_shown(times)}",
            f"`decode: {{valid: [{low - margin:.4g}, {high + margin:.4g}]}}` in {signal.where} "
            "leaves them out",
            (share > MAX_JUMP_SHARE or longest > MOST_TOGETHER) and signal.unit not in SPIKY,
        )


def _is_reached(beyond: Array, least: float) -> bool:
    """Whether peaks reach what is far on one side through all that lies between, or nothing is."""
    return bool(np.sum((beyond > 0.0) & (beyond < least)) >= np.sum(beyond >= least))


def _leaping(
    record: Record, signal: Signal, samples: Samples, off_by: Array, least: float
) -> IntArray:
    """Places of stretches outside that begin and end by a leap which no command makes."""
    at = np.flatnonzero(off_by > 0.0)
    out: list[int] = []
    for part in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1) if len(at) else ():
        ends = [k for k in (part[0] - 1, part[-1]) if 0 <= k < len(samples.changes)]
        if not ends or any(abs(samples.changes[k]) < least for k in ends):
            continue
        if off_by[part].max() < least:
            continue
        if len(part) > BURST and np.abs(samples.changes[part[:-1]]).max() < 0.2 * least:
            continue  # it stays there
        off = float(np.abs(samples.changes[ends]).min())
        if off > UNANSWERED * least or not _is_commanded(record, samples, int(part[0])):
            out += part.tolist()
    return np.array(out, dtype=np.int64)


def _is_commanded(record: Record, samples: Samples, k: int) -> bool:
    """Whether a command jumps shortly before a sample."""
    start, end = samples.times[max(k - 3, 0)], samples.times[min(k + 1, len(samples) - 1)]
    for command in record.commands:
        of = command.of_run(samples.run)
        if of is None:
            continue
        part = of.values[(of.times >= start) & (of.times <= end)]
        if len(part) and np.ptp(part) > 0.1 * command.range:
            return True
    return False


def find_misread(record: Record) -> Iterator[Finding]:
    """Samples that lie off both sides, within the range of others."""
    for signal in record.channels:
        speed = _speed_of(signal, record)
        for samples in signal.runs:
            rows = spikes(samples, signal.sd, None if speed is None else speed.of_run(samples.run))
            rows = np.array([k for k in rows if not _is_commanded(record, samples, int(k))], int)
            if len(rows):
                yield Finding(
                    f"run {samples.run}",
                    f"channel {signal.name} is misread at "
                    f"{counted(len(rows), 'sample')}, "
                    f"{rows_shown(samples.times[rows].tolist())}: the diagnosis leaves such "
                    "samples out where the model does not jump, too",
                    "",
                    False,
                )


def find_jumps(record: Record) -> Iterator[Finding]:
    """Jumps of commands that nothing commanded: a model takes them for motion. What happens to
    several commands or runs is said once."""
    known = {c.name: c for c in record.study.commands}
    alike: dict[tuple[str, str], list[tuple[Samples, str, Jumps]]] = {}
    for run in record.study.runs:
        for signal in record.commands:
            if (samples := signal.of_run(run.name)) is None:
                continue
            command = known.get(signal.name, Command(signal.name))
            unit = command.shown_unit or command.unit
            scale = factor(command.unit or unit, unit) if unit else 1.0
            values = run.command[signal.name][samples.at]
            jumps = _jumps_of(signal, samples, values)
            if jumps.back or jumps.lasting:
                does = _MENDED if signal.is_measured else _TAKEN
                jumps = jumps._replace(size=scale * jumps.size)
                key = after_number(unit or "-"), does
                alike.setdefault(key, []).append((samples, signal.name, jumps))
    for (unit, does), places in alike.items():
        yield _jumping(places, unit, does)


def _jumping(places: Sequence[tuple[Samples, str, Jumps]], unit: str, does: str) -> Finding:
    """One sentence on commands that jump in the same unit."""
    names = list(dict.fromkeys(name for _, name, _ in places))
    runs = list(dict.fromkeys(samples.run for samples, _, _ in places))
    back = sum(len(jumps.back) for _, _, jumps in places)
    lasting = sum(len(jumps.lasting) for _, _, jumps in places)
    one = len(names) == 1
    ways = (
        (back, "jumps off and back", "jump off and back"),
        (lasting, "jumps and stays", "jump and stay"),
    )
    how = " and ".join(
        f"{single if one else several} at {counted(n, 'sample')}"
        for n, single, several in ways
        if n
    )
    samples, _, jumps = places[0]
    size = max(jumps.size for _, _, jumps in places)
    first = float(samples.times[min([*jumps.back, *jumps.lasting])])
    of_runs = f" of {len(runs)} runs" if len(runs) > 1 else ""
    return Finding(
        "study" if len(runs) > 1 else f"run {runs[0]}",
        f"{'command' if one else 'commands'} {list_first(names, 4)} {how}{of_runs}, by up to "
        f"{size:.3g}{unit}, first at {first:g} s{f' of run {runs[0]}' if of_runs else ''}",
        does,
        False,
    )


_MENDED = "the diagnosis takes this for a misreading where the model is no worse without it"
_TAKEN = "the model takes this for what acted; mend the file, or say is_measured: true"


def _jumps_of(signal: Signal, samples: Samples, values: Array) -> Jumps:
    """Jumps of a measured command as the diagnosis sees them; else samples off a course that is
    swept."""
    if signal.is_measured:
        return jumps_of(values, is_measured=True, times=samples.times)
    rows = [] if samples.shares_equal > 0.3 else spikes(samples).tolist()
    size = float(np.abs(np.diff(values)).max()) if rows else 0.0
    return (
        Jumps(rows, [], size) if len(rows) < MAX_JUMP_SHARE * len(samples) else Jumps([], [], 0.0)
    )


def spikes(samples: Samples, sd: float = 0.0, speed: Samples | None = None) -> IntArray:
    """Places of samples off both sides, that no bounce or cusp explains.

    Args:
        sd: Noise that is usual.
        speed: Its derivative, where that was measured: then it decides.
    """
    x, none = samples.values, np.empty(0, dtype=np.int64)
    if len(x) < 2 * FEW or samples.largest_change < 0.04 * samples.range:
        return none
    away = np.abs(x - median_filter(x, size=5, mode="nearest"))
    usual = max(SD_OVER_MAD * float(np.median(away)), samples.noise, sd)
    limit = max(8.0 * usual, 0.04 * samples.range)
    rows = []
    for k in np.flatnonzero(away > limit):
        for width in (1, 2):  # one sample, or this one and a neighbor
            if _stands_out(samples, int(k), width, usual, speed):
                rows.append(int(k))
                break
    return np.array(rows, dtype=np.int64)


def _stands_out(samples: Samples, k: int, width: int, usual: float, speed: Samples | None) -> bool:
    x = samples.values
    for first in range(k - width + 1, k + 1):
        before, after = first - 1, first + width
        if before < 3 or after > len(x) - 4:
            continue
        line = x[before] + (x[after] - x[before]) * (k - before) / (after - before)
        off = abs(x[k] - line)
        around = np.concatenate(
            [samples.changes[before - 3 : before], samples.changes[after : after + 3]]
        )
        local = max(float(np.abs(around).max()), abs(x[after] - x[before]), usual)
        if off > ALONE * local:
            return speed is None or not _explain_rows(samples, k, speed, off)
    return False


def _explain_rows(samples: Samples, k: int, speed: Samples, off: float) -> bool:
    """Whether a speed that was measured makes the motion to a sample."""
    step = samples.times[k] - samples.times[k - 1]
    near = np.abs(speed.times - samples.times[k]) < 1.5 * step
    fastest = float(np.abs(speed.values[near]).max(initial=0.0)) if near.any() else np.inf
    return fastest * step > 0.3 * off


def _speed_of(signal: Signal, record: Record) -> Signal | None:
    """A channel that is the derivative of another one, by its unit and course."""
    if signal.unit not in ("m", "rad") or signal.scale != 1.0:
        return None
    for other in record.channels:
        if other.unit != f"{signal.unit}/s" or other.scale != 1.0:
            continue
        pairs = [(s, other.of_run(s.run)) for s in signal.runs]
        for s, v in pairs:
            if v is None or len(s) < FEW:
                continue
            slope = np.interp(v.times, s.times, np.gradient(s.values, s.times))
            both_move = np.ptp(slope) > 0.0 and np.ptp(v.values) > 0.0
            if both_move and np.corrcoef(slope, v.values)[0, 1] > 0.8:
                return other
    return None


def find_flat(record: Record) -> Iterator[Finding]:
    """Readings that end at one value, exactly."""
    known = (record.study.model or {}).get("ranges") or {}
    for signal in record.channels:
        if signal.name in known or len(signal.all_values) < 3 * FEW:
            continue
        for name, end in (("largest", signal.high), ("least", signal.low)):
            if (found := _flat_at(signal, end)) is None:
                continue
            count, stretches, is_noisy = found
            told = record.command_of(signal)
            goals = [c for c in record.commands if c is told or _is_goal(c, signal, stretches)]
            if any(_are_rests(command, stretches) for command in goals):
                continue
            times = [float(samples.times[first]) for samples, first, _ in stretches]
            scale = signal.scale or 1.0
            value = _si_at(record, signal, end)
            is_top = (name == "largest") == (scale > 0.0)  # in SI units
            low, high = ("-1e9", f"{value:.6g}") if is_top else (f"{value:.6g}", "1e9")
            yield Finding(
                signal.where,
                f"its {name} reading, {end:.6g}, comes {count} times in stretches, "
                f"{rows_shown(times)}: it shows no more",
                f"`ranges: {{{signal.name}: [{low}, {high}]}}` in the model, in SI units",
                is_noisy,
            )


def _si_at(record: Record, signal: Signal, end: float) -> float:
    """A reading in SI units."""
    at = next(i for i, c in enumerate(record.channels) if c is signal)
    for samples in signal.runs:
        k = int(np.argmin(np.abs(samples.values - end)))
        if samples.values[k] == end:
            return float(record.run(samples.run).measured[samples.at[k], at])
    return end


def _flat_at(signal: Signal, end: float) -> tuple[int, list[tuple[Samples, int, int]], bool] | None:
    """Samples at an end, stretches of them, and whether the channel is noisy elsewhere."""
    count, abrupt, parts, longest, inside = 0, 0, 0, 0, 0
    stretches = []
    equal = of = 0
    for samples in signal.runs:
        is_end = samples.values == end
        pair = ~(is_end[1:] | is_end[:-1])
        equal, of = equal + int((samples.changes[pair] == 0.0).sum()), of + int(pair.sum())
        at = np.flatnonzero(is_end)
        if not len(at):
            continue
        if _is_set(samples):  # there each value lasts, those at the ends as well
            continue
        count += len(at)
        for part in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1):
            if len(part) < 3:
                continue
            parts += 1
            inside += part[0] > 0 and part[-1] + 1 < len(samples)
            longest = max(longest, len(part))
            stretches.append((samples, int(part[0]), int(part[-1])))
            k = part[0] - 1
            if k >= 2:
                entry, before = abs(samples.changes[k]), abs(samples.changes[k - 1])
                abrupt += entry >= 4.0 * max(samples.digit, 1e-300) and entry >= 0.4 * before
    total = len(signal.all_values)
    if count < max(8, 0.01 * total) or count > 0.8 * total or not of:
        return None
    # what begins a run or stays to its end is at rest
    if (parts < 2 and longest < 8) or 2 * inside < parts:
        return None
    is_noisy = equal < 0.1 * of
    if not is_noisy and abrupt < 0.8 * parts:
        return None
    return count, stretches, is_noisy


def _is_set(samples: Samples) -> bool:
    """Whether values rest and jump, by far more than a coarse sensor's last digit."""
    jumps = np.abs(samples.changes[samples.changes != 0.0])
    is_coarse = not len(jumps) or float(np.median(jumps)) < 4.0 * samples.digit
    return not is_coarse and rest_and_jump([samples.values])


def find_frozen(record: Record) -> Iterator[Finding]:
    """A channel that stands still, exactly, while others move."""
    for signal in record.channels:
        for samples in signal.runs:
            if _is_stuck(signal, samples):
                yield Finding(
                    f"run {samples.run}",
                    f"channel {signal.name} shows {samples.low:.6g} in all {len(samples)} samples, "
                    "where its readings differ from row to row in other runs: it was stuck",
                    f"`columns: {{{signal.name}: null}}` in run {samples.run} leaves it out",
                    True,
                )
            if (found := _longest_stop(samples)) is None:
                continue
            first, last = found
            if _is_flat_top(signal, samples, first):
                continue
            start, end = float(samples.times[first]), float(samples.times[last])
            ends = float(samples.times[max(last - REACTION, first)])
            moving = record.moving(samples.run, start, end, signal, ends)
            is_free = _comes_free(record, signal, samples) is not None
            if _rests(record.command_of(signal), samples, first, last) and not is_free:
                continue
            if record.commands or len(record.channels) > 1:
                if moving is None and not is_free:
                    continue
            elif samples.shares_equal > 0.5:
                continue
            beside = "" if moving is None else f" while {moving.where} moves"
            yield Finding(
                f"run {samples.run}",
                f"channel {signal.name} stands still from {start:.6g} to {end:.6g} s, "
                f"{last - first + 1} equal samples{beside}",
                f"`missing_if: t >= {start:.6g} and t <= {end:.6g}` in run {samples.run} leaves "
                "them out",
                True,
            )


def _is_stuck(signal: Signal, samples: Samples) -> bool:
    """Whether a channel never changes in a run, and nearly always in others."""
    others = [s for s in signal.runs if s.range > 0.0 and len(s) >= FEW]
    is_still = len(samples) >= FEW and not samples.range > 0.0
    return is_still and bool(others) and all(s.shares_equal < NOISY for s in others)


def _are_rests(command: Signal, stretches: Sequence[tuple[Samples, int, int]]) -> bool:
    """Whether all stops are rests at goals, but for one: at a goal that was missed."""
    others = [stretch for stretch in stretches if not _rests(command, *stretch)]
    return len(others) <= 1 and all(_is_held(command, samples.run) for samples, _, _ in others)


def _is_goal(
    command: Signal, signal: Signal, stretches: Sequence[tuple[Samples, int, int]]
) -> bool:
    """Whether a command of a channel's unit asks for what the channel shows as it rests."""
    if command.unit != signal.unit or None in (command.unit, command.scale, signal.scale):
        return False
    scale = (signal.scale or 1.0) / (command.scale or 1.0)
    for samples, first, _ in stretches:
        told = command.of_run(samples.run)
        if told is None or not len(told):
            return False
        at = np.searchsorted(told.times, samples.times[first], "right") - 1
        off = abs(scale * samples.values[first] - told.values[at]) if at >= 0 else np.inf
        if not off <= SMALL * command.range:  # nothing was asked yet, or nobody knows what
            return False
    return True


def _is_held(command: Signal, run: str) -> bool:
    told = command.of_run(run)
    return told is not None and len(told) > 0 and told.shares_equal >= HELD


def _rests(command: Signal | None, samples: Samples, first: int, last: int) -> bool:
    """Whether a stop is no more than rest at a goal: the command of the channel keeps its value,
    or changes as the stop ends, from a goal that was taken or missed."""
    if command is None or (told := command.of_run(samples.run)) is None:
        return False
    if not _is_held(command, samples.run):
        return False
    step = float(np.median(np.diff(samples.times)))
    start, end = samples.times[first], samples.times[last]
    new = told.times[1:]
    inside = (told.changes != 0.0) & (new > start) & (new <= end + step)
    large = inside & (np.abs(told.changes) > SMALL * command.range)
    return not large.any() or bool((new[inside] >= end - REACTION * step).any())


def _longest_stop(samples: Samples) -> tuple[int, int] | None:
    """First and last place of the longest stretch of equal samples, if no chance makes it."""
    if len(samples) < 4 * FROZEN or not samples.range > 0.0:
        return None
    same = samples.changes == 0.0
    if not same.any():
        return None
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(np.int8), [0]])))
    starts, ends = edges[::2], edges[1::2]
    longest = int(np.argmax(ends - starts))
    first, last = int(starts[longest]), int(ends[longest])
    count = last - first
    if count < FROZEN:
        return None
    rest = np.ones(len(same), dtype=bool)
    rest[first:last] = False
    p = float(same[rest].mean()) if rest.any() else 1.0
    others = ends - starts
    second = int(np.sort(others)[-2]) if len(others) > 1 else 0
    moved = np.abs(samples.changes[samples.changes != 0.0])
    leap = abs(samples.changes[last]) if last < len(samples.changes) else 0.0
    jumps = leap > max(4.0 * float(np.quantile(moved, 0.9)), 3.0 * samples.digit)
    if p < 0.5 and count * np.log(max(p, 1e-3)) + np.log(len(same)) < np.log(CHANCE):
        # what comes to rest, or leaves it, changes by a few digits
        ends = np.abs(samples.changes[[k for k in (first - 1, last) if 0 <= k < len(same)]])
        is_abrupt = p < 0.1 and float(ends.max(initial=0.0)) > FEW_DIGITS * samples.digit
        return (first, last) if is_abrupt or jumps else None
    return (first, last) if jumps and count > 3 * second else None


def find_lines(record: Record) -> Iterator[Finding]:
    """Rows on straight lines between others, or equal to the one before: a higher rate."""
    found: dict[tuple[str, int], list[str]] = {}
    for signal in record.channels:
        if any(_repeats_of(record, samples) for samples in signal.runs):
            continue  # of a sensor that is slower than others
        rates = [r for r in (_rate_of(s) for s in signal.runs) if r is not None]
        moving = [s for s in signal.runs if len(s) >= 4 * FEW and s.range > 0.0]
        if rates and len(rates) >= 0.6 * len(moving) and len(set(rates)) == 1:
            found.setdefault(rates[0], []).append(signal.name)
    for (how, n), names in found.items():
        are = f"channel{'s' if len(names) > 1 else ''} {', '.join(names[:6])}"
        what = "on straight lines between others" if how == "line" else "equal to the one before"
        yield Finding(
            f"channel {names[0]}" if len(names) == 1 else "study",
            f"{are}: {n - 1} of {n} rows lie {what}, so that only each {n}th was measured",
            f"`defaults: {{every: {n}}}` uses those alone",
            how == "line",
        )


def find_repeats(record: Record) -> Iterator[Finding]:
    """A slow sensor beside quick ones: its readings are repeated under stamps that are not its."""
    for signal in record.channels:
        found = [_repeats_of(record, s) for s in signal.runs if len(s) >= 4 * FEW and s.range > 0.0]
        rates = [rate for rate in found if rate is not None]
        if rates and len(rates) >= 0.6 * len(found):
            yield Finding(
                signal.where,
                f"its readings are new in one of {float(np.median(rates)):.3g} rows, and repeated "
                "in between, while others change from row to row: one stamp for several sensors",
                f"`decode: {{repeats: drop}}` in {signal.where} keeps the first of each",
                True,
            )


def _repeats_of(record: Record, samples: Samples) -> float | None:
    """Rows from one new reading to the next, where these come as evenly as rows allow while another
    signal moves from row to row; None: they do not."""
    new = np.flatnonzero(samples.changes != 0.0)
    if len(new) < FEW or len(new) > MOST_NEW * len(samples):
        return None
    gaps = np.diff(new)
    usual = gaps[np.abs(gaps - np.median(gaps)) <= 1.0]
    rate = float(usual.mean())
    is_even = np.mean((gaps == np.floor(rate)) | (gaps == np.ceil(rate))) > EVEN
    # an encoder that turns evenly goes on by one count each time
    leaps = np.median(np.abs(samples.changes[new])) > 3.0 * samples.digit
    # quicker than their share of all rows: a pause is in it, not a slow sensor
    if not 1.0 / MOST_NEW <= rate <= MAX_RATE or not is_even or not leaps:
        return None
    others = (o for s in record.signals if (o := s.of_run(samples.run)) is not None)
    is_alone = not any(o.range > 0.0 and o.shares_equal < 1.0 - MOST_NEW for o in others)
    return None if is_alone else rate


def _rate_of(samples: Samples) -> tuple[str, int] | None:
    if len(samples) < 4 * FEW or not samples.range > 0.0:
        return None
    bends = np.abs(np.diff(samples.changes))
    for how, size, at_least in (("line", bends, 0.6), ("held", np.abs(samples.changes), 0.6)):
        total = float(size.sum())
        if not total > 0.0:
            continue
        for n in range(2, MAX_RATE + 1):
            whole = size[: len(size) // n * n].reshape(-1, n)
            if len(whole) < 10:
                break
            begun = whole[: LOOK // n].sum(0)
            if begun.max() < 0.9 * begun.sum():
                continue  # far faster to tell than of a long record
            by_phase = whole.sum(0)
            best = int(np.argmax(by_phase))
            if by_phase[best] < 0.97 * by_phase.sum():
                continue
            knots = whole[:, best]
            rest = float(np.quantile(np.delete(whole, best, axis=1), 0.9))
            if np.mean(knots > max(10.0 * rest, 1e-3 * knots.max())) >= at_least:
                return how, n
    return None


def find_lasting(record: Record) -> Iterator[Finding]:
    """Places that jump and stay: a marker that slipped, or was taken for another."""
    for signal in (s for s in record.channels if s.unit not in SPIKY):
        jumps = {
            samples.run: [
                k for k in _lasting(samples, signal) if _is_alone(record, signal, samples, k)
            ]
            for samples in signal.runs
        }
        if _cuts_off(signal, jumps):
            continue
        for samples in signal.runs:
            rows = jumps[samples.run]
            if rows and (stop := _comes_free(record, signal, samples)) is not None:
                rows = [k for k in rows if k not in (stop[0] - 1, stop[1])]
            if not 0 < len(rows) <= 3:
                continue
            k = rows[0]
            time, jump = float(samples.times[k + 1]), float(samples.changes[k])
            times = [float(samples.times[j + 1]) for j in rows]
            column = signal.column if signal.column.isidentifier() else f"`{signal.column}`"
            yield Finding(
                f"run {samples.run}",
                f"channel {signal.name} jumps by {jump:.4g} and stays, {rows_shown(times)}, while "
                "nothing else does: a marker that slipped, or was taken for another",
                f'`columns: {{{signal.name}: {{formula: "{column} - {jump:.4g}*(t >= {time:.6g})"}}'
                f"}}` in run {samples.run} moves it back, `until_s: {time:.6g}` ends before",
                signal.unit in PLACES,
            )


def _cuts_off(signal: Signal, jumps: Mapping[str, Sequence[int]]) -> bool:
    """Whether jumps of several runs, up and down, all begin or end where the readings end: a meter
    that reads nothing below some value; of a place they are a marker's, there and back."""
    if signal.unit in ("m", "rad"):
        return False
    sizes, aside, ends = [], [], np.array([signal.low, signal.high])
    for samples in (s for s in signal.runs if jumps.get(s.run)):
        for k in jumps[samples.run]:
            sides = (
                np.median(samples.values[k - 4 : k + 1]),
                np.median(samples.values[k + 1 : k + 6]),
            )
            sizes.append(sides[1] - sides[0])
            aside.append([min(abs(end - side) for side in sides) for end in ends])
    is_both = bool(sizes) and min(sizes) < 0.0 < max(sizes)
    is_of_all = sum(bool(rows) for rows in jumps.values()) > 1
    near = NEAR_AN_END * float(np.min(np.abs(sizes))) if sizes else 0.0
    return bool(is_both and is_of_all and (np.array(aside) < near).all(0).any())


def _comes_free(record: Record, signal: Signal, samples: Samples) -> tuple[int, int] | None:
    """First and last place of a stop where noise makes all others differ, and after which the
    channel leaps: a sensor was stuck, and shows the way it missed as it comes free."""
    if (found := _longest_stop(samples)) is None or _is_flat_top(signal, samples, found[0]):
        return None
    first, last = found
    moves = np.delete(samples.changes, np.arange(first, last))
    is_noisy = np.mean(moves == 0.0) < NOISY
    is_leap = last in _lasting(samples, signal) and _is_alone(record, signal, samples, last)
    return found if is_noisy and is_leap else None


def _is_flat_top(signal: Signal, samples: Samples, first: int) -> bool:
    return samples.values[first] in (signal.low, signal.high)


def _lasting(samples: Samples, signal: Signal) -> list[int]:
    change = np.abs(samples.changes)
    if len(samples) < FEW:
        return []
    least = max(0.05 * signal.range, 8.0 * samples.noise, 8.0 * signal.sd)
    out = []
    for k in np.flatnonzero(change > least):
        if not 4 <= k <= len(change) - 5:
            continue
        around = np.abs(samples.around(int(k), 4))
        if change[k] < (8.0 if signal.unit in PLACES else 25.0) * around.max():
            continue
        before, after = samples.values[k - 4 : k + 1], samples.values[k + 1 : k + 6]
        if abs(np.median(after) - np.median(before)) > 0.5 * change[k]:
            out.append(int(k))
    return out


def _is_alone(record: Record, signal: Signal, samples: Samples, k: int) -> bool:
    """Whether no command changes before a jump, and no other channel jumps with it."""
    start, end = samples.times[max(k - 4, 0)], samples.times[k + 1]
    for other in (*record.commands, *record.channels):
        of = other.of_run(samples.run)
        if other is signal or of is None or not other.range > 0.0:
            continue
        inside = (of.times >= start) & (of.times <= end)
        part = np.abs(np.diff(of.values[inside]))
        limit = 0.1 * other.range if other.role == "command" else np.inf
        if other.role == "channel":
            limit = max(8.0 * of.usual_change, 0.05 * other.range, 8.0 * of.noise)
        if len(part) and part.max() > limit:
            return False
    return True
