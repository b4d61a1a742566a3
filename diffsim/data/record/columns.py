"""Columns beside each other: copies, laws of a controller, units, cells that stand elsewhere."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import combinations, permutations

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.figures import counted, list_first
from diffsim.core.unit_slips import UNIT_SLIPS, UnitSlip
from diffsim.data.record.finding import Finding
from diffsim.data.record.signals import FEW, Record, Samples, Signal

_GAIN = re.compile(r"(?<![\w.])(\d+\.?\d*(?:e[-+]?\d+)?)\s*[*/]|[*/]\s*(\d+\.?\d*(?:e[-+]?\d+)?)")
OF_RANGE = 1e-3  # of the range, at most
EQUAL = 4e-6  # of the values: copies in a file of six digits differ by less
DISTINCT = 20  # values that a copy must show
PROBES = 64  # rows that are compared first
LAWFUL = 0.05  # of a channel's own scatter: what a law leaves of it where there is one
EFFORTS = ("N", "N m", "A", "V", "W", "-", None)  # SI units of what a controller gives out
SHIFTS = (0, 1, 2)  # rows by which a copy of a command may be late
GAIN_NEAR = 0.12  # of the logarithm of a factor: how well a gain must meet it
NOISE_NEAR = 0.35  # the same of the scatter from sample to sample
MOST_SPREAD = 0.3  # of the logarithm of gains: others are not alike
WINDOW = 20  # samples whose scatter is compared
FOLLOWS = 0.85  # share of the squares that a command explains of what follows it
LAGS = (2.0, 5.0, 12.0, 30.0, 80.0)  # rows by which a channel may follow
DIFFERS = 0.7  # of the logarithm of a factor, two: by more, others move by another one
# Of the logarithm of the factor itself: others change less by another pace of the motion, or as
# noise does. In flights that were called a unit, one of them is 0.4 of it away or more.
SHARES = 1.0 / 3.0
BIG = 20.0  # factor between units of a channel and its command: less may be a gain


def find_copies(record: Record) -> Iterator[Finding]:
    """Channels that are a copy of another column, scaled or late; each is said once."""
    told: set[str] = set()
    for first, second in combinations(tuple(record.signals), 2):
        channel, other = (second, first) if second.role == "channel" else (first, second)
        if channel.where in told:
            continue
        shifts = SHIFTS if other.role == "command" and channel.role == "channel" else (0,)
        for rows in shifts:
            made = _proportion(channel, other, rows)
            if made is not None:
                if (found := _copy(channel, other, rows, *made)) is not None:
                    told.add(channel.where)
                    yield found
                break


def _copy(
    channel: Signal, other: Signal, rows: int, times: float, is_moved: bool
) -> Finding | None:
    is_stated = None not in (channel.unit, other.unit)
    if channel.role == "command" and (not is_stated or channel.unit == other.unit):
        return None  # two drives may be given one course
    what = "equal to" if times == 1.0 else f"{times:.6g} times"
    late = f", {counted(rows, 'row')} late" if rows else ""
    late += ", but for a constant" if is_moved else ""
    return Finding(
        channel.where,
        f"its column {channel.column} is {what} column {other.column} of {other.where} in all "
        f"rows{late}: nothing was measured by it",
        f"`column:` of {channel.where} names the column that holds it, or take it out of "
        f"{channel.role}s",
        channel.column != other.column,
    )


def _proportion(a: Signal, b: Signal, rows: int) -> tuple[float, bool] | None:
    """How many times ``b`` makes ``a`` in all rows, and whether a constant is added; None: none
    does."""
    times: float | None = None
    is_moved = False
    shown = 0
    for x in a.runs:
        y = b.of_run(x.run)
        if y is None or len(x) != len(y):
            return None
        p, q = (x.values[rows:], y.values[: len(y) - rows])
        if len(p) < FEW:
            continue
        low, high = int(np.argmin(q)), int(np.argmax(q))
        span = q[high] - q[low]
        if not span > 0.0:
            if np.ptp(p) > 0.0:
                return None
            continue
        slope = float((p[high] - p[low]) / span) if times is None else times
        limit = EQUAL * max(float(np.abs(p).max()), abs(slope) * float(np.abs(q).max()))
        limit = min(limit, OF_RANGE * float(np.ptp(p)))  # a clock counts from long ago
        level = float(p[low] - slope * q[low])
        probe = slice(None, None, max(len(p) // PROBES, 1))
        if slope == 0.0 or np.abs(p[probe] - slope * q[probe] - level).max() > limit:
            return None
        if np.abs(p - slope * q - level).max() > limit:
            return None
        times = slope
        is_moved |= abs(level) > limit
        shown = max(shown, len(np.unique(p[:4096])))
    return (times, is_moved) if times is not None and shown >= DISTINCT else None


def find_laws(record: Record) -> Iterator[Finding]:
    """Channels that other columns of the same rows make, noise included: computed, not measured."""
    for channel in record.channels:
        others = [s for s in record.signals if s is not channel and s.range > 0.0]
        if not any(s.role == "channel" for s in others) or len(others) > 6:
            continue
        used = [s for s in channel.runs if len(s) > 60 and s.range > 0.0]
        if not used or not all(_is_law(channel, samples, others) for samples in used[:3]):
            continue
        names = ", ".join(s.name for s in others)
        is_effort = channel.unit in EFFORTS
        made = (
            "it is the controller's law and was not measured; nothing of the plant can be learned"
        )
        if not is_effort:
            made = "it was computed, as a speed is by differences; nothing more can be learned"
        acted = "; as what acted it may be a command with `is_measured: true`" if is_effort else ""
        yield Finding(
            channel.where,
            f"its column {channel.column} follows from {names} in the same rows, noise included: "
            f"{made} from it",
            f"take it out of `channels`{acted}",
            is_effort,
        )


def _is_law(channel: Signal, samples: Samples, others: Sequence[Signal]) -> bool:
    columns = [np.ones(len(samples) - 1)]
    for other in others:
        x = other.of_run(samples.run)
        if x is None or len(x) != len(samples):
            return False
        if not x.range > 0.0:
            continue
        columns.append(x.values[1:])
        if other.role == "channel":
            columns.append(x.values[:-1])
    matrix, y = np.column_stack(columns), samples.values[1:]
    if samples.noise < 1e-7 * samples.range:
        return False  # too smooth to tell what it was made of
    whole = matrix / np.abs(matrix).max(axis=0)
    made = whole @ np.linalg.lstsq(whole, y, rcond=None)[0]
    left = float(np.sqrt(np.mean((y - made) ** 2)))
    return left < LAWFUL * samples.noise


def find_units(record: Record) -> Iterator[Finding]:
    """A run in another unit than the others, or a channel in another one than its command."""
    found = False
    for channel in record.channels:
        for finding in _units_of_runs(record, channel):
            found = True
            yield finding
    if not found:
        yield from _units_of_commands(record)
        yield from _units_of_rates(record)


def _units_of_rates(record: Record) -> Iterator[Finding]:
    """Channels of a rate whose integral follows another channel, a factor between units apart."""
    for rate, place in permutations(record.channels, 2):
        if rate.unit != f"{place.unit}/s" or _has_gain(record, rate) or _has_gain(record, place):
            continue
        pairs = ((r, place.of_run(r.run)) for r in rate.runs)
        fits = [
            _best_rate(r.times, r.values * (rate.scale or 1.0), s.values * (place.scale or 1.0))
            for r, s in pairs
            if s is not None and len(r) >= FEW and np.array_equal(r.at, s.at) and s.range > 0.0
        ]
        if len(fits) < 2 or float(np.median([share for _, share in fits])) < FOLLOWS:
            continue
        times = max(float(np.median([slope for slope, _ in fits])), 1e-300)
        factor = _factor_near(float(np.log(times)), GAIN_NEAR, rate.unit)
        # a gear may be ten or a hundred, but hardly what a turn has degrees
        if factor is None or max(factor[0], 1.0 / factor[0]) < BIG or not factor[1].of:
            continue
        yield Finding(
            rate.where,
            f"it is {times:.4g} times as fast as {place.where} moves: another unit, by "
            f"{factor[1].words}, unless a gear is between them",
            f"`unit:` of {rate.where} states that of the file",
            False,
        )


def _best_rate(times: Array, rate: Array, place: Array) -> tuple[float, float]:
    """What the integral of a rate is times a place, beside a drift, and the share of its squares
    that the place explains."""
    steps = 0.5 * np.diff(times) * (rate[1:] + rate[:-1])
    way = np.concatenate([[0.0], np.cumsum(steps)])
    drift = np.column_stack([times - times[0], np.ones(len(times))])
    way, place = (x - drift @ np.linalg.lstsq(drift, x, rcond=None)[0] for x in (way, place))
    both, total, own = float(way @ place), float(way @ way), float(place @ place)
    if not min(total, own) > 0.0:
        return 0.0, 0.0
    return both / own, both**2 / (own * total)


def _units_of_runs(record: Record, channel: Signal) -> Iterator[Finding]:
    runs = _moving_runs(channel)
    if len(runs) < 3:
        return
    gains = np.array([_gain(record, s) for s in runs])
    noises = np.log(np.array([max(s.noise, 1e-300) for s in runs]))
    levels = np.array([abs(float(np.median(s.values))) for s in runs])
    is_level = bool(np.median(levels) > np.median([s.range for s in runs]))
    sizes = np.log(np.maximum(levels, 1e-300)) if is_level else gains
    for i, samples in enumerate(runs):
        rest = np.arange(len(runs)) != i
        usual = float(np.median(sizes[rest]))
        spread = float(np.median(np.abs(sizes[rest] - usual)))
        off, off_noise = sizes[i] - usual, noises[i] - float(np.median(noises[rest]))
        spread_noise = float(np.abs(noises[rest] - np.median(noises[rest])).max())
        if spread > MOST_SPREAD or abs(off) < 1.5 + 4.0 * spread:
            continue
        near = max(GAIN_NEAR, 1.5 * spread) if is_level else GAIN_NEAR + 2.0 * spread
        factor = _factor_near(off, near, channel.unit)
        if factor is None:
            continue
        times, words = factor[0], factor[1].words
        beside = abs(off_noise - np.log(times))
        # one that is sharp needs no noise that says so, too
        is_sharp = max(spread, abs(off - np.log(times))) < GAIN_NEAR
        if beside > max(NOISE_NEAR, 1.5 * spread_noise) + spread:
            continue
        if not is_sharp and beside > abs(off_noise):
            continue  # where runs differ anyway, noise nearer to unchanged than to the factor
        if _sensor_step(samples) in {_sensor_step(s) for s in runs if s is not samples} - {None}:
            continue  # another unit would have scaled it, too
        if _others_differ(
            off, [_off_usual(record, c, samples.run) for c in _beside(record, channel)]
        ):
            continue
        yield Finding(
            f"run {samples.run}",
            f"channel {channel.name} is about {np.exp(off):.3g} times what it is in other runs, "
            f"its noise too: another unit, by {words}",
            f"`columns: {{{channel.name}: {{column: {channel.column}, scale: {1.0 / times:.6g}}}}}`"
            f" in run {samples.run}, or {{column, unit: ...}}",
            True,
        )


def _moving_runs(channel: Signal) -> list[Samples]:
    return [s for s in channel.runs if len(s) >= FEW and s.range > 0.0]


def _beside(record: Record, channel: Signal) -> list[Signal]:
    return [c for c in record.channels if c is not channel]


def _off_usual(record: Record, channel: Signal, run: str) -> float:
    """Logarithm of how much more a channel moves in a run than it usually does; 0 where others are
    not alike."""
    gains = {s.run: _gain(record, s) for s in _moving_runs(channel)}
    rest = [gain for name, gain in gains.items() if name != run]
    if run not in gains or not rest:
        return 0.0
    usual = float(np.median(rest))
    spread = float(np.median(np.abs(np.array(rest) - usual)))
    return gains[run] - usual if spread <= MOST_SPREAD else 0.0


def _others_differ(off: float, others: Sequence[float]) -> bool:
    """Whether what changes is the motion: another channel changes as well, by another factor that
    is about as large.
    """
    least = max(DIFFERS, SHARES * abs(off))
    return any(min(abs(other), abs(other - off)) > least for other in others)


def _sensor_step(samples: Samples) -> float | None:
    """Step of a sensor in five digits; None where there is none, or a file's last decimal."""
    step = samples.step
    leading = 0.0 if step is None else step / 10.0 ** np.floor(np.log10(step) + 1e-6)
    return float(f"{step:.4e}") if step and abs(leading - 1.0) > 1e-4 else None


