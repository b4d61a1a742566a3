"""What the columns of a folder look like: rules, each for one reason.

A rule looks at columns whose role is not known yet, gives some of them a role, and yields what it
guessed, a sentence each.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from itertools import combinations

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.units import to_si
from diffsim.data.clock_guess import is_counter, seconds_of
from diffsim.data.guess import Guess, GuessedColumn, listed
from diffsim.data.names import (
    DRIVING,
    GIVEN_OUT,
    IDLE,
    QUATERNION,
    SENSOR,
    VOLTAGE,
    is_command,
    is_motion,
    spelled,
    without_role,
)
from diffsim.data.signal import ROUND, rest_and_jump, scatter, step_of
from diffsim.data.table import GROUPED_DIGITS, is_number
from diffsim.data.table_guess import Column

_SET_UNITS = ("N", "Nm", "Pa", "V", "A", "Hz")  # what drives, rather than what moves
_SMOOTH = 1e-5  # standard deviation over the range: a sensor scatters by more
_ROUNDED = 0.5  # of a step between readings: so much scatters what was rounded, at most
_HELD = 0.5  # share of samples that repeat the one before, from which on a column looks commanded
_IS_HELD = "held for many samples"
MIN_EQUAL = 10  # samples: fewer may be equal by chance
_LARGE = 0.05  # of the range: changes of what is held and looks commanded
_CLEANER = 0.2  # of the noise of what follows it
# of all scatter: rows next to each other differ by so much where they have no order
_NO_ORDER = 0.5
_ALIKE = 0.7  # correlation of a motion with what it follows
_ORDERS = (2, 4, 6)  # of differences: noise is alike in all, a quick motion least in the last
_MOST_SAMPLES = 4000  # of a run, that are compared
_RARE = 3.0  # times the steps of the record: samples of a file of commands, held in between


def texts(guess: Guess) -> Iterable[str]:
    """Columns that hold no numbers, constants aside."""
    for c in guess.those(""):
        if not all(run.tables[c.place].is_number[c.column.name] for run in guess.runs):
            c.role = "text"
    facts = [c for c in guess.those("text") if not c.place and _constants(guess, c)]
    told = [c for c in facts if len(guess.runs) == 1 or len(set(_constants(guess, c))) > 1]
    for c in told:
        c.role = "fact"
    rest = [c for c in guess.those("text") if c.column.name]
    odd = {c.column.name: why for c in rest if (why := _odd_cell(guess, c))}
    yield from (f"a column of numbers that cannot be read, not used: {why}" for why in odd.values())
    rest = [c for c in rest if c.column.name not in odd]
    yield from listed(
        "texts and empty columns, not used", dict.fromkeys(c.column.name for c in rest)
    )


def _odd_cell(guess: Guess, c: GuessedColumn) -> str:
    """The first cell that is no number where most are; empty: it is a column of texts."""
    for run in guess.runs:
        filled = [cell for cell in run.texts(c) if cell]
        are_numbers = [is_number(c) or bool(GROUPED_DIGITS.fullmatch(c)) for c in filled]
        if 2 * sum(are_numbers) > len(filled):
            try:
                run.numbers(c)
            except ValueError as error:
                return str(error)
    return ""


def facts(guess: Guess) -> Iterable[str]:
    """Columns that are constant in each run; one that was commanded is a command all the same."""
    for c in guess.those(""):
        found = _constants(guess, c)
        is_asked = c.column.is_asked or is_command(c.column)
        if len(set(found)) == 1 < len(found) and (is_asked or c.place):
            c.role = "idle"
        elif found and not (is_asked and len(found) > 1):
            c.role = "fact"
    yield from listed("facts, constant in each run", [c.column.name for c in guess.those("fact")])
    idle = [c.column.name for c in guess.those("idle")]
    yield from listed("commands that are the same in all runs, not used", idle)


def counters_and_flags(guess: Guess) -> Iterable[str]:
    """Numbers of rows, further clocks, marks of what is valid."""
    for c in guess.those(""):
        run = guess.runs[0]
        rows = run.rows if not c.place else np.arange(len(run.tables[c.place]))
        is_count = is_counter(c.column, run.tables[c.place], rows)
        if is_count or IDLE.search(c.column.base) or _is_clock_again(guess, c):
            c.role = "idle"
    names = [c.column.name for c in guess.those("idle") if not _constants(guess, c)]
    return listed("counters and flags, not used (see missing_if)", names)


def _is_clock_again(guess: Guess, c: GuessedColumn) -> bool:
    """Whether a column repeats the clock of the runs, as Simulink's tout does."""
    clocks = [
        k for k in guess.those("clock") if guess.runs[0].tables[k.place].is_number[k.column.name]
    ]
    return any(
        np.array_equal(run.numbers(c), run.numbers(clock))
        for clock in clocks
        for run in guess.runs[:1]
    )


