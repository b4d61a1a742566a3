"""The answer in a headline of at most 25 words."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from diffsim.core.units import after_number
from diffsim.diagnose.checks.gates import LAWS
from diffsim.diagnose.judge.data_sheet import words_of
from diffsim.diagnose.judge.gain import Gain
from diffsim.diagnose.judge.preconditions import FIRST_ANSWER
from diffsim.diagnose.judge.records import (
    CERTAIN,
    DATA_SHEET,
    EFFECT,
    LIKELY,
    SKILL,
    WRONG_DATA_SHEET,
    CauseRow,
    ErrorRow,
)
from diffsim.diagnose.say.wording import (
    Answer,
    capital,
    effects_of,
    opened,
    plain_name,
    size_range,
)

MAX_NAMES = 2  # names in the headline
MAX_OPEN = 9  # words for what cannot be told apart
MAX_WORDS = 25
_PLURALS = ("pulses",)  # of causes that are several things


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
    said = _say_findings(answer)
    changed = any(row.helps or row.status in (CERTAIN, LIKELY) for row in effects_of(answer))
    changed = changed or answer.before_test is not None  # what was taken back made a change
    named = [row for row in effects_of(answer) if row.name in answer.named]
    certain = [row for row in named if row.status == CERTAIN]
    said_of = [*certain, *_larger(certain, named)] or named  # as `_missing` says them
    subject = "They take" if _are_several(said_of) else "It takes"
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


def judged_headline(errors: Sequence[ErrorRow], gained: Gain | None, *, extended: bool) -> str:
    """The errors of a saved model on new runs in a sentence.

    Args:
        errors: Errors on the runs; none where no run could be simulated.
        gained: Gain over all of them; None: not known.
        extended: Whether the model names a cause.
    """
    if not errors:
        return "No run could be simulated."
    ends = _on_unseen(errors, extended, "The extended model takes", gained)
    return f"{capital(ends[0].lstrip('.; ').removeprefix('but '))}."


def _say_findings(answer: Answer) -> list[str]:
    """What is wrong, without a full stop; shorter ones later."""
    named = [
        r
        for r in answer.causes_with(CERTAIN, LIKELY)
        if r.origin != EFFECT or r.name in answer.named
    ]
    if answer.verdict == "unrepeatable":
        return ["Repeats differ more than the sensor's noise, so no cause can be judged"]
    if answer.verdict == "numerical":
        return [
            "The simulation's own step, mesh or tolerance moves the prediction by more than noise"
        ]
    if answer.verdict == "unknown" and any(gate.name == LAWS for gate in answer.gates):
        return [
            "Not yet: no cause of the library explains it, and laws were not looked for",
            "Not yet: no cause of the library explains it",
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
    if not any(answer.rivals) and not answer.decision.forms:
        return _unsure(answer)
    common = set(sets[0]).intersection(*sets[1:])
    place = {row.name: k for k, row in enumerate(answer.causes)}  # what removes most comes first
    sets = [tuple(sorted(s, key=lambda n: place.get(n, len(place)))) for s in sets]
    parts = [[_brief(plain_name(answer, n)) for n in s if n not in common] for s in sets]
    names = list(dict.fromkeys(" with ".join(p) for p in parts if p))
    shown = " or ".join(names[:MAX_NAMES]) + (" or another cause" if len(names) > MAX_NAMES else "")
    if names and len(shown.split()) > MAX_OPEN:
        shown = f"{names[0]} or another cause"
    if not names or len(shown.split()) > MAX_OPEN:
        shown = "one of several causes"
    off = [
        w.removeprefix(WRONG_DATA_SHEET)
        for w in answer.decision.forms.values()
        if w.startswith(WRONG_DATA_SHEET)
    ]
    also = f" or {off[0]} is off its data sheet" if off else ""
    return [f"{capital(shown)} is missing{also}; these runs cannot tell which"]


def _unsure(answer: Answer) -> list[str]:
    """Causes that the data ask for, where nothing but their absence is a rival."""
    named = [row for row in effects_of(answer) if row.name in answer.best_names]
    return [f"{said}; these runs leave it open" for said in _missing(named, "may be")]


def _off_sheet(rows: Sequence[CauseRow]) -> list[str]:
    """Sentences on data sheets where no cause is missing, the longest first."""
    row = rows[0].as_read()
    value, unit = next(iter(row.size.values())).value, after_number(row.unit)
    prior = row.note.partition("data sheet: ")[2].partition(" +-")[0]
    number = next((n for d in (3, 4, 5) if (n := f"{value:.{d}g}") != prior), f"{value:.6g}")
    others = "" if len(rows) == 1 else f" (and {len(rows) - 1} more)"
    which = "a data sheet is" if len(rows) == 1 else "data sheets are"
    off = f"{row.words} is {number}{unit}, not {prior}{unit}"
    return [f"Only {which} off: {off}{others}", f"{opened(off)}{others}", opened(off)]


def _missing(named: Sequence[CauseRow], verb: str = "") -> list[str]:
    """Sentences on causes that are named, the longest first.

    Args:
        named: Causes, data sheets among them.
        verb: Before "missing"; empty: as sure and as many as they are.
    """
    sheet = [row for row in named if row.origin == DATA_SHEET]
    effects = [row for row in named if row.origin == EFFECT]
    effects.sort(key=lambda row: -(row.removes or 0.0))
    certain = [row for row in effects if row.status == CERTAIN]
    larger = _larger(certain, effects)
    effects = certain or effects
    sure = "" if certain else " probably"
    ending = f"{verb or ('are' if _are_several(effects) else 'is') + sure} missing"
    out = [*_with_sizes(effects, ending), *_without_sizes(effects, ending)]
    if larger:
        also = " and ".join(_brief(row.words) for row in larger[:MAX_NAMES])
        out = [*(f"{said}, and probably {also}" for said in out), f"{out[-1]}, and probably more"]
    if why := "" if verb else _why_not_certain(effects):
        out = [*(f"{said}, as {why}" for said in out), *out]
    if sheet:
        out = [*(f"{said}, {sheet[0].words} is off its data sheet" for said in out), *out]
    return out


def _larger(certain: Sequence[CauseRow], effects: Sequence[CauseRow]) -> list[CauseRow]:
    """Likely causes that remove more than a certain one that is named."""
    if not certain:
        return []
    least = min(row.removes or 0.0 for row in certain)
    return [row for row in effects if row not in certain and (row.removes or 0.0) > least]


def _why_not_certain(effects: Sequence[CauseRow]) -> str:
    """The first reason; that an answer is a first one is said elsewhere."""
    doubts = (why for row in effects for why in row.doubts if why != FIRST_ANSWER)
    return next(doubts, "")


def _with_sizes(effects: Sequence[CauseRow], ending: str) -> list[str]:
    """Names with the sizes that their words do not say, the longest first; none of many causes."""
    sized = {row.name for row in effects if row.size and row.words == words_of(row.name)}
    if not sized or len(effects) > MAX_NAMES:
        return []
    out = []
    for brief in (False, True):
        ranges = [f" ({size_range(r, brief=brief)})" if r.name in sized else "" for r in effects]
        if len(effects) == 1:
            out.append(f"{capital(effects[0].words)} {ending}{ranges[0]}")
        else:
            parts = (
                f"{_brief(row.words)}{size}" for row, size in zip(effects, ranges, strict=True)
            )
            out.append(f"{capital(' and '.join(parts))} {ending}")
    return list(dict.fromkeys(out))


def _without_sizes(effects: Sequence[CauseRow], ending: str) -> list[str]:
    """Names alone, the longest first."""
    words = [_brief(row.words) for row in effects[:MAX_NAMES]]
    more = len(effects) - len(words)
    names = ", ".join(words) + f" and {more} more" if more else " and ".join(words)
    out = [f"{capital(names)} {ending}"]
    if len(effects) == 1 and effects[0].words != words[0]:
        out.insert(0, f"{capital(effects[0].words)}, {ending}")
    return out


def _are_several(rows: Sequence[CauseRow]) -> bool:
    """Whether what is missing is several things."""
    return len(rows) > 1 or any(row.words.startswith(_PLURALS) for row in rows)


def _brief(words: str) -> str:
    """Words of a cause without what they say after a comma."""
    return words.partition(",")[0]


def _on_unseen(
    errors: Sequence[ErrorRow], changed: bool, subject: str, gained: Gain | None = None
) -> list[str]:
    """What becomes of the error, the longest first."""
    if not errors:
        return [". No gain is known: no run is kept for a test", "; no run tests it"]
    sure = gained is None or gained.status == "confirmed"
    row = _telling_kind(errors, changed, worst=gained is not None and gained.status == "withdrawn")
    where = "unseen runs" if row.use == "test" else "the runs that chose"
    before, after, unit, noise = _numbers(row)
    besides = f", noise {noise}" if noise else ""
    if not changed:
        return [
            f"; the error on {where} is {before}{unit}{besides}",
            f"; error {before}{unit}{besides}",
        ]
    if row.after > 0.99 * row.before:
        verb = "stays at" if row.after <= 1.01 * row.before else f"rises from {before} to"
        return [f"; but the error on {where} {verb} {after}{unit}{besides}"]
    if not sure:
        change = f"{before} to {after}{unit}"
        return [
            f"; but no gain is confirmed on {where}: error {change}{besides}",
            f"; no gain is confirmed: error {change}{besides}",
            "; no gain is confirmed",
        ]
    if row.constant is not None and row.constant < SKILL * row.after:
        constant = replace(row, before=row.constant)
        of = f"error {before} to {after}{unit}, a constant leaves {_numbers(constant)[0]}{unit}"
        return [f"; but on {where} there is no skill: {of}", f"; no skill: {of}", "; no skill"]
    is_noise = f"; {noise} is noise" if noise else ""
    return [
        f". {subject} the error on {where} from {before} to {after}{unit}{is_noise}",
        f": error on {where} {before} to {after}{unit}{besides}",
        f": error {before} to {after}{unit}{besides}",
    ]


def _numbers(row: ErrorRow) -> tuple[str, str, str, str]:
    """Errors before and after, their unit, and the noise with it; without a unit, errors over the
    noise."""
    if row.unit == "-" and row.noise > 0.0:
        before, after = (f"{v / row.noise:.3g}" for v in (row.before, row.after))
        return before, after, " times the noise", ""
    unit = after_number(row.unit)
    return f"{row.before:.3g}", f"{row.after:.3g}", unit, f"{row.noise:.3g}{unit}"


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
        is_known = all(row.constant is not None for row in rows)
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
            constant=rms("constant") if is_known else None,
        )

    return max(
        (pooled(rows) for rows in kinds.values()),
        key=lambda r: (
            (-1.0 if worst else 1.0) * (r.before - (r.after if changed else 0.0)) / r.noise
        ),
    )