def _gain(record: Record, samples: Samples) -> float:
    """Logarithm of a channel's range over that of what was commanded."""
    drive = 1.0
    for command in record.commands:
        of = command.of_run(samples.run)
        if of is not None and command.range > 0.0 and of.range > 0.0:
            drive = of.range / command.range
            break
    low, high = np.quantile(samples.values, [0.02, 0.98])
    return float(np.log(max(high - low, 1e-300) / drive))


def _factor_near(off: float, within: float, unit: str | None) -> tuple[float, UnitSlip] | None:
    """The factor between units of a quantity whose logarithm is next to this one, and of which."""
    slips = [u for u in UNIT_SLIPS if u.suits(unit)]
    ways = [(s * np.log(u.ratio), u.ratio**s, u) for u in slips for s in (1, -1)]
    log, times, slip = min(ways, key=lambda way: abs(way[0] - off))
    return (float(times), slip) if abs(log - off) < within else None


def _units_of_commands(record: Record) -> Iterator[Finding]:
    """Channels that follow a command of the same unit, a factor between units apart."""
    for channel in record.channels:
        if _has_gain(record, channel):
            continue
        for command in record.commands:
            if (
                channel.unit in (None, "-")  # of what has no unit nothing is known
                or channel.unit != command.unit
                or not _is_far(channel, command)
            ):
                continue
            fits = [
                _best_fit(u.values * (command.scale or 1.0), y.values * (channel.scale or 1.0))
                for y in channel.runs
                if (u := command.of_run(y.run)) is not None
                and len(u) == len(y)
                and u.range > 0.05 * command.range > 0.0
            ]
            if len(fits) < 2 or float(np.median([share for _, share in fits])) < FOLLOWS:
                continue
            times = float(np.median([slope for slope, _ in fits]))
            factor = _factor_near(float(np.log(times)), 0.2, channel.unit)
            if factor is None or not (factor[0] > BIG or factor[0] < 1.0 / BIG):
                continue
            yield Finding(
                channel.where,
                f"it follows command {command.name}, of the same unit, {times:.4g} times as far: "
                f"another unit, by {factor[1].words}",
                f"`unit:` of {channel.where} states that of the file, or "
                f"`scale: {1.0 / factor[0]:.6g}`",
                True,
            )
            return