def sensed(guess: Guess) -> None:
    """What is called a sensor's, or is commanded in another file of the run."""
    asked = {c.column.name for c in guess.columns if c.column.is_asked}
    for c in guess.those(""):
        is_answer = not c.column.is_asked and c.column.name in asked
        if is_answer or (SENSOR.search(spelled(c.column.base)) and not c.column.is_asked):
            c.role = "channel"


def asked_for(guess: Guess) -> None:
    """Columns of a file or topic of commands, but for what was measured beside them."""
    how = "by its topic" if guess.kinds[0].files[0].is_topic else "by its file"
    for c in guess.those(""):
        if c.column.is_asked:
            is_reading = without_role(c.column.base)[1] == "measured"
            c.role, c.why = ("channel", "") if is_reading else ("command", how)


def named(guess: Guess) -> None:
    """Columns that are called commands; others that are called motions are none. A voltage may be
    either: where it is noisy, and another column is held, it answers to that."""
    drives = [c for c in guess.those("") if not is_motion(c.column) and _rests_or_sweeps(guess, c)]
    for c in guess.those(""):
        is_answer = drives and VOLTAGE.search(c.column.base) and not _is_smooth(guess.samples(c))
        is_named = is_command(c.column) and (c in drives or not is_answer)
        _decide(c, "by its name" if is_named else "")


def beside_measured(guess: Guess) -> None:
    """A column whose name another has, for the measured one: torque and torque_meas, q_d and q."""
    twins = {without_role(c.column.base): c for c in guess.columns if c.role in ("", "channel")}
    for c in guess.those(""):
        base = c.column.base.lower()
        plain = re.sub(r"_d(?=(_\d+)*$)", "", base)
        twin = twins.get((base, "measured")) or (twins.get((plain, "")) if plain != base else None)
        _decide(c, f"since {twin.column.name} is its measurement" if twin else "")


def held(guess: Guess) -> None:
    """What rests in some run, and sweeps without noise in others: where nothing is called a
    command, or what is called so does, in its unit: in_1 beside valve_1."""
    called = guess.those("command")
    units = {c.column.unit for c in called if _rests_or_sweeps(guess, c)}
    for c in guess.those(""):
        if not is_motion(c.column) and (not called or c.column.unit in units):
            _decide(c, _IS_HELD if _rests_or_sweeps(guess, c) else "")


def smooth(guess: Guess) -> None:
    """Where nothing is called a command: a unit of what drives, no noise but that of rounding."""
    for c in _of_no_motion(guess):
        unit = "" if c.column.unit is None else re.sub(r"[\s*·.]", "", to_si(c.column.unit).unit)
        if unit in _SET_UNITS and _is_smooth(guess.samples(c)):
            _decide(c, "by its lack of noise")


def equal_in_two_runs(guess: Guess) -> None:
    """Columns that two runs share to the last digit, which no sensor does; not copies of runs."""
    samples = {c: guess.samples(c) for c in guess.columns if c.role in ("", "command", "channel")}
    for i, k in combinations(range(len(guess.runs)), 2):
        alike = [c for c, values in samples.items() if _is_equal(values[i], values[k])]
        if alike and len(alike) < len(samples):
            for c in (c for c in alike if not c.role):
                if not is_motion(c.column) or _follower(guess, c, guess.those("")):
                    _decide(c, "equal to the digit in two runs")
            break


def followed(guess: Guess) -> None:
    """Where nothing looks commanded: what has little noise, and another of its unit follows."""
    open_ones = [c for c in guess.columns if c.role in ("", "channel")]
    if guess.those("command") or len(open_ones) < 2:
        return
    levels = {c: _level(guess.samples(c)) for c in open_ones}
    for c in open_ones:
        noisy = [other for other in open_ones if levels[c] < _CLEANER * levels[other]]
        if other := _follower(guess, c, noisy):
            c.role, c.why = "command", f"less noisy, and {other.column.name} follows it"


def driving(guess: Guess) -> None:
    """Where nothing looks commanded: what drives, such as a torque beside what moves."""
    open_ones = guess.those("")
    found = [c for c in open_ones if DRIVING.search(spelled(c.column.base))]
    is_rest = len(found) == len(open_ones) and not guess.those("channel")
    if not guess.those("command") and not is_rest:
        for c in found:
            c.role, c.why, c.is_measured = "command", "as what drives; it was measured", True


