"""What a report says of laws that nobody listed."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from diffsim.core.figures import figure, limits
from diffsim.core.units import after_number, small_scale
from diffsim.diagnose.discover.look_alikes import look_alikes
from diffsim.diagnose.discover.screen import Candidate
from diffsim.diagnose.discover.stage import TABLE, FittedLaw, FoundLaws
from diffsim.diagnose.judge.own_values import words_of
from diffsim.diagnose.judge.preconditions import UNCONTRADICTED
from diffsim.diagnose.judge.records import (
    CERTAIN,
    DATA_SHEET,
    HALF_LEVEL,
    LIKELY,
    UNTOLD,
    CauseRow,
    Interval,
)
from diffsim.diagnose.say.law_records import (
    DESCRIBED,
    DescribedLaw,
    LawAnswer,
    LawCurve,
    Number,
    RunCurve,
    ScreenRow,
)
from diffsim.diagnose.say.report import Report
from diffsim.identify import Fit
from diffsim.identify.law import VALUE, Law, Variable

OF_NUMBERS = ("number", "value")  # kinds of entries that change a number of the model
POSSIBLE = "possible"  # of one of several laws
PRODUCT = "product"  # form of a line in one variable times another

PERIODS_SHOWN = 3.0  # of a law that repeats: more are a grey wall
#: the number that says how a hidden state remembers
MEMORIES = {
    "": (),
    "heat": ("time",),
    "relaxation": ("time",),
    "slip": ("threshold",),
    "oscillator": ("frequency",),
    "work": (),
}


def with_laws_said(report: Report, found: FoundLaws) -> Report:
    """A report with what the stage found; its verdict where a law is among the named causes."""
    by_name = {law.name: law for law in found.laws}
    rows = [row for row in report.causes if row.name in by_name and _is_held(row, by_name)]
    laws = tuple(_describe(report, by_name[row.name], row) for row in rows)
    answer = LawAnswer(
        laws,
        tuple(_row(c) for c in found.screened[:40]),
        tuple(_curve(f, laws) for f in found.fitted),
        found.num_tried,
    )
    if not laws or report.verdict not in ("named", "ambiguous"):
        return replace(report, described=answer)
    said = _say_laws(report, laws, _say_turn(report, by_name))
    first, *more = report.sentences
    acting = (by_name[row.name].entry for row in rows)
    levels = {part.target for e in acting if e.kind in OF_NUMBERS for part in e.parts or (e,)}
    far = [row.words for row in report.base if row.name in levels and abs(row.pull) > row.limit]
    more += [f"The level of {words} cannot be told from that of its law." for words in far]
    # a law is claimed where something that was not fitted could contradict it
    is_alone = all(UNCONTRADICTED in row.doubts for row in rows)
    verdict = "ambiguous" if is_alone else DESCRIBED
    return replace(report, described=answer, verdict=verdict, sentences=(first, said, *more))


def in_words(report: Report, found: FoundLaws) -> Report:
    """A report whose rows call laws by where they act and what they depend on.

    A number that a law multiplies has no level of its own: what the fit makes of it is no finding
    about its data sheet, which alone says where the law's level is.
    """
    words = {law.name: _depends(law) for law in found.laws}
    held = {effect.name for effect in report.best.problem.effects}
    acting = (law.entry for law in found.laws if law.name in held)
    levels = {part.target for e in acting if e.kind in OF_NUMBERS for part in e.parts or (e,)}
    rows = (
        replace(
            row,
            words=words.get(row.name, row.words),
            doubts=tuple(_with_laws(doubt, row.name, found.laws) for doubt in row.doubts),
        )
        for row in report.causes
        if row.origin != DATA_SHEET or row.name not in levels
    )
    base = (replace(r, finding=r.finding and r.name not in levels) for r in report.base)
    return replace(report, causes=tuple(rows), base=tuple(base))


def _depends(law: Law) -> str:
    return f"{_what(law)} that depends on {law.variable.name}"


def _with_laws(doubt: str, of: str, laws: Sequence[Law]) -> str:
    """A doubt of a row that calls laws as its words do.

    Args:
        of: Name of the row's cause.
    """
    own = {_depends(law) for law in laws if law.name == of}
    for law in sorted(laws, key=lambda law: -len(law.name)):  # a numbered name has another in it
        said = _depends(law)
        said = f"another law of {law.variable.name}" if said in own else said
        doubt = doubt.replace(words_of(law.name), said)
    return doubt


def _is_held(row: CauseRow, laws: Mapping[str, Law]) -> bool:
    """Whether a law is said, if only that one of several laws acts."""
    if row.status == UNTOLD:
        return set(row.rivals) <= set(laws)
    return row.status in (CERTAIN, LIKELY)


def _say_turn(report: Report, laws: Mapping[str, Law]) -> str:
    """Two lines of one kind that are a rotation: each axis gets a part of the other, with opposite
    signs and one size. Nothing where they are none."""
    named = [laws[name] for name in report.named if name in laws]
    if len(named) != 2 or any(law.form != "line" or not _is_mix(law) for law in named):
        return ""
    first, second = named
    if first.entry.kind != second.entry.kind or first.entry.target == second.entry.target:
        return ""
    a, b = (report.best.values[law.name] for law in named)
    sd = [report.best.sd[law.name] * report.interval_factor for law in named]
    if a * b > 0.0 or abs(a + b) > HALF_LEVEL * math.hypot(*sd):
        return ""
    weights = [1.0 / s**2 for s in sd]
    turn = math.degrees(math.atan(float(np.average([abs(a), abs(b)], weights=weights))))
    return f"; together they are a rotation of the axes by {figure(turn, 2)} deg"


def _is_mix(law: Law) -> bool:
    """Whether a law adds a share of something of its own kind."""
    unit = law.variable.unit
    return law.entry.kind != "number" and not law.variable.memory and unit == law.entry.unit != "-"


def _say_laws(report: Report, laws: Sequence[DescribedLaw], more: str) -> str:
    """The best law, what acts beside it and what cannot be told from it, with their numbers."""
    best, *rest = sorted(laws, key=lambda law: law.name not in report.named)
    same = [law for law in rest if law.place == best.place]
    beside = [law for law in rest if law.name in report.named or law.status in (CERTAIN, LIKELY)]
    others = [law for law in rest if law not in same and law not in beside]
    said = f"{'' if best.status == CERTAIN else 'probably '}{best.sentence}"
    if same:
        said += f" (or {', '.join(_shorten(law.formula) for law in same)})"
    if beside:
        said += f"; and {beside[0].sentence}{more}"
    if others:
        said += f"; or else {others[0].sentence}"
    return f"A law that nobody listed: {said}."


def _row(c: Candidate) -> ScreenRow:
    entry, variable = c.entry, c.variable
    row = (entry.kind, entry.target, variable.name, c.nats, c.share, c.basis.wave)
    return ScreenRow(*row, memory=variable.memory, of=variable.of)


def _curve(fitted: FittedLaw, laws: Sequence[DescribedLaw]) -> LawCurve:
    """A missing term over its variable; of one that repeats a few periods in the middle."""
    c, curve = fitted.candidate, fitted.curve
    place = (c.entry.kind, c.entry.target, _words_of(c.variable))
    memory = c.variable.memory or None
    names = [law.name for law in laws if law.place == place and law.memory == memory]
    u = curve.u
    if c.basis.wave:
        middle, half = 0.5 * (u[0] + u[-1]), PERIODS_SHOWN * np.pi / c.basis.wave
        u = np.linspace(max(middle - half, u[0]), min(middle + half, u[-1]), len(u))
    basis = c.basis.values(u)
    sd = np.sqrt(np.einsum("ij,jk,ik->i", basis, curve.covariance, basis))
    by_run = ((run, (v >= u[0]) & (v <= u[-1]), v, value) for run, v, value in fitted.by_run)
    runs = tuple(
        RunCurve(run, tuple(v[kept].tolist()), tuple(value[kept].tolist()))
        for run, kept, v, value in by_run
    )
    told = [tuple(a.tolist()) for a in (u, basis @ curve.factors, sd)]
    return LawCurve(names[0] if names else "", told[0], told[1], told[2], c.entry.unit, runs)


def _words_of(variable: Variable) -> tuple[str, ...]:
    """A variable, or what drives the hidden state that it is; then what multiplies the law."""
    own = variable.of if variable.memory else variable.own_name
    return (own,) if variable.times is None else (own, variable.times.name)


def _describe(report: Report, law: Law, row: CauseRow) -> DescribedLaw:
    fit = report.best
    status = row.status if row.status in (CERTAIN, LIKELY) else POSSIBLE
    numbers = {}
    # as the answer states them: over all sets of causes, widened to the spread over runs left out
    intervals = {b.name: Interval(b.value, b.low, b.high) for b in report.base}
    if row.size:
        intervals[law.name] = next(iter(row.size.values()))
    size = "rate" if law.term.startswith("exp(size") else "amplitude"
    for short, name, unit in (
        (size, law.name, law.unit),
        *((s, f"{s}_of_{law.name}", shape.unit) for s, shape in law.shapes.items()),
    ):
        if name not in fit.values:  # of a law beside the best set
            continue
        value, half = fit.values[name], HALF_LEVEL * float(fit.sd[name]) * report.interval_factor
        told = intervals.get(name, Interval(value, value - half, value + half))
        # what runs left out say may lie aside of the value that the model holds
        low, high = min(told.low, value), max(told.high, value)
        if short == "amplitude" and law.form == "periodic" and value < 0.0:
            value, low, high = -value, -high, -low
        if short == "swing_rate":
            short, unit = "frequency", "Hz"
            value, low, high = value / math.tau, low / math.tau, high / math.tau
        short = {"lasting": "time", "slip_reach": "threshold"}.get(short, short)
        numbers[short] = Number(value, low, high, unit)
    entry = {"kind": law.entry.kind, "target": law.entry.target}
    looks = look_alikes(law)
    return DescribedLaw(
        law.name,
        entry,
        _words_of(law.variable),
        law.variable.memory or None,
        _form_of(law),
        law.term,
        numbers,
        _sentence(law, numbers, looks, fit),
        looks,
        status,
    )


#: u*(u**2 + near)**((exponent - 1)/2), as in the forms through zero
_ROUNDED_POWER = re.compile(rf"{VALUE}\*\({VALUE}\*\*2 \+ [^()]+\)\*\*\(\(([^()]+) - 1\)/2\)")


def _sentence(law: Law, numbers: dict[str, Number], looks: Sequence[str], fit: Fit) -> str:
    what, on = _what(law), law.variable.name
    on += f" ({VALUE})" if law.variable.parts else ""
    size = numbers.get("amplitude")
    amount = "" if size is None else f", {_amount(size, law.unit)}"
    like = f"; looks like {' or '.join(looks)}" if looks else ""
    if law.form == "periodic":
        k = numbers["wave_number"].value if "wave_number" in numbers else np.nan
        turns = (
            f"{k:.4g} times a turn of {on}"
            if law.variable.unit == "rad"
            else f"every {figure(2.0 * np.pi / k)} {law.variable.unit} of {on}"
        )
        return f"{what} that repeats {turns}{amount}{like}"
    memory = next((numbers[n] for n in MEMORIES[law.variable.memory] if n in numbers), None)
    lasts = "" if memory is None else f" ({figure(memory.value)} {memory.unit})"
    formula = (
        "a curve without a formula"
        if law.form == TABLE
        else f"{_form_of(law)}: {_write_term(law, fit)}"
    )
    return f"{what} that depends on {on}{lasts}, {formula}{like}"


def _amount(size: Number, unit: str) -> str:
    """A size with its interval, small lengths in mm and the like."""
    values = (size.value, size.low, size.high)
    shown, times = small_scale(unit, values)
    value, low, high = (times * v for v in values)
    return f"{figure(value)}{after_number(shown)} ({limits(value, low, high)})"


def _write_term(law: Law, fit: Fit) -> str:
    """A law's formula with its variable and the numbers of a fit; of another one with names."""
    values = {"size": law.name, **{s: f"{s}_of_{law.name}" for s in law.shapes}}
    text = law.term
    for short, name in values.items():
        if name in fit.values:
            text = re.sub(rf"\b{short}\b", figure(fit.values[name]), text)
    text = _shorten(text)
    if not law.variable.parts:  # of which each place has its own
        text = re.sub(rf"\b{VALUE}\b", law.variable.own_name, text)
    return text if law.variable.times is None else f"{law.variable.times.name}*{text}"


def _shorten(formula: str) -> str:
    """A formula as it is read: numbers of four digits, a power without its finite slope at zero."""
    formula = _ROUNDED_POWER.sub(rf"sign({VALUE})*abs({VALUE})**\1", formula)
    formula = re.sub(r"\d+\.\d{4,}", lambda m: f"{float(m.group()):.4g}", formula)
    return formula.replace("- -", "+ ")


def _form_of(law: Law) -> str:
    return PRODUCT if law.form == "line" and law.variable.times is not None else law.form


def _what(law: Law) -> str:
    target = words_of(law.entry.target)
    if law.entry.kind == "force":
        return f"a {'torque' if 'N m' in law.entry.unit else 'force'} at {target}"
    if law.entry.kind == "rate":
        return f"a flow into {target}"
    if law.entry.kind == "reading":
        return f"an error of the reading {target}"
    return f"a change of {target}"
