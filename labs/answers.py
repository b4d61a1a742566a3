"""What of an answer is counted, in types that JSON has."""

from __future__ import annotations

from typing import Any

from diffsim.diagnose.judge.unseen import times_outside
from diffsim.diagnose.say.report import Report

SHOWN = 0.005  # probability below which a cause is counted, but not listed


def answer_of(report: Report) -> dict[str, Any]:
    """Verdict, names, statuses, probabilities and sizes of a report."""
    stated = [row for row in report.causes if row.probability is not None]
    return {
        "verdict": report.verdict,
        "headline": report.headline,
        "sentences": list(report.sentences),
        "named": sorted(report.named),
        "laws": [] if report.described is None else [law.name for law in report.described.laws],
        "rivals": [sorted(r) for r in report.rivals],
        "statuses": {row.name: row.status for row in report.causes if row.size},
        "stated": {
            row.name: [row.origin, row.probability]
            for row in stated
            if row.probability is not None and row.probability >= SHOWN
        },
        "num_stated": len(stated),
        "intervals": {
            row.name: {c: [s.value, s.low, s.high] for c, s in row.size.items()}
            for row in report.causes
        },
        "sheets": {row.name: [row.value, row.low, row.high] for row in report.base if row.finding},
        "cannot_see": dict(report.cannot_see),
        "failed_gates": [g.name for g in report.gates if not g.passed],
        "bands": bands_of(report),
        "gain": None if report.gain is None else [report.gain.value, report.gain.status],
        "chi2": [report.chi2_null, report.chi2_best, report.num_samples],
    }


def bands_of(report: Report) -> list[list[Any]]:
    """Of each unseen run: its name, readings inside the 90 % band, all, how far outside it lies."""
    counts: dict[str, list[int]] = {}
    for row in report.errors:
        if row.use == "test" and row.num_inside is not None:
            own = counts.setdefault(row.run, [0, 0])
            own[0], own[1] = own[0] + row.num_inside, own[1] + row.num_samples
    far = {run: times_outside([o for o in report.outside if o.run == run]) for run in counts}
    return [[run, *count, far[run]] for run, count in counts.items()]


def failure(error: Exception) -> dict[str, Any]:
    """The answer of a diagnosis that failed."""
    message = " ".join(str(error).split())
    return {"verdict": "failed", "error": f"{type(error).__name__}: {message}", "named": [],
            "rivals": []}  # fmt: skip