def channels(guess: Guess) -> None:
    """What is left was measured."""
    for c in guess.those(""):
        c.role = "channel"
    commands = guess.those("command")
    if not guess.those("channel") and commands:
        commands[-1].role = "channel"


def names_and_ends(guess: Guess) -> Iterable[str]:
    """Names, units, noise and ends of channels and commands."""
    chosen = [c for c in guess.columns if c.role in ("channel", "command")]
    taken: Counter[str] = Counter()
    for c in chosen:
        c.name = c.column.name if _keeps_name(c.column) else c.column.base
        if taken[c.name] and c.tag:
            c.name = f"{c.name}_{re.sub(r'[^A-Za-z0-9_]', '_', c.tag)}"
        if taken[c.name]:
            c.name = f"{c.name}_{sum(taken.values())}"
        taken[c.name] += 1
        c.unit = c.column.unit or "-"
        values = guess.samples(c)
        if c.role == "channel":
            c.sd = _noise(values)
            continue
        finite = np.concatenate([v[np.isfinite(v)] for v in values])
        if len(finite):
            c.lower, c.upper = float(finite.min()), float(finite.max())
        c.is_measured |= bool(GIVEN_OUT.search(c.column.base)) and c.why != _IS_HELD
        c.fill = _fill(guess, c) if c.place else ""
    yield from (f"command: {c.name}, {c.why}" for c in guess.those("command"))
    yield from listed("channels: what is left", [c.name for c in guess.those("channel")])


def to_be_stated(guess: Guess) -> None:
    """What no header says of channels and commands."""
    chosen = [c for c in guess.columns if c.role in ("channel", "command")]
    commands = guess.those("command")
    guess.todo += listed(
        "units, which the header does not state",
        [c.name for c in chosen if c.column.unit is None and not QUATERNION.match(c.column.base)],
        most=40,
    )
    if len({c.is_measured for c in commands}) == 2:
        guess.todo.append(
            "commands: some look asked for, some given out by a controller (is_measured); keep "
            "those that drive your model"
        )
    if not commands:
        guess.todo.append("commands: no column looks commanded; which of the channels did you set?")
    guess.todo.append(
        "sd of each channel: the noise is a guess from the scatter between samples"
        if guess.those("channel")
        else "channels: no column changes in any run; what did you measure?"
    )


COLUMN_RULES: tuple[Callable[[Guess], Iterable[str] | None], ...] = (
    texts,
    facts,
    counters_and_flags,
    sensed,
    asked_for,
    named,
    beside_measured,
    held,
    smooth,
    equal_in_two_runs,
    followed,
    driving,
    channels,
    names_and_ends,
    to_be_stated,
)


def _of_no_motion(guess: Guess) -> list[GuessedColumn]:
    """Open columns that are called no motion, where nothing is called a command."""
    if any(c.why != _IS_HELD for c in guess.those("command")):
        return []
    return [c for c in guess.those("") if not is_motion(c.column)]


def _rests_or_sweeps(guess: Guess, c: GuessedColumn) -> bool:
    """Whether a column rests in some run, and changes by more than a coarse sensor; where it does
    not rest it has no noise but that of rounding."""
    sweeps: list[Array] = []
    held: list[Array] = []
    for v in guess.samples(c):
        steps = np.abs(np.diff(v[np.isfinite(v)]))
        changes = steps[steps > 0.0]
        if len(changes) >= (1.0 - _HELD) * len(steps):
            sweeps.append(v)
        elif len(changes):
            held.append(changes)
    if not held:
        return False
    # of all runs together: one of few changes may have small ones
    usual = float(np.median(np.concatenate(held)))
    is_large = usual > _LARGE * _range(guess.samples(c))
    return is_large and (not sweeps or _is_smooth(sweeps))


def _decide(c: GuessedColumn, why: str) -> None:
    if why:
        c.role, c.why = "command", why


def _constants(guess: Guess, c: GuessedColumn) -> list[str]:
    """The constant of a column in each run; empty: it is none, or empty, in some run."""
    found = []
    for run in guess.runs:
        table = run.tables[c.place]
        if table.is_number[c.column.name]:
            values = run.numbers(c)
            values = values[np.isfinite(values)]  # some state a fact in their first row alone
            if not len(values) or not (values == values[0]).all():
                return []
            found.append(repr(float(values[0])))
        else:
            cells = set(run.texts(c))
            if len(cells) != 1 or "" in cells:
                return []
            found.append(cells.pop())
    return found


def _is_equal(a: Array, b: Array) -> bool:
    n = min(len(a), len(b))
    there = a[:n][np.isfinite(a[:n])]
    moves = n >= MIN_EQUAL and len(there) > 0 and bool(there.max() > there.min())
    return moves and np.array_equal(a[:n], b[:n], equal_nan=True)