def _is_far(channel: Signal, command: Signal) -> bool:
    """Whether ranges are so far apart that a factor between units may be the reason."""
    a = channel.range * abs(channel.scale or 1.0)
    b = command.range * abs(command.scale or 1.0)
    return a > 0.0 < b and abs(np.log(a / b)) > np.log(0.4 * BIG)


def _best_fit(u: Array, y: Array) -> tuple[float, float]:
    """Static gain from a command to what follows it, and the share of the squares explained."""
    from scipy.signal import lfilter  # dear to load

    rest = u - u[0]
    ways = [rest, *(lfilter([1.0 / n], [1.0, 1.0 / n - 1.0], rest) for n in LAGS)]
    matrix = np.column_stack([*ways, np.ones(len(u))])
    scale = np.abs(matrix).max(axis=0)
    weights = np.linalg.lstsq(matrix / scale, y, rcond=None)[0] / scale
    left = float(np.sum((y - matrix @ weights) ** 2))
    total = float(np.sum((y - y.mean()) ** 2))
    return abs(float(weights[:-1].sum())), 1.0 - left / total if total > 0.0 else 0.0


def _has_gain(record: Record, channel: Signal) -> bool:
    """Whether the model's reading multiplies by a number as large as a factor between units."""
    readings = (record.study.model or {}).get("readings")
    text = str(readings.get(channel.name, "")) if isinstance(readings, dict) else str(readings)
    numbers = [float(n) for pair in _GAIN.findall(text) for n in pair if n]
    return any(n >= BIG or 0.0 < n <= 1.0 / BIG for n in numbers)


