"""Counts over cases: outcomes by domain, bounds of rates, sensitivity, coverage, reliability."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from labs.rates.draw import DENIED, KINDS, LIBRARY, NULL
from labs.rates.score import ALARM, CERTAIN_WRONG, HELD, OUTCOMES, RIGHT, stated_pairs

Row = Mapping[str, Any]
VISIBLE = 8.0  # lambda from which a cause must be found
LEVEL = 0.9  # of all intervals
HELD_LEAST = 0.8  # of a single run's readings, by its 90 % band
EDGES = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1.0)  # bins of stated probabilities


@dataclass(frozen=True)
class Rate:
    """How often something happened."""

    what: str  # what is counted
    goal: str  # what it should be, in words
    # hits, count: how often, of how many
    hits: int
    count: int

    @property
    def bounds(self) -> tuple[float, float]:
        """Clopper and Pearson's 90 % interval of the rate."""
        from scipy import stats

        if not self.count:
            return 0.0, 1.0
        found = stats.binomtest(self.hits, self.count).proportion_ci(LEVEL, "exact")
        return float(found.low), float(found.high)

    @property
    def words(self) -> str:
        """The rate with its bounds."""
        if not self.count:
            return "–"
        low, high = self.bounds
        share = self.hits / self.count
        return f"{share:.1%} ({low:.1%} to {high:.1%}), {self.hits} of {self.count}"


def rates(rows: Sequence[Row]) -> list[Rate]:
    """What the goals are about."""
    by_kind = {kind: [r for r in rows if r["kind"] == kind] for kind in KINDS}
    seen = [r for r in by_kind[LIBRARY] if r["lambda"] >= VISIBLE]
    inside = [size["inside"] for r in rows for size in r["sizes"].values()]
    return [
        _rate("certain and wrong, cause in the library", "<= 1 %", by_kind[LIBRARY], CERTAIN_WRONG),
        _rate("certain and wrong, cause denied", "<= 5 %", by_kind[DENIED], CERTAIN_WRONG),
        _rate("false alarms, nothing hidden", "<= 2 %", by_kind[NULL], ALARM),
        _rate(f"named or in the set, lambda >= {VISIBLE:g}", ">= 95 %", seen, RIGHT, HELD),
        Rate("sizes in their 90 % interval", "85 to 95 %", sum(inside), len(inside)),
    ]


def _rate(what: str, goal: str, rows: Sequence[Row], *outcomes: str) -> Rate:
    return Rate(what, goal, sum(r["outcome"] in outcomes for r in rows), len(rows))


@dataclass(frozen=True)
class Bin:
    """Causes whose stated probability lies in one range: how many, how many act, mean of it."""

    low: float
    high: float
    count: int
    hits: int
    mean: float

    @property
    def bounds(self) -> tuple[float, float]:
        """90 % interval of the frequency."""
        return Rate("", "", self.hits, self.count).bounds


def reliability(rows: Sequence[Row]) -> list[Bin]:
    """Stated probability against frequency, in bins that hold causes.

    Args:
        rows: Cases; what was stated of every cause of the library counts.
    """
    pairs = [pair for row in rows for pair in stated_pairs(row)]
    found = []
    for k, (low, high) in enumerate(pairwise(EDGES)):
        is_last = k == len(EDGES) - 2
        own = [(p, acts) for p, acts in pairs if low <= p and (p < high or is_last)]
        if own:
            mean = float(np.mean([p for p, _ in own]))
            found.append(Bin(low, high, len(own), sum(acts for _, acts in own), mean))
    return found


def outcome_table(rows: Sequence[Row]) -> list[str]:
    """Outcomes by domain and kind, in Markdown."""
    head = ["domain", "hidden", "n", *OUTCOMES, "CPU s"]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    domains = list(dict.fromkeys(r["domain"] for r in rows))
    for domain in (*domains, "all"):
        for kind in KINDS:
            own = [r for r in rows if r["kind"] == kind and domain in (r["domain"], "all")]
            if own:
                lines.append(_outcome_line(domain, kind, own))
    return lines


