"""The answer in sentences with numbers and units, and the small words of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from diffsim.core.checked import checked
from diffsim.core.figures import figure, limits, percent
from diffsim.core.units import after_number
from diffsim.diagnose.checks.gates import (
    COARSE,
    CONTRADICTED,
    CORRECTED,
    CUTS,
    LATE,
    LAWS,
    PLAIN,
    REPEATED,
    REPEATS,
    SCANS,
    WINDOWS,
    GateResult,
)
from diffsim.diagnose.checks.noise import NoiseFloor
from diffsim.diagnose.checks.numerics import NUMERICS_GATES
from diffsim.diagnose.judge.apart import ALL
from diffsim.diagnose.judge.gain import Gain
from diffsim.diagnose.judge.judge import EXPLAINED, Decision
from diffsim.diagnose.judge.own_values import words_of
from diffsim.diagnose.judge.preconditions import ENDED, said_gradient
from diffsim.diagnose.judge.records import (
    CERTAIN,
    DATA_SHEET,
    EFFECT,
    LIKELY,
    UNKNOWN,
    WRONG_DATA_SHEET,
    BaseRow,
    CauseRow,
    ErrorRow,
    Interval,
    band_words,
    no_skill_words,
)
from diffsim.diagnose.say.factors import gain_words, sheet_words, stated_of, times_all_drives
from diffsim.identify.effect import is_of_run

VERDICTS = (
    "none",
    "data_sheet",
    "named",
    "ambiguous",
    "described",
    "unknown",
    "unrepeatable",
    "numerical",
)
MOST_LISTED = 3  # sizes, rival sets or names in a sentence; the page lists all


@dataclass(frozen=True)
class BeforeTest:
    """What an answer was before the test runs took something back."""

    verdict: str
    statuses: Mapping[str, str]  # status of the causes that have another one now, by name


@dataclass(frozen=True, eq=False)
class Answer:
    """What is put into words."""

    verdict: str  # one of ``VERDICTS``
    decision: Decision  # decision of the evidence behind it
    causes: tuple[CauseRow, ...]  # every candidate cause with its status, probability and size
    # sets within 3 nats of the best one, each a tuple of effect names; a generic unknown cause
    # stands as "unknown force" or the like
    rivals: tuple[tuple[str, ...], ...]
    gates: tuple[GateResult, ...]  # checks of data, gradients and numerics
    floor: NoiseFloor  # noise floor of the fitted runs
    # effects that the verdict names; empty unless "named" or "ambiguous"
    named: tuple[str, ...] = ()
    best_names: tuple[str, ...] = ()  # effects of the best set
    beside: str = ""  # name of an unknown cause that leads beside the named set; empty if none
    # what chose between causes: "select runs", "leaving out one group of fit runs after the other",
    # "leaving out blocks of 2.5 s"
    chosen_by: str = ""
    left: float = 1.0  # what the fit leaves, root mean square of the whitened residual [noise sd]
    # what it would leave with the best unknown cause beside, by its name [noise sd]; empty where
    # none was weighed
    with_unknown: Mapping[str, float] = field(default_factory=dict)
    before_test: BeforeTest | None = None  # what the test runs changed; None: nothing
    # base parameters off their data sheets, where what is left may have bent them
    bent: tuple[BaseRow, ...] = ()
    # numbers that are told away from what is stated, though no findings
    away: tuple[BaseRow, ...] = ()
    # base parameters of the plain model, off their data sheets, that explain the fitted runs as
    # well as the best set does; empty where they do not
    plain_twin: tuple[BaseRow, ...] = ()
    # base parameters that are the strengths of all drives; empty where that is unknown
    drives: tuple[str, ...] = ()
    is_full: bool = False  # whether it might take more steps than a first answer

    @property
    def is_taken_back(self) -> bool:
        """Whether test runs withdrew what was named."""
        before = self.before_test
        return self.verdict == "unknown" and before is not None and before.verdict != "unknown"

    @checked
    def causes_with(self, *statuses: str, origin: str | None = None) -> list[CauseRow]:
        """Causes with one of these statuses, unknown ones left out."""
        return [
            row
            for row in self.causes
            if row.status in statuses
            and row.origin != UNKNOWN
            and (origin is None or row.origin == origin)
        ]


def effects_of(answer: Answer) -> list[CauseRow]:
    return [row for row in answer.causes if row.origin == EFFECT]


def plain_name(answer: Answer, name: str) -> str:
    return next((row.words for row in answer.causes if row.name == name), name)


def size_range(row: CauseRow, *, brief: bool = False) -> str:
    """Sizes of a cause with their 90 % intervals, or between which values many of them lie.

    Args:
        row: Cause with one size or more.
        brief: Say of two or more sizes, too, only between which values they lie.
    """
    row = row.as_read()
    if (own := _sizes_of_groups(row)) and not brief and len(own) <= MOST_LISTED:
        sizes = [f"{component_words(c)} {figure(value)}" for c, value in own.items()]
        return f"{', '.join(sizes)}{after_number(row.unit)}"
    if has_many_sizes(row) or (brief and len(row.size) > 1):
        return _spread(row)
    unit = after_number(row.unit)
    if len(row.size) == 1:
        return ends(next(iter(row.size.values())), unit)
    sizes = [f"{component_words(c)} {ends(s)}" for c, s in row.size.items()]
    if any(";" in said for said in sizes):  # an end is no limit
        return "; ".join(f"{component_words(c)} {ends(s, unit)}" for c, s in row.size.items())
    return f"{', '.join(sizes)}{unit}"


def has_many_sizes(row: CauseRow) -> bool:
    """Whether its sizes are too many for a sentence, or are known together only."""
    if ALL in row.size:
        return True
    return len(row.size) > (1 if all(map(is_of_run, row.size)) else MOST_LISTED)


def _spread(row: CauseRow) -> str:
    """Between which values the sizes lie; tables have each."""
    if own := _sizes_of_groups(row):
        values, what = list(own.values()), "groups"
    else:
        values = [size.value for size in row.size.values()]
        what = "runs" if all(map(is_of_run, row.size)) else "sizes"
    low, high = figure(min(values)), figure(max(values))
    return f"{low} to {high}{after_number(row.unit)} in {len(values)} {what}"


def _sizes_of_groups(row: CauseRow) -> dict[str, float]:
    """Size in each group of a cause with one for all and departures; empty for other causes.

    One for all and departures share what they say: each is uncertain, their sum is not.
    """
    if ALL not in row.size:
        return {}
    common = row.size[ALL].value
    return {c: common + size.value for c, size in row.size.items() if c != ALL}


def component_words(component: str) -> str:
    """A component of a size as it is read: "[propeller=10in]" is "propeller 10in"; a name with a
    capital letter stays."""
    names = component.strip("[]").split("=")
    return " ".join(n if any(map(str.isupper, n)) else n.replace("_", " ") for n in names)


def ends(size: Interval, unit: str = "") -> str:
    """Both ends with as many digits as tell them apart, two at least; one that limits nothing is
    said to be none.

    Args:
        unit: As it follows a number, with its space.
    """
    width = size.high - size.low
    for digits in range(2, 6):
        low, high = figure(size.low, digits), figure(size.high, digits)
        if low != high and abs(float(high) - float(low) - width) <= 0.25 * width:
            return limits(size.value, size.low, size.high, digits, unit)
    return f"{figure(size.value, 4)}{unit}"


def capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def opened(name: str) -> str:
    """A name at the begin of a sentence; m and M are two parameters, "a pulse" is a cause."""
    first = name.partition(" ")[0]
    return name if len(first) <= 2 and first not in ("a", "an") else capital(name)


def sentences(
    answer: Answer,
    gained: Gain | None,
    unseen: Sequence[ErrorRow],
    failed: Mapping[str, str] = MappingProxyType({}),
) -> tuple[str, ...]:
    """Two to seven sentences with numbers and units.

    Args:
        gained: Gain on test runs; None without such runs or without a name.
        unseen: Errors on test runs.
        failed: Runs that could not be simulated, by name, with why.
    """
    out = [_first(answer), *_say_taken_back(answer), *_say_doubts(answer)]
    out += [*data_sheets(answer), *_rest(answer), *_say_unchecked(answer)]
    if gained is not None:
        out.append(gained.words)
    elif failed:
        out += [
            f"Run {name} could not be simulated, so no gain is quoted: {why}"
            for name, why in failed.items()
        ]
    elif not any(row.use == "test" for row in unseen):
        out.append("No gain is known: no run is kept for a test (use: test).")
    out += no_skill_words(unseen)[:MOST_LISTED]
    if held := band_words(unseen):
        out.append(held)
    if answer.chosen_by and answer.verdict not in ("numerical", "unrepeatable"):
        out.append(f"Names were held against the evidence and against {answer.chosen_by}.")
    if np.isnan(answer.floor.scatter_ratio).all():
        out.append("Repeatability was not judged: that needs repeats and a stated sensor noise.")
    out += [
        _failed_check(g)
        for g in answer.gates
        if g.applies
        and not g.passed
        and (g.name not in NUMERICS_GATES or answer.verdict != "numerical")
        and g.name != CONTRADICTED
        and not g.name.startswith(REPEATS)
    ]
    told = (CUTS, WINDOWS, CORRECTED)
    out += [f"{g.note[0].upper()}{g.note[1:]}." for g in answer.gates if g.name in told]
    first = (COARSE, PLAIN, SCANS, LATE, LAWS)
    what = "The budget ended" if answer.is_full else "A first answer"
    out += [f"{what}: {g.note}." for g in answer.gates if g.name in first]
    return tuple(out)


def _failed_check(gate: GateResult) -> str:
    """A failed check: what it asks, and how far off it is where that is a number."""
    kind, _, of = gate.name.partition(":")
    if kind == "gradient":
        return f"A check failed: {said_gradient(gate, f'the derivative by {words_of(of)}')}."
    if kind in NUMERICS_GATES:
        moved = f"moves records and fit by {figure(gate.value)} standard deviations in all"
        wanted = f"{gate.limit:g} at most were wanted"
        return f"A check failed: a finer {words_of(kind)} {moved}, {wanted}."
    name = f"{words_of(kind)} of {words_of(of)}" if of else words_of(kind)
    if (gate.value, gate.limit) == (0.0, 1.0):
        return f"A check failed: {name} ({gate.note})."
    return f"A check failed: {name} {figure(gate.value)}, wanted {gate.limit:g} ({gate.note})."


def _first(answer: Answer) -> str:
    named = effects_of(answer)
    sure = [row for row in named if row.name in answer.named]
    helping = [row for row in named if row.helps]
    if answer.verdict == "none":
        return "The misfit is noise: no effect of the library pays for itself."
    if answer.verdict == "data_sheet":
        return "The misfit is noise once a data sheet is mended: no cause is missing."
    if answer.verdict == "named":
        certain = [row for row in sure if row.status == CERTAIN]
        likely = [row for row in sure if row.status == LIKELY]
        rest = [row for row in sure if row.status not in (CERTAIN, LIKELY)]
        groups = (("", certain), ("probably ", likely), ("perhaps ", rest))
        found = [(how, _sizes(rows)) for how, rows in groups if rows]
        how, sizes = found[0] if found else ("probably ", "")
        beside = "".join(f", and {how}{sizes}" for how, sizes in found[1:])
        return f"The model {how}lacks {sizes}{beside}."
    if answer.verdict == "ambiguous":
        asked = f"The data ask for {_sizes(_members(answer))}"
        if not answer.rivals:
            return f"{asked}, but not so clearly that it is certain."
        sheets = wrong_sheets(answer)
        if answer.rivals == (tuple(n for n in answer.best_names if n not in sheets),):
            alone = join_words([plain_name(answer, name) for name in sheets])
            alone = "it" if sheets.keys() == {*answer.best_names} else alone
            wrong = join_words(list(dict.fromkeys(sheets.values())))
            return f"{asked}, but cannot tell {alone} from {WRONG_DATA_SHEET}{wrong}."
        others = _other_sets(answer, "a wrong data sheet" if sheets else "none")
        return f"{asked}, but cannot tell it from {others or 'its other forms'}."
    if answer.is_taken_back:
        return (
            "Something is missing, and what was named for it does not hold: with "
            f"{_sizes(_members(answer))} the error on test runs is larger."
        )
    if answer.verdict == "unknown":
        text = _say_unknown(answer)
        if helping:
            verbs = "help, but are" if len(helping) > 1 else "helps, but is"
            return f"{text}; {_sizes(helping)} {verbs} not named."
        mimics = _members(answer)
        return f"{text}; {_sizes(mimics)} would mimic part of it." if mimics else f"{text}."
    if answer.verdict == "unrepeatable":
        scatter = _scatter(answer.floor, answer.gates)
        return (
            f"Repeats scatter {scatter}: the misfit is not a function of the command. Causes that "
            "are larger are judged where `sd` states that scatter."
        )
    failed = [g for g in answer.gates if not g.passed and g.name in NUMERICS_GATES]
    return (
        "The numerical settings move the record by "
        + ", ".join(f"{g.value:.1f} noise sd ({g.name})" for g in failed)
        + ": state finer ones in the model, or go on as they are with --accept-numerics."
    )


def _say_unknown(answer: Answer) -> str:
    """That something is missing, and whether repeats show it."""
    if against := [gate.note for gate in answer.gates if gate.name == CONTRADICTED]:
        return f"{against[0][0].upper()}{against[0][1:]}"
    tested = [gate for gate in answer.gates if gate.name == REPEATED]
    if tested and tested[-1].passed:
        return "Something real and repeatable is missing that the library does not hold"
    text = "Something is missing that the library does not hold"
    if tested:
        return f"{text}, though repeats do not show it"
    has_repeats = any(gate.name == "repeats" and gate.passed for gate in answer.gates)
    why = "repeats are too short, or differ in length" if has_repeats else "no repeated run"
    return f"{text}, and whether it repeats cannot be checked: {why}"


def _say_doubts(answer: Answer) -> list[str]:
    """Why causes are not certain, those of one reason together; what is said elsewhere left out."""
    named: dict[str, list[str]] = {}
    for row in answer.causes:
        if row.status == LIKELY and row.origin != UNKNOWN:
            why = "; ".join(d for d in row.doubts if d not in ENDED)
            named.setdefault(why, []).append(row.words.partition(",")[0])
    out = []
    for why, words in named.items():
        if why:
            verb = "are" if len(words) > 1 else "is"
            out.append(f"{opened(join_words(words))} {verb} likely, not certain: {why}.")
    return out


def _say_taken_back(answer: Answer) -> list[str]:
    """What the answer was before the test runs were looked at."""
    before = answer.before_test
    if before is None:
        return []
    words = [plain_name(answer, n).partition(",")[0] for n, s in before.statuses.items()]
    statuses = " or ".join(dict.fromkeys(before.statuses.values()))
    of_causes = f", {join_words(words)} {statuses}" if words else ""
    return [f"Before the test runs were looked at, the verdict was {before.verdict}{of_causes}."]


def _say_unchecked(answer: Answer) -> list[str]:
    """Certain causes whose gradients were left out of the check for its budget."""
    checked = {g.name for g in answer.gates}
    certain = [row for row in effects_of(answer) if row.status == CERTAIN]
    words = [row.words for row in certain if f"gradient:{row.name}" not in checked]
    if "gradient:not checked" not in checked or not words:
        return []
    return [f"The gradient of {join_words(words)} was not checked."]


def join_words(words: Sequence[str]) -> str:
    """Words as a list in a sentence: "a, b and c"; empty of none."""
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def data_sheets(answer: Answer) -> list[str]:
    """One sentence per base parameter far off its data sheet, for all drives by one factor one."""
    out = []
    found = [row.as_read() for row in answer.causes if row.origin == DATA_SHEET]
    stated = [(row, v) for row in found if (v := stated_of(row)) is not None]
    together = sheet_words(stated, answer.drives)
    drives = [row for row in found if row.name in answer.drives and not row.rivals]
    is_one = times_all_drives([(r, v) for r, v in stated if r in drives], answer.drives) is not None
    words = [row.words.lower() for row in drives]
    is_one = is_one and any(all(w in text.lower() for w in words) for text in together)
    for row in found:
        if not (is_one and row in drives):
            unit = after_number(row.unit)
            size = next(iter(row.size.values()))
            said = f"{opened(row.words)} is {ends(size, unit)}"
            text = f"{said}, the data sheet says {row.sheet}{unit}"
            if row.rivals:
                text += f" (or {', '.join(row.rivals)} acts in its place)"
            out.append(f"{text}.")
    if answer.bent:
        bent = join_words([row.words for row in answer.bent[:MOST_LISTED]])
        off = "are off their data sheets" if len(answer.bent) > 1 else "is off its data sheet"
        left = f"{figure(answer.left, 2)} times the noise"
        out.append(f"{capital(bent)} {off}: no finding while {left} is left.")
    if answer.away:
        times = "; ".join(f"{r.words} {times_words(r)}" for r in answer.away[:MOST_LISTED])
        out.append(f"Fitted within what the study allows: {times} times what it states.")
    if twin := twin_words(answer):
        out.append(f"{capital(twin)}: only these data sheets decide.")
    return [*out, *together]


def times_words(row: BaseRow) -> str:
    """A fitted number over what is stated, with its interval: "0.60 (0.58 to 0.62)"."""
    low, value, high = (v / row.prior_value for v in (row.low, row.value, row.high))
    return f"{figure(value)} ({ends(Interval(value, low, high))})"


def twin_words(answer: Answer) -> str:
    """That the plain model, off its data sheets, fits as well; empty where it does not."""
    rows = answer.plain_twin
    if not rows or answer.verdict not in ("named", "ambiguous"):
        return ""
    shown = [row.as_read() for row in rows[:MOST_LISTED]]
    if all(row.prior_value for row in shown):
        times = join_words([figure(row.value / row.prior_value) for row in shown])
        sheets = "its data sheet" if len(shown) == 1 else "their data sheets"
        said = f"{join_words([row.words for row in shown])} at {times} times {sheets}"
    else:
        said = join_words(
            [f"{row.words} at {figure(row.value)}{after_number(row.unit)}" for row in shown]
        )
    return f"without it the model fits as well, with {said}"


def _rest(answer: Answer) -> list[str]:
    """What the names leave open."""
    decision, out = answer.decision, []
    if answer.verdict in ("ambiguous", "named", "unknown"):
        left = figure(answer.left, 2)
        beside = {name: figure(v, 2) for name, v in answer.with_unknown.items()}
        said = [f", {v} with an {words_of(n)} beside" for n, v in beside.items() if v != left]
        if said or left != "1":  # else it is the noise that is left
            out.append(f"The fit leaves {left} times the noise{''.join(said)}.")
    open_ = [r for r in effects_of(answer) if r.status not in (CERTAIN, LIKELY) and r.rivals]
    if answer.verdict == "named" and answer.rivals and open_:
        shared = set.intersection(*map(set, answer.rivals))
        apart = [tuple(n for n in names if n not in shared) for names in answer.rivals]
        out.append(f"What else acts cannot be told: {_sets(answer, [a for a in apart if a])}.")
    if answer.verdict in ("named", "ambiguous") and decision.best and decision.share < EXPLAINED:
        out.append(
            f"That explains {percent(decision.share)} of the misfit; what is left is no cause that "
            "repeats and evidence single out."
        )
    if answer.beside:
        out.append(
            f"With an {words_of(answer.beside)} the evidence is {decision.lead:.0f} nats better: "
            "the names carry most of the misfit, but the record holds more than the library does."
        )
    return out


def _members(answer: Answer) -> list[CauseRow]:
    """Effects of the best set."""
    return [row for row in effects_of(answer) if row.name in answer.best_names]


def _scatter(noise: NoiseFloor, gates: Sequence[GateResult]) -> str:
    """Scatter in the channels, else in what was fitted to each run."""
    if not noise.is_repeatable:
        return f"{figure(np.nanmax(noise.scatter_ratio), 2)} times as much as the sensor noise"
    failed = [g for g in gates if g.name.startswith(REPEATS) and not g.passed]
    worst = max(failed, key=lambda g: g.value)
    times = f"{figure(worst.value, 2)} times"
    return f"in {worst.name.removeprefix(REPEATS)} {times} as much as was stated"


def _sets(answer: Answer, rivals: Sequence[tuple[str, ...]], nothing: str = "none") -> str:
    """The nearest rival sets in words, and how many more there are.

    Args:
        answer: What the page says.
        nothing: What a set without a cause is called.
    """
    words = [[plain_name(answer, name) for name in names] for names in rivals[:MOST_LISTED]]
    shown = " or ".join(" with ".join(names) or nothing for names in words)
    more = len(rivals) - MOST_LISTED
    return shown if more <= 0 else f"{shown}, or {more} more {'sets' if more > 1 else 'set'}"


def wrong_sheets(answer: Answer) -> dict[str, str]:
    """Numbers whose data sheets may be wrong in place of causes of the best set, by the causes."""
    forms = answer.decision.forms.items()
    found = {
        i: what.removeprefix(WRONG_DATA_SHEET)
        for i, what in forms
        if what.startswith(WRONG_DATA_SHEET)
    }
    best = sorted(answer.decision.best) if found else []
    pairs = zip(best, answer.best_names, strict=True) if best else ()
    return {name: found[i] for i, name in pairs if i in found}


def _other_sets(answer: Answer, nothing: str) -> str:
    """Rivals of the best set in words, without those that are the same causes in other forms."""
    told, others = {frozenset(row.words for row in _members(answer))}, []
    for names in answer.rivals:
        words = frozenset(plain_name(answer, name) for name in names)
        if words not in told:
            told.add(words)
            others.append(names)
    return _sets(answer, others, nothing)


def _sizes(rows: Sequence[CauseRow]) -> str:
    """Causes with their 90 % intervals."""
    parts = []
    for row in rows:
        what = "" if has_many_sizes(row) else "; 90 % interval"
        slip = f"; {words}" if (words := gain_words(row)) else ""
        parts.append(f"{row.words} ({size_range(row)}{what}{slip})")
    return " and ".join(parts)
