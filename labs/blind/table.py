"""Counts over sealed cases: confusion by kind and verdict, and the figures of acceptance."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from labs.blind.sealed import KINDS

Score = Mapping[str, Any]
VERDICTS = (
    "none", "data_sheet", "named", "ambiguous", "unknown", "unrepeatable", "numerical", "failed",
)  # fmt: skip
VISIBLE, FAINT = 8.0, 5.0  # lambda
CLASSES = {"below 3": (0.0, 3.0), "3 to 8": (3.0, 8.0), "8 or more": (8.0, math.inf)}
DISTINCT = 0.4  # delta of a cause outside the library


def confusion(scores: Sequence[Score]) -> dict[str, dict[str, int]]:
    """Verdicts by kind, with how many were right."""
    table = {}
    for kind in KINDS:
        own = [s for s in scores if s["kind"] == kind]
        if own:
            seen = Counter(s["verdict"] for s in own)
            counts = {verdict: seen.get(verdict, 0) for verdict in VERDICTS}
            table[kind] = counts | {"right": sum(s["right"] for s in own), "n": len(own)}
    return table


def figures(scores: Sequence[Score]) -> list[dict[str, Any]]:
    """Figures of acceptance: what, hits, of how many, goal; 90 % interval of the share."""
    clean = [s for s in scores if s["scored_as"] in ("null", "decoy") and _is_noise(s)]
    singles = [s for s in scores if s["scored_as"] == "single"]
    visible = [s for s in singles if _weakest(s) >= VISIBLE]
    faint = [s for s in singles if FAINT <= _weakest(s) < VISIBLE]
    inside = [s for s in scores if s["scored_as"] in ("single", "pair")]
    pairs = [s for s in scores if s["scored_as"] == "pair" and _weakest(s) >= VISIBLE]
    outside = [s for s in scores if s["scored_as"] == "outside" and s.get("delta", 0.0) >= DISTINCT]
    open_ = [s for s in inside if s["verdict"] == "ambiguous"]
    alone = [s for s in inside if s["verdict"] == "named"]
    intervals = [size["inside"] for s in scores for size in s["sizes"].values()]
    numerical = [s for s in scores if s["scored_as"] == "numerical"]
    blind = [s for s in scores if s["scored_as"] == "invisible"]
    classes = [s for s in scores if s["scored_as"] in ("confounded", "twins")]
    named = {"named", "ambiguous", "unknown"}
    rows = [
        _row("nulls and decoys with a name or unknown", "<= 0.02", clean,
             [s["verdict"] in named or _is_alarm(s) for s in clean]),
        _row("nulls and decoys, a data sheet called off", "", clean,
             [s["verdict"] == "data_sheet" for s in clean]),
        _row("one effect, lambda >= 8: right, alone or in the set", ">= 0.95", visible,
             [s["in_set"] for s in visible]),
        _row("one effect, lambda 5 to 8: right, alone or in the set", ">= 0.5", faint,
             [s["in_set"] for s in faint]),
        _row("name given alone, wrong", "<= 0.02", alone, [s["wrong_alone"] for s in alone]),
        _row("ambiguous sets that hold the truth", ">= 0.95", open_, [s["in_set"] for s in open_]),
        _row("two effects, each lambda >= 8: both exactly", ">= 0.85", pairs,
             [s["alone"] for s in pairs]),
        _row("outside, delta >= 0.4: flagged unknown", ">= 0.95", outside,
             [s["verdict"] == "unknown" for s in outside]),
        _row("outside, delta >= 0.4: named alone", "<= 0.02", outside,
             [s["verdict"] == "named" for s in outside]),
        _row("size inside its 90 % interval", ">= 0.85", intervals, intervals),
        _row("numerical found by the gate", "1", numerical, [s["right"] for s in numerical]),
        _row("invisible: none, and said that it cannot be seen", "1", blind,
             [s["right"] for s in blind]),
        _row("confounded or twins: right set", "1", classes, [s["right"] for s in classes]),
    ]  # fmt: skip
    shares = [s["share_of_true_gain"] for s in scores if "share_of_true_gain" in s]
    if shares:
        what = "gain over that of the true extended model, median"
        median = float(np.median(shares))
        rows.append({"what": what, "goal": ">= 0.9", "value": median, "n": len(shares)})
    return rows


def by_strength(scores: Sequence[Score]) -> list[dict[str, Any]]:
    """Answers to cases with one hidden cause by lambda: how many were right, silent, wrong.

    Args:
        scores: Scores of all cases; others are left out.
    """
    rows = []
    for name, (low, high) in CLASSES.items():
        own = [s for s in scores if s["scored_as"] == "single" and low <= _weakest(s) < high]
        row = _row(name, "", own, [s["in_set"] for s in own])
        rows.append(
            row
            | {
                "alone": sum(s["alone"] for s in own),
                "silent": sum(s["verdict"] == "none" for s in own),
                "wrong_alone": sum(s["wrong_alone"] for s in own),
            }
        )
    return rows


def markdown(
    scores: Sequence[Score], *, title: str, command: str, notes: Sequence[str] = ()
) -> str:
    """The tables as a page."""
    table = confusion(scores)
    head = ["kind", "n", "right", *VERDICTS]
    lines = [f"# {title}", "", f"`{command}`", "", *notes, ""]
    lines += ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for kind, row in table.items():
        cells = [kind, *(str(row[name] or "") for name in ("n", "right", *VERDICTS))]
        lines.append("| " + " | ".join(cells) + " |")
    lines += ["", "| lambda of one cause | n | right | 90 % interval | of them alone | `none` "]
    lines[-1] += "| wrong name alone |"
    lines.append("|---|---|---|---|---|---|---|")
    for c in by_strength(scores):
        interval = f"{c['low']:.2f} to {c['high']:.2f}" if c["n"] else ""
        counts = f"{c['alone']} | {c['silent']} | {c['wrong_alone']}"
        lines.append(f"| {c['what']} | {c['n']} | {c.get('hits', 0)} | {interval} | {counts} |")
    lines += ["", "| figure | goal | measured | 90 % interval | n |", "|---|---|---|---|---|"]
    for f in figures(scores):
        low, high = f.get("low"), f.get("high")
        interval = "" if low is None else f"{low:.2f} to {high:.2f}"
        value = "–" if f["value"] is None else f"{f['value']:.3g}"
        lines.append(f"| {f['what']} | {f['goal']} | {value} | {interval} | {f['n']} |")
    wrong = [s for s in scores if not s["right"]]
    if wrong:
        lines += ["", "Cases that were not right:", "", "| case | hidden | lambda | answer |"]
        lines += ["|---|---|---|---|", *(_wrong(s) for s in wrong)]
    return "\n".join(lines) + "\n"


def _wrong(s: Score) -> str:
    hidden = ", ".join([f"{s['kind']}:", *s["truth"], *s["decoys"]])
    strength = ", ".join(f"{v:.1f}" for v in s.get("lambda", {}).values())
    answer = " or ".join("+".join(x) for x in (s["named"], *s["rivals"]) if x)
    return f"| {s['case']} | {hidden} | {strength} | {s['verdict']} {answer} {s['error'] or ''} |"


def _row(what: str, goal: str, of: Sequence[Any], hits: Sequence[bool]) -> dict[str, Any]:
    from scipy import stats

    if not of:
        return {"what": what, "goal": goal, "value": None, "n": 0}
    k, n = int(sum(hits)), len(of)
    interval = stats.binomtest(k, n).proportion_ci(0.9, "exact")
    return {
        "what": what,
        "goal": goal,
        "value": k / n,
        "low": float(interval.low),
        "high": float(interval.high),
        "hits": k,
        "n": n,
    }


def _is_noise(s: Score) -> bool:
    """Decoys that are noise; scattering repeats are not."""
    return "scatter" not in s["decoys"]


def _is_alarm(s: Score) -> bool:
    """Whether a data sheet is called off, and not what it truly is."""
    return s["verdict"] == "data_sheet" and not s.get("is_noise", False)


def _weakest(s: Score) -> float:
    """Smallest lambda of the hidden effects, each given the others; NaN where not computed."""
    return min(s.get("lambda", {}).values(), default=math.nan)