def _outcome_line(domain: str, kind: str, rows: Sequence[Row]) -> str:
    counts = Counter(r["outcome"] for r in rows)
    cpu = np.median([r["cpu_s"] for r in rows])
    words = {NULL: "nothing", LIBRARY: "in the library", DENIED: "denied"}[kind]
    cells = [domain, words, str(len(rows)), *(str(counts[o] or "") for o in OUTCOMES)]
    return "| " + " | ".join([*cells, f"{cpu:.0f}"]) + " |"


def rate_tables(rows: Sequence[Row]) -> list[str]:
    """Rates beside their goals by domain, in Markdown."""
    domains = list(dict.fromkeys(r["domain"] for r in rows))
    lines = ["| figure | goal | domain | measured (90 % bounds) |", "|---|---|---|---|"]
    parts = {"all": rates(rows)}
    parts |= {domain: rates([r for r in rows if r["domain"] == domain]) for domain in domains}
    for k in range(len(parts["all"])):
        for domain, found in parts.items():
            rate = found[k]
            if rate.count:
                lines.append(f"| {rate.what} | {rate.goal} | {domain} | {rate.words} |")
    return lines


def band_lines(rows: Sequence[Row]) -> list[str]:
    """What the 90 % bands of unseen runs hold, pooled and at each case's farthest run; Markdown."""
    known = [row["bands"] for row in rows if row.get("bands")]
    if not known:
        return []
    every = [run for case in known for run in case]
    far = [max(case, key=lambda run: run[3]) for case in known]
    lines = [
        "| runs | number | times outside, median | inside | 80 % or more inside |",
        "|---" * 5 + "|",
    ]
    for what, runs in (("all unseen", every), ("the farthest of each case", far)):
        _, inside, count, times = zip(*runs, strict=True)
        share = np.array(inside) / np.array(count)
        lines.append(
            f"| {what} | {len(runs)} | {np.median(times):.1f} | {sum(inside) / sum(count):.0%} | "
            f"{np.mean(share >= HELD_LEAST):.0%} |"
        )
    return lines


def wrong_lines(rows: Sequence[Row]) -> list[str]:
    """Cases that went wrong, one line each, in Markdown."""
    bad = [r for r in rows if r["outcome"] in (CERTAIN_WRONG, ALARM)]
    if not bad:
        return []
    lines = ["| case | rig | hidden | lambda | recordings | outcome | said |", "|---" * 7 + "|"]
    for r in bad:
        hidden = r["hidden"] or "nothing"
        denied = f" (without its {r['denies']})" if r["denies"] else ""
        sets = [" + ".join(s) or "none" for s in (r["named"], *r["rivals"])]
        said = f"{r['verdict']} {' or '.join(sets[:3])}".strip()
        sheets = ", ".join(r["held_sheets"])
        said += f"; off its data sheet: {sheets}" if sheets else ""
        lines.append(
            f"| {case_name(r)} | {r['rig']} | {hidden}{denied} | {r['lambda']:.1f} | "
            f"{r['trouble'] or 'clean'} | {r['outcome']} | {said} |"
        )
    return lines


def case_name(row: Row) -> str:
    """Name of a case, from which it can be made again."""
    return f"{row['domain']}_{row['index']:04d}"


COLUMNS = ("domain", "index", "rig", "kind", "hidden", "size", "lambda", "trouble", "denies",
           "verdict", "named", "rivals", "outcome", "is_certain", "sizes", "simulations",
           "cpu_s")  # fmt: skip


def csv_text(rows: Sequence[Row]) -> str:
    """One line per case, for others to count."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        writer.writerow([_cell(row[name]) for name in COLUMNS])
    return out.getvalue()


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        return ";".join(
            f"{n}={s['true']:.4g} in {s['low']:.4g} to {s['high']:.4g}" for n, s in value.items()
        )
    if isinstance(value, list):
        return ";".join("+".join(v) if isinstance(v, list) else _cell(v) for v in value)
    return str(value)