def find_unit_changes(record: Record) -> Iterator[Finding]:
    """A unit that changes within a run."""
    for channel in record.channels:
        for samples in channel.runs:
            if (found := _change_of(record, channel, samples)) is None:
                continue
            k, times, words = found
            time = float(samples.times[k])
            column = channel.column if channel.column.isidentifier() else f"`{channel.column}`"
            yield Finding(
                f"run {samples.run}",
                f"channel {channel.name} is {times:.3g} times as large from {time:.6g} s on, its "
                f"noise too: its unit changes there, by {words}",
                f'`columns: {{{channel.name}: {{formula: "{column}*({1.0 / times:.6g} if t >= '
                f'{time:.6g} else 1)"}}}}` in run {samples.run}, or `until_s: {time:.6g}`',
                True,
            )


def _change_of(record: Record, channel: Signal, samples: Samples) -> tuple[int, float, str] | None:
    x, n = samples.values, len(samples)
    if n < 4 * WINDOW or samples.largest_change < 0.02 * samples.range:
        return None
    bends = np.abs(np.diff(samples.changes))
    for k in _places_of_change(samples, bends):
        left, right = bends[: k - 2], bends[k + 1 :]
        noise = _log_ratio(right, left)
        factor = _factor_near(noise, NOISE_NEAR, channel.unit)
        if factor is None or abs(np.log(factor[0])) < 1.5:
            continue
        near = _log_ratio(right[:WINDOW], left[-WINDOW:])
        drive = _drive_change(record, samples.run, float(samples.times[k]))
        if abs(near - np.log(factor[0])) > 0.8 or abs(drive) > 1.0:
            continue
        times = factor[0]
        # speeds of few counts scatter by these, and all the more near zero
        if _level_change(x, k) / np.log(times) < 0.5:
            continue
        if _others_differ(noise, [_off_at(c, samples, k) for c in _beside(record, channel)]):
            continue
        before = float(np.abs(samples.changes[max(k - 6, 0) : k - 1]).max(initial=0.0))
        after = float(np.abs(samples.changes[k : k + 6]).max(initial=0.0))
        pace = max(before, after / times, 1e-300)
        jump = abs(x[k] - x[k - 1])
        if abs(x[k] / times - x[k - 1]) > 3.0 * pace:
            continue
        is_clear = 3.0 * pace < abs(x[k - 1]) and jump > 3.0 * max(before, after)
        if is_clear or (_is_driven(record, samples.run) and abs(np.log(times)) > np.log(BIG)):
            # what is not driven comes to rest, and its noise with it
            return k, times, factor[1].words
    return None


