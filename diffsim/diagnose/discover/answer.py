"""What a report says of laws that nobody listed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from diffsim.diagnose.discover.look_alikes import look_alikes
from diffsim.diagnose.discover.screen import Candidate
from diffsim.diagnose.discover.stage import FittedLaw, FoundLaws
from diffsim.diagnose.judge.records import CERTAIN, LIKELY
from diffsim.diagnose.say.law_records import (
    DESCRIBED,
    DescribedLaw,
    LawAnswer,
    LawCurve,
    Number,
    ScreenRow,
)
from diffsim.diagnose.say.report import Report
from diffsim.identify.law import Law

MOST_ROWS = 40  # of the table
Z90 = 1.6449  # standard deviations of a 90 % interval


def with_laws_said(report: Report, found: FoundLaws) -> Report:
    """A report with what the stage found; its verdict where a law is among the named causes."""
    by_name = {law.name: law for law in found.laws}
    rows = [row for row in report.causes if row.name in by_name]
    held = [row for row in rows if row.status in (CERTAIN, LIKELY)]
    laws = tuple(_described(report, by_name[row.name], row.status) for row in held)
    answer = LawAnswer(
        laws,
        tuple(_row(c) for c in found.screened[:MOST_ROWS]),
        tuple(_curve(f, found) for f in found.fitted),
        found.num_tried,
    )
    if not laws or report.verdict not in ("named", "ambiguous"):
        return replace(report, described=answer)
    others = [r for r in report.causes if r.name in report.named and r.name not in by_name]
    said = "; ".join(law.sentence for law in laws)
    also = f", beside {', '.join(r.name for r in others)}" if others else ""
    probably = "" if all(law.status == CERTAIN for law in laws) else "probably "
    head = f"No cause of the library explains it: {probably}{said}{also}."
    tail = report.headline.partition(": ")[2]
    return replace(
        report,
        described=answer,
        verdict=DESCRIBED,
        headline=f"{head} {tail[:1].upper()}{tail[1:]}".strip(),
        sentences=(head, *report.sentences),
    )


def _row(c: Candidate) -> ScreenRow:
    return ScreenRow(c.entry.kind, c.entry.target, c.variable.name, c.nats, c.share, c.basis.wave)


def _curve(fitted: FittedLaw, found: FoundLaws) -> LawCurve:
    c, curve = fitted.candidate, fitted.curve
    names = [
        w.name for w in found.laws if w.entry == c.entry and w.variable.name == c.variable.name
    ]
    return LawCurve(
        names[0] if names else "",
        tuple(map(float, curve.u)),
        tuple(map(float, curve.values)),
        tuple(map(float, curve.sd)),
    )


def _described(report: Report, law: Law, status: str) -> DescribedLaw:
    fit = report.best
    numbers = {}
    for short, name, unit in (
        ("amplitude", law.name, law.unit),
        *((s, f"{s}_of_{law.name}", shape.unit) for s, shape in law.shapes.items()),
    ):
        value, sd = fit.values[name], fit.sd[name] * report.interval_factor
        value_shown = abs(value) if short == "amplitude" and law.form == "periodic" else value
        short = {"lasting": "time"}.get(short, short)
        numbers[short] = Number(value_shown, value_shown - Z90 * sd, value_shown + Z90 * sd, unit)
    entry = {"kind": law.entry.kind, "target": law.entry.target}
    looks = look_alikes(law)
    return DescribedLaw(
        law.name,
        entry,
        (law.variable.name,),
        law.variable.memory or None,
        law.form,
        law.term,
        numbers,
        _sentence(law, numbers, looks),
        looks,
        status,
    )


def _sentence(law: Law, numbers: dict[str, Number], looks: Sequence[str]) -> str:
    at, on = law.entry.words, law.variable.name
    size = numbers["amplitude"]
    unit = "" if size.unit == "-" else f" {size.unit}"
    amount = f"{size.value:.3g}{unit} ({size.low:.3g} to {size.high:.3g})"
    like = f"; looks like {' or '.join(looks)}" if looks else ""
    if law.form == "periodic":
        k = numbers["wave_number"].value
        turns = (
            f"{k:.4g} times a turn of {on}"
            if law.variable.unit == "rad"
            else f"every {2.0 * np.pi / k:.3g} {law.variable.unit} of {on}"
        )
        return f"a {_what(law)} at {at} that repeats {turns}, {amount}{like}"
    memory = numbers.get("time") or numbers.get("swing_rate") or numbers.get("slip_reach")
    lasts = "" if memory is None else f" ({memory.value:.3g} {memory.unit})"
    return f"a {_what(law)} at {at} that depends on {on}{lasts}, {law.form}: {law.term}{like}"


def _what(law: Law) -> str:
    return {
        "force": "torque" if "N m" in law.unit else "force",
        "rate": "flow",
        "number": "change",
        "input": "change",
        "reading": "error",
    }[law.entry.kind]
