"""The answer in words: a headline of at most 25, and sentences with numbers and units."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from types import MappingProxyType

import numpy as np

from diffsim.diagnose.data_sheet import words_of
from diffsim.diagnose.gain import Gain
from diffsim.diagnose.gates import COARSE, FIRST_ANSWER, LATE, NUMERICS_GATES, REPEATS, GateResult
from diffsim.diagnose.judge import EXPLAINED, Decision
from diffsim.diagnose.noise import NoiseFloor
from diffsim.diagnose.records import (
    CERTAIN,
    DATA_SHEET,
    EFFECT,
    LIKELY,
    UNKNOWN,
    WRONG_SHEET,
    CauseRow,
    ErrorRow,
    Interval,
)
from diffsim.identify.effect import is_of_run

MAX_RIVALS = 3  # rival sets in a sentence; the page lists all
MAX_NAMES = 2  # names in the headline
MAX_OPEN = 9  # words for what cannot be told apart
MAX_WORDS = 25


@dataclass(frozen=True, eq=False)
class Answer:
    """What is put into words.

    Attributes:
        verdict: Verdict of the report.
        decision: Decision of the evidence behind it.
        causes: All causes with their status.
        rivals: Names of the rival sets.
        gates: Checks.
        noise: Noise floor of the fitted runs.
        named: Effects that the verdict names.
        best_names: Effects of the best set.
        beside: Name of an unknown cause that leads beside the named set; empty if none.
        chosen_by: What chose between causes.
    """

    verdict: str
    decision: Decision
    causes: tuple[CauseRow, ...]
    rivals: tuple[tuple[str, ...], ...]
    gates: tuple[GateResult, ...]
    noise: NoiseFloor
    named: tuple[str, ...] = ()
    best_names: tuple[str, ...] = ()
    beside: str = ""
    chosen_by: str = ""

    def told(self, *statuses: str, origin: str | None = None) -> list[CauseRow]:
        """Causes with a status, unknown ones left out."""
        return [
            row
            for row in self.causes
            if row.status in statuses
            and row.origin != UNKNOWN
            and (origin is None or row.origin == origin)
        ]


def headline(
    answer: Answer,
    errors: Sequence[ErrorRow],
    failed: Collection[str] = (),
    gained: Gain | None = None,
) -> str:
    """The answer in at most 25 plain words, error on test runs before and after.

    A smaller error is called a gain only where that is confirmed.

    Args:
        answer: What is put into words.
        errors: Errors on runs that were not fitted; none without such runs.
        failed: Runs that could not be simulated; errors are not quoted then.
        gained: Gain over all these errors; None: not known.
    """
    said = _said(answer)
    changed = any(row.helps or row.status in (CERTAIN, LIKELY) for row in _effects(answer))
    named = [row for row in _effects(answer) if row.name in answer.named]
    said_of = [row for row in named if row.status == CERTAIN] or named  # as `_missing` says them
    subject = "They take" if len(said_of) > 1 else "It takes"
    if failed:
        endings = [f"; run {min(failed)} could not be simulated", "; a run cannot be simulated"]
    else:
        endings = _on_unseen(errors, changed, subject, gained)
    # the error comes before details of the cause: a shorter beginning with it, if one fits
    for first, second in (*product(said, endings), *product(said, ("",))):
        text = f"{first}{second}."
        if len(text.split()) <= MAX_WORDS:
            return text
    return f"{said[-1]}."


def _said(answer: Answer) -> list[str]:
    """What is wrong, without a full stop; shorter ones later."""
    named = [
        r for r in answer.told(CERTAIN, LIKELY) if r.origin != EFFECT or r.name in answer.named
    ]
    if answer.verdict == "unrepeatable":
        return ["Repeats differ more than the sensor's noise, so no cause can be judged"]
    if answer.verdict == "numerical":
        return [
            "The simulation's own step, mesh or tolerance moves the prediction by more than noise"
        ]
    if answer.verdict == "unknown":
        return [
            "Something is missing that no cause of the library explains",
            "Something unknown is missing",
        ]
    if answer.verdict == "ambiguous":
        return _open(answer)
    if answer.verdict == "data_sheet":
        return _off_sheet([row for row in answer.causes if row.origin == DATA_SHEET])
    if named:
        return _missing(named)
    return ["Nothing is missing that these runs could show"]


def _open(answer: Answer) -> list[str]:
    """Sets of causes that cannot be told apart, without what they share."""
    sets = [answer.best_names, *answer.rivals]
    common = set(sets[0]).intersection(*sets[1:])
    parts = [[_plain(answer, n) for n in s if n not in common] for s in sets]
    names = list(dict.fromkeys(" with ".join(p) for p in parts if p))
    shown = " or ".join(names[:MAX_NAMES]) + (" or another cause" if len(names) > MAX_NAMES else "")
    if names and len(shown.split()) > MAX_OPEN:
        shown = f"{names[0]} or another cause"
    if not names or len(shown.split()) > MAX_OPEN:
        shown = "one of several causes"
    off = [
        w.removeprefix(WRONG_SHEET)
        for w in answer.decision.forms.values()
        if w.startswith(WRONG_SHEET)
    ]
    also = f" or {off[0]} is off its data sheet" if off else ""
    return [f"{_capital(shown)} is missing{also}; these runs cannot tell which"]


def _off_sheet(rows: Sequence[CauseRow]) -> list[str]:
    """Sentences on data sheets where no cause is missing, the longest first."""
    row = rows[0].as_read()
    value, unit = next(iter(row.size.values())), "" if row.unit == "-" else f" {row.unit}"
    prior = row.note.partition("data sheet: ")[2].partition(" +-")[0]
    others = "" if len(rows) == 1 else f" (and {len(rows) - 1} more)"
    which = "a data sheet is" if len(rows) == 1 else "data sheets are"
    off = f"{row.words} is {value.value:.3g}{unit}, not {prior}{unit}"
    return [f"Only {which} off: {off}{others}", f"{_opened(off)}{others}", _opened(off)]


def _missing(named: Sequence[CauseRow]) -> list[str]:
    """Sentences on causes that are named, the longest first."""
    sheet = [row for row in named if row.origin == DATA_SHEET]
    effects = [row for row in named if row.origin == EFFECT]
    effects = [row for row in effects if row.status == CERTAIN] or effects
    sure = "" if all(row.status == CERTAIN for row in effects) else " probably"
    words = [row.words for row in effects[:MAX_NAMES]]
    more = len(effects) - len(words)
    names = ", ".join(words) + f" and {more} more" if more else " and ".join(words)
    verb = "is" if len(effects) == 1 else "are"
    out = [f"{_capital(names)} {verb}{sure} missing"]
    if len(effects) <= MAX_NAMES and all(len(row.size) == 1 for row in effects):
        if len(effects) == 1 and _is_bare(effects[0]):
            out.insert(0, f"{out[0]} ({_range(effects[0])})")
        elif len(effects) > 1:
            sized = [f"{r.words} ({_range(r)})" if _is_bare(r) else r.words for r in effects]
            out.insert(0, f"{_capital(' and '.join(sized))} {verb}{sure} missing")
    if sheet:
        out.insert(0, f"{out[0]}, {sheet[0].words} is off its data sheet")
    return out


def _is_bare(row: CauseRow) -> bool:
    """Whether the words of a cause do not say its size themselves."""
    return row.words == words_of(row.name)


def _on_unseen(
    errors: Sequence[ErrorRow], changed: bool, subject: str, gained: Gain | None = None
) -> list[str]:
    """What becomes of the error, the longest first."""
    if not errors:
        return [". No gain is known: no run is kept for a test", "; no run tests it"]
    sure = gained is None or gained.status == "confirmed"
    row = _telling_kind(errors, changed, worst=gained is not None and gained.status == "withdrawn")
    where = "unseen runs" if row.use == "test" else "the runs that chose"
    before, after, noise = (f"{v:.3g}" for v in (row.before, row.after, row.noise))
    unit = "" if row.unit == "-" else f" {row.unit}"
    if not changed:
        return [f"; the error on {where} is {before}{unit}, noise {noise}{unit}"]
    if row.after > 0.99 * row.before:
        verb = "stays at" if row.after <= 1.01 * row.before else f"rises from {before} to"
        return [f"; but the error on {where} {verb} {after}{unit}, noise {noise}{unit}"]
    if not sure:
        change = f"{before} to {after}{unit}"
        return [
            f"; but no gain is confirmed on {where}: error {change}, noise {noise}{unit}",
            f"; no gain is confirmed: error {change}, noise {noise}",
            "; no gain is confirmed",
        ]
    return [
        f". {subject} the error on {where} from {before} to {after}{unit}; {noise}{unit} is noise",
        f": error on {where} {before} to {after}{unit}, noise {noise}{unit}",
        f": error {before} to {after}{unit}, noise {noise}",
    ]


def _telling_kind(errors: Sequence[ErrorRow], changed: bool, *, worst: bool) -> ErrorRow:
    """All runs together, of the kind of channel whose error falls most, or is largest, over its
    noise; the one that rises most where the whole gets worse."""
    kinds: dict[tuple[str, str], list[ErrorRow]] = {}
    for row in errors:
        kinds.setdefault((row.kind, row.unit), []).append(row)

    def pooled(rows: Sequence[ErrorRow]) -> ErrorRow:
        weights = [row.num_samples for row in rows]

        def rms(name: str) -> float:
            squares = [getattr(row, name) ** 2 for row in rows]
            return float(np.sqrt(np.average(squares, weights=weights)))

        first = rows[0]
        return ErrorRow(
            "all",
            first.kind,
            first.unit,
            rms("before"),
            rms("after"),
            rms("noise"),
            sum(weights),
            max(row.num_fitted for row in rows),
            first.use,
        )

    return max(
        (pooled(rows) for rows in kinds.values()),
        key=lambda r: (
            (-1.0 if worst else 1.0) * (r.before - (r.after if changed else 0.0)) / r.noise
        ),
    )


def sentences(
    answer: Answer,
    gained: Gain | None,
    unseen: Sequence[ErrorRow],
    failed: Mapping[str, str] = MappingProxyType({}),
) -> tuple[str, ...]:
    """Two to seven sentences with numbers and units.

    Args:
        answer: What is put into words.
        gained: Gain on test runs; None without such runs or without a name.
        unseen: Errors on test runs.
        failed: Runs that could not be simulated, by name, with why.
    """
    out = [_first(answer), *_data_sheets(answer), *_rest(answer)]
    if gained is not None:
        out.append(gained.words)
    elif failed:
        out += [
            f"Run {name} could not be simulated, so no gain is quoted: {why}"
            for name, why in failed.items()
        ]
    elif not any(row.use == "test" for row in unseen):
        out.append("No gain is known: no run is kept for a test (use: test).")
    if answer.chosen_by and answer.verdict not in ("numerical", "unrepeatable"):
        out.append(f"Names were held against the evidence and against {answer.chosen_by}.")
    if np.isnan(answer.noise.scatter_ratio).all():
        out.append("Repeatability was not judged: that needs repeats and a stated sensor noise.")
    out += [
        f"{g.name}: {g.value:g}, wanted {g.limit:g} ({g.note})."
        for g in answer.gates
        if g.applies
        and not g.passed
        and (g.name not in NUMERICS_GATES or answer.verdict != "numerical")
        and not g.name.startswith(REPEATS)
    ]
    first = (FIRST_ANSWER, COARSE, LATE)
    out += [f"A first answer: {g.note}." for g in answer.gates if g.name in first]
    return tuple(out)


def _first(answer: Answer) -> str:
    named = _effects(answer)
    sure = [row for row in named if row.name in answer.named]
    helping = [row for row in named if row.helps]
    if answer.verdict == "none":
        return "The misfit is noise: no effect of the library pays for itself."
    if answer.verdict == "data_sheet":
        return "The misfit is noise once a data sheet is mended: no cause is missing."
    if answer.verdict == "named":
        return f"The model lacks {_sizes(sure)}."
    if answer.verdict == "ambiguous":
        return (
            f"The data ask for {_sizes(_members(answer))}, but cannot tell it from "
            f"{_sets(answer.rivals)}."
        )
    if answer.verdict == "unknown":
        text = "Something real and repeatable is missing that the library does not hold"
        if helping:
            return f"{text}; {_sizes(helping)} helps, but is not named."
        mimics = _members(answer)
        return f"{text}; {_sizes(mimics)} would mimic part of it." if mimics else f"{text}."
    if answer.verdict == "unrepeatable":
        scatter = _scatter(answer.noise, answer.gates)
        return f"Repeats scatter {scatter}: the misfit is not a function of the command."
    failed = [g for g in answer.gates if not g.passed and g.name in NUMERICS_GATES]
    return (
        "The numerical settings move the record by "
        + ", ".join(f"{g.value:.1f} noise sd ({g.name})" for g in failed)
        + ": state finer ones in the model, or go on as they are with --accept-numerics."
    )


def _data_sheets(answer: Answer) -> list[str]:
    """One sentence per base parameter far off its data sheet."""
    out = []
    for row in (row.as_read() for row in answer.causes):
        if row.origin == DATA_SHEET:
            unit = "" if row.unit == "-" else f" {row.unit}"
            size = next(iter(row.size.values()))
            sheet = row.note.partition("data sheet: ")[2].partition(" (")[0]
            text = f"{_opened(row.words)} is {_ends(size)}{unit}, the data sheet says {sheet}{unit}"
            if row.rivals:
                text += f" (or {', '.join(row.rivals)} acts in its place)"
            out.append(f"{text}.")
    return out


def _rest(answer: Answer) -> list[str]:
    """What the names leave open."""
    decision, out = answer.decision, []
    open_ = [r for r in _effects(answer) if r.status not in (CERTAIN, LIKELY) and r.rivals]
    if answer.verdict == "named" and answer.rivals and open_:
        shared = set.intersection(*map(set, answer.rivals))
        apart = [tuple(n for n in names if n not in shared) for names in answer.rivals]
        out.append(f"What else acts cannot be told: {_sets([a for a in apart if a])}.")
    if answer.verdict in ("named", "ambiguous") and decision.best and decision.share < EXPLAINED:
        out.append(
            f"That explains {decision.share:.0%} of the misfit; what is left is no cause that "
            "repeats and evidence single out."
        )
    if answer.beside:
        out.append(
            f"With an {answer.beside} the evidence is {decision.lead:.0f} nats better: the names "
            "carry most of the misfit, but the record holds more than the library does."
        )
    return out


def _effects(answer: Answer) -> list[CauseRow]:
    return [row for row in answer.causes if row.origin == EFFECT]


def _members(answer: Answer) -> list[CauseRow]:
    """Effects of the best set."""
    return [row for row in _effects(answer) if row.name in answer.best_names]


def _plain(answer: Answer, name: str) -> str:
    return next((row.words for row in answer.causes if row.name == name), name)


def _scatter(noise: NoiseFloor, gates: Sequence[GateResult]) -> str:
    """Scatter in the channels, else in what was fitted to each run."""
    if not noise.is_repeatable:
        return f"{np.nanmax(noise.scatter_ratio):.2g} times as much as the sensor noise"
    failed = [g for g in gates if g.name.startswith(REPEATS) and not g.passed]
    worst = max(failed, key=lambda g: g.value)
    return f"in {worst.name.removeprefix(REPEATS)} {worst.value:.2g} times as much as was stated"


def _sets(rivals: Sequence[tuple[str, ...]]) -> str:
    """The nearest rival sets in words, and how many more there are."""
    shown = " or ".join(" with ".join(r) for r in rivals[:MAX_RIVALS])
    more = len(rivals) - MAX_RIVALS
    return shown if more <= 0 else f"{shown}, or {more} more {'sets' if more > 1 else 'set'}"


def _sizes(rows: Sequence[CauseRow]) -> str:
    """Causes with their 90 % intervals."""
    parts = []
    for row in (row.as_read() for row in rows):
        if len(row.size) > 1 and all(map(is_of_run, row.size)):
            parts.append(_by_run(row))
            continue
        sizes = ", ".join(
            f"{'' if len(row.size) == 1 else c + ' '}{_ends(size)}" for c, size in row.size.items()
        )
        unit = "" if row.unit == "-" else f" {row.unit}"
        parts.append(f"{row.name} ({sizes}{unit}; 90 % interval)")
    return " and ".join(parts)


def _by_run(row: CauseRow) -> str:
    """A size of each run: between which values they lie."""
    values = [size.value for size in row.size.values()]
    unit = "" if row.unit == "-" else f" {row.unit}"
    return f"{row.name} ({min(values):.3g} to {max(values):.3g}{unit} in {len(values)} runs)"


def _range(row: CauseRow) -> str:
    row = row.as_read()
    unit = "" if row.unit == "-" else f" {row.unit}"
    return f"{_ends(next(iter(row.size.values())))}{unit}"


def _ends(size: Interval) -> str:
    """Both ends with as many digits as tell them apart, two at least."""
    width = size.high - size.low
    for digits in range(2, 6):
        low, high = f"{size.low:.{digits}g}", f"{size.high:.{digits}g}"
        if low != high and abs(float(high) - float(low) - width) <= 0.25 * width:
            return f"{low} to {high}"
    return f"{size.value:.4g}"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _opened(name: str) -> str:
    """The name of a parameter at the begin of a sentence; m and M are two parameters."""
    return name if len(name.partition(" ")[0]) <= 2 else _capital(name)