def _level_change(x: Array, k: int) -> float:
    """Logarithm of how much farther from zero a channel gets from a sample on."""
    before, after = (max(float(np.quantile(np.abs(part), 0.9)), 1e-300) for part in (x[:k], x[k:]))
    return float(np.log(after / before))


def _off_at(channel: Signal, samples: Samples, k: int) -> float:
    """Logarithm of how much more a channel scatters right after a sample of another one."""
    of = channel.of_run(samples.run)
    if of is None or len(of) < 4 * WINDOW:
        return 0.0
    bends = np.abs(np.diff(of.changes))
    at = int(
        np.clip(np.searchsorted(of.times, samples.times[k]), WINDOW + 2, len(bends) - WINDOW - 1)
    )
    left, right = bends[at - 2 - WINDOW : at - 2], bends[at + 1 : at + 1 + WINDOW]
    return _log_ratio(right, left) if min(np.median(left), np.median(right)) > 0.0 else 0.0


def _places_of_change(samples: Samples, bends: Array) -> list[int]:
    """Rows at which a unit may change: the largest jumps, and where the scatter changes most."""
    places = set((np.argsort(-np.abs(samples.changes))[:6] + 1).tolist())
    logs = np.log(np.maximum(bends, 1e-300))
    total = np.concatenate([[0.0], np.cumsum(logs)])
    mean = (total[WINDOW:] - total[:-WINDOW]) / WINDOW
    step = np.abs(mean[WINDOW:] - mean[:-WINDOW])
    middle = int(np.argmax(step)) + WINDOW
    near = np.arange(max(middle - 4, 1), min(middle + 5, len(samples.changes)))
    places |= set((near[np.argsort(-np.abs(samples.changes[near]))][:4] + 1).tolist())
    return sorted(k for k in places if WINDOW + 2 < k < len(samples) - WINDOW - 2)