def _range(values: Sequence[Array]) -> float:
    there = np.concatenate([v[np.isfinite(v)] for v in values])
    return float(np.ptp(there)) if len(there) else 0.0


def _is_smooth(values: Sequence[Array]) -> bool:
    """Whether what is left of a motion is rounding: differences, of the last digit."""
    there = np.concatenate([v[np.isfinite(v)] for v in values])
    # spikes of a sensor aside, which widen its range without end
    size = float(np.ptp(np.quantile(there, (0.005, 0.995)))) if len(there) else 0.0
    level = _level(values)
    step = step_of(np.concatenate(values)) or 0.0
    return level < max(_SMOOTH * size, _ROUNDED * step)


def _level(values: Sequence[Array]) -> float:
    """Noise as differences have it: what is left of a sweep in frequency is rounding."""
    return min(_levels(values, order) for order in _ORDERS[1:])


def _levels(values: Sequence[Array], order: int) -> float:
    left = np.concatenate([np.diff(v[np.isfinite(v)], n=order) for v in values])
    return float(scatter(left, order)) if len(left) else np.inf


def _follower(
    guess: Guess, c: GuessedColumn, others: Iterable[GuessedColumn]
) -> GuessedColumn | None:
    """The first of others, of its unit and file, that does a little later what a column did."""
    alike = (o for o in others if o is not c)
    alike = (o for o in alike if (o.column.unit, o.place) == (c.column.unit, c.place))
    return next((o for o in alike if _follows(guess.samples(o), guess.samples(c))), None)


def _follows(values: Sequence[Array], leader: Sequence[Array]) -> bool:
    """Whether a motion is like another one, and most like what that was some samples before."""
    later = 0
    for a, b in zip(values, leader, strict=True):
        n = min(len(a), len(b), _MOST_SAMPLES)
        there = np.isfinite(a[:n]) & np.isfinite(b[:n])
        a, b = a[:n][there], b[:n][there]
        if len(a) < MIN_EQUAL or not np.ptp(a) > 0.0 or not np.ptp(b) > 0.0:
            continue
        # of poses in no order none is later
        if np.corrcoef(a, b)[0, 1] < _ALIKE or scatter(np.diff(b), 1) > _NO_ORDER * np.std(b):
            return False
        # the rate of change tells later from earlier: a lag d makes a - b = -d db/dt
        slope = np.gradient(b)
        later += 1 if float(slope @ (a - b - np.mean(a - b))) < 0.0 else -1
    return later > 0


def _keeps_name(column: Column) -> bool:
    """Whether the header itself is a name for formulas, with an SI unit at its end or none."""
    if column.is_said or not re.fullmatch(r"[A-Za-z_]\w*", column.name, re.ASCII):
        return False
    return column.unit is None or to_si(column.unit)[1:] == (1.0, 0.0)


def _fill(guess: Guess, c: GuessedColumn) -> str:
    """How a command goes on between the samples of its own file, as far as they show."""
    time = guess.kinds[c.place].time
    if not time or guess.kinds[0].files[0].is_topic:
        return "hold"
    run = guess.runs[0]
    steps = [
        float(np.median(np.diff(seconds_of(run.tables[k], guess.kinds[k].time))))
        for k in (0, c.place)
    ]
    if c.column.is_asked and steps[1] > _RARE * steps[0]:
        return "hold"
    values = (v[np.isfinite(v)] for v in guess.samples(c))
    return "hold" if rest_and_jump(values) else "linear"


def _noise(values: Sequence[Array]) -> float | None:
    """Scatter from sample to sample, with two digits; at least that of rounding."""
    levels = []
    for v in values:
        here = v[np.isfinite(v)]  # a slow sensor leaves cells empty
        told = [float(scatter(np.diff(here, n=k), k)) for k in _ORDERS if len(here) >= 8 + k]
        if told:
            # a higher one where it is lower by more than chance: motion is in the lower ones
            less = 1.0 - 2.0 / np.sqrt(len(here))
            levels.append(reduce(lambda low, high: high if high < less * low else low, told))
    there = np.unique(np.concatenate([v[np.isfinite(v)] for v in values]))
    gaps = np.diff(there)
    # a range of doubles has no gap that is one: what is left adds nothing
    step = float(gaps[gaps > ROUND * np.ptp(there)].min(initial=np.inf)) if len(gaps) else 0.0
    level = max(float(np.median(levels)) if levels else 0.0, step / np.sqrt(12.0))
    return float(f"{level:.2g}") if level > 0.0 else None
