"""The answer in sentences with numbers and units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from diffsim.diagnose.checks.gates import (
    COARSE,
    FIRST_ANSWER,
    LATE,
    NUMERICS_GATES,
    REPEATS,
    GateResult,
)
from diffsim.diagnose.checks.noise import NoiseFloor
from diffsim.diagnose.judge.gain import Gain
from diffsim.diagnose.judge.judge import EXPLAINED
from diffsim.diagnose.judge.records import (
    CERTAIN,
    DATA_SHEET,
    LIKELY,
    WRONG_SHEET,
    CauseRow,
    ErrorRow,
)
from diffsim.diagnose.say.answer import (
    Answer,
    after_number,
    effects_of,
    ends,
    has_many_sizes,
    opened,
    plain_name,
    size_range,
)

MAX_RIVALS = 3  # rival sets in a sentence; the page lists all


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
    out = [_first(answer), *_strained(answer), *_data_sheets(answer), *_rest(answer)]
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
        f"A check failed: {_plain(g.name)} {g.value:.3g}, wanted {g.limit:g} ({g.note})."
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
    named = effects_of(answer)
    sure = [row for row in named if row.name in answer.named]
    helping = [row for row in named if row.helps]
    if answer.verdict == "none":
        return "The misfit is noise: no effect of the library pays for itself."
    if answer.verdict == "data_sheet":
        return "The misfit is noise once a data sheet is mended: no cause is missing."
    if answer.verdict == "named":
        surely = "lacks" if any(row.status == CERTAIN for row in sure) else "probably lacks"
        return f"The model {surely} {_sizes(sure)}."
    if answer.verdict == "ambiguous":
        asked = f"The data ask for {_sizes(_members(answer))}"
        if not answer.rivals:
            return f"{asked}, but not so clearly that it is certain."
        forms = answer.decision.forms.values()
        nothing = "a wrong data sheet" if any(f.startswith(WRONG_SHEET) for f in forms) else "none"
        return f"{asked}, but cannot tell it from {_sets(answer, answer.rivals, nothing)}."
    if answer.verdict == "unknown":
        text = "Something real and repeatable is missing that the library does not hold"
        if helping:
            verbs = "help, but are" if len(helping) > 1 else "helps, but is"
            return f"{text}; {_sizes(helping)} {verbs} not named."
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


def _strained(answer: Answer) -> list[str]:
    """Why a set is not certain that left data sheets far behind, or leaves much."""
    if answer.verdict != "named":
        return []
    out = [
        f"{opened(words)} is {abs(pull):.0f} standard deviations off its data sheet, and something "
        "unknown acts: what is named may stand in for that."
        for words, pull in answer.strained.items()
    ]
    if answer.left is not None:
        out.append(
            f"What the fit leaves is {answer.left:.2g} times the noise, and something unknown "
            "acts: what is named may stand in for that."
        )
    return out


def _data_sheets(answer: Answer) -> list[str]:
    """One sentence per base parameter far off its data sheet."""
    out = []
    for row in (row.as_read() for row in answer.causes):
        if row.origin == DATA_SHEET:
            unit = after_number(row.unit)
            size = next(iter(row.size.values()))
            sheet = row.note.partition("data sheet: ")[2].partition(" (")[0]
            text = f"{opened(row.words)} is {ends(size)}{unit}, the data sheet says {sheet}{unit}"
            if row.rivals:
                text += f" (or {', '.join(row.rivals)} acts in its place)"
            out.append(f"{text}.")
    return out


def _rest(answer: Answer) -> list[str]:
    """What the names leave open."""
    decision, out = answer.decision, []
    open_ = [r for r in effects_of(answer) if r.status not in (CERTAIN, LIKELY) and r.rivals]
    if answer.verdict == "named" and answer.rivals and open_:
        shared = set.intersection(*map(set, answer.rivals))
        apart = [tuple(n for n in names if n not in shared) for names in answer.rivals]
        out.append(f"What else acts cannot be told: {_sets(answer, [a for a in apart if a])}.")
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


def _members(answer: Answer) -> list[CauseRow]:
    """Effects of the best set."""
    return [row for row in effects_of(answer) if row.name in answer.best_names]


def _scatter(noise: NoiseFloor, gates: Sequence[GateResult]) -> str:
    """Scatter in the channels, else in what was fitted to each run."""
    if not noise.is_repeatable:
        return f"{np.nanmax(noise.scatter_ratio):.2g} times as much as the sensor noise"
    failed = [g for g in gates if g.name.startswith(REPEATS) and not g.passed]
    worst = max(failed, key=lambda g: g.value)
    return f"in {worst.name.removeprefix(REPEATS)} {worst.value:.2g} times as much as was stated"


def _sets(answer: Answer, rivals: Sequence[tuple[str, ...]], nothing: str = "none") -> str:
    """The nearest rival sets in words, and how many more there are.

    Args:
        answer: What the page says.
        rivals: Sets of names.
        nothing: What a set without a cause is called.
    """
    words = [[plain_name(answer, name) for name in names] for names in rivals[:MAX_RIVALS]]
    shown = " or ".join(" with ".join(names) or nothing for names in words)
    more = len(rivals) - MAX_RIVALS
    return shown if more <= 0 else f"{shown}, or {more} more {'sets' if more > 1 else 'set'}"


def _sizes(rows: Sequence[CauseRow]) -> str:
    """Causes with their 90 % intervals."""
    parts = []
    for row in rows:
        what = "" if has_many_sizes(row) else "; 90 % interval"
        parts.append(f"{row.words} ({size_range(row)}{what})")
    return " and ".join(parts)


def _plain(check: str) -> str:
    """The name of a check in words: "gradient:lag" is "gradient of lag"."""
    return check.replace(":", " of ").replace("_", " ")