def _is_driven(record: Record, run: str) -> bool:
    return any((u := c.of_run(run)) is not None and u.range > 0.0 for c in record.commands)


def _log_ratio(a: Array, b: Array) -> float:
    return float(np.log(np.median(a) + 1e-300) - np.log(np.median(b) + 1e-300))


def _drive_change(record: Record, run: str, time: float) -> float:
    """Logarithm of how much more commands move after a time than before."""
    logs = [0.0]
    for command in record.commands:
        of = command.of_run(run)
        if of is None or not of.range > 0.0:
            continue
        before, after = of.values[of.times < time], of.values[of.times >= time]
        if len(before) > 2 and len(after) > 2:
            logs.append(float(np.log((np.ptp(after) + 1e-12) / (np.ptp(before) + 1e-12))))
    return max(logs, key=abs)


def find_shifted(record: Record) -> Iterator[Finding]:
    """Rows from which on cells stand in the next column."""
    signals = [s for s in record.signals if s.range > 0.0]
    if len(signals) < 2:
        return
    for run in record.study.runs:
        of = [(s, x) for s in signals if (x := s.of_run(run.name)) is not None and len(x) > 40]
        if len(of) < 2 or len({len(x) for _, x in of}) > 1:
            continue
        if (found := _shift_at([x for _, x in of])) is None:
            continue
        k, sources = found
        ways = [f"{of[a][0].column} where {of[b][0].column} ended" for a, b in sources.items()]
        time = float(of[0][1].times[k])
        yield Finding(
            f"run {run.name}",
            f"from row {int(of[0][1].at[k]) + 1} ({time:.6g} s) on, columns go on where others "
            f"ended ({list_first(ways, 4)}): cells are shifted, or markers exchanged",
            f"mend the file, or `until_s: {time:.6g}` in run {run.name} ends before",
            True,
        )


def _shift_at(of: Sequence[Samples]) -> tuple[int, dict[int, int]] | None:
    """Row from which on columns hold what others held, and which hold which."""
    loudest = max(of, key=lambda x: x.largest_change / max(x.usual_change, 1e-300))
    for j in np.argsort(-np.abs(loudest.changes))[:3]:
        k = int(j) + 1
        if not 15 < k < len(loudest) - 15:
            continue
        sources: dict[int, int] = {}
        leaping = [a for a, now in enumerate(of) if _leaps(now, k)]
        for a in leaping:
            now = of[a]
            own = _distance(now, now, k)
            ways = [(_distance(now, before, k), b) for b, before in enumerate(of) if b != a]
            least, b = min(ways)
            if least < 4.0 and own > 5.0 * max(least, 0.3):
                sources[a] = b
        if len(leaping) == len(sources) == len(set(sources.values())) >= 2:
            return k, sources
    return None


def _leaps(samples: Samples, k: int) -> bool:
    """Whether a column leaps before a row, by far more than it moves on either side."""
    before = np.abs(samples.changes[max(k - 12, 0) : k - 1])
    after = np.abs(samples.changes[k : k + 11])
    return bool(abs(samples.changes[k - 1]) > 4.0 * max(before.max(), after.max()))


def _distance(now: Samples, before: Samples, k: int) -> float:
    """How far a column after a row is from another one before it, in usual changes of that one."""
    size = float(np.abs(before.changes[max(k - 12, 0) : k - 1]).max(initial=0.0))
    after = float(np.abs(now.changes[k : k + 11]).max(initial=0.0))
    level = max(size, 1e-9 * abs(before.values[k - 1]), 1e-300)
    pace = max(np.log(max(after, 1e-300) / level), np.log(level / max(after, 1e-300)))
    return float(abs(now.values[k] - before.values[k - 1]) / level + max(pace - 1.6, 0.0) * 4.0)
