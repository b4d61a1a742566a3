"""The page of a run: how it was made, rates beside their goals, reliability, what went wrong."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from diffsim.core.files import write_text_atomic
from diffsim.viz.figures import COLORS, INK, LINE, SOFT, new_figure
from labs.rates.draw import DENIED
from labs.rates.table import (
    Bin,
    Row,
    band_lines,
    csv_text,
    outcome_table,
    rate_tables,
    reliability,
    wrong_lines,
)

COMMAND = "python -m labs.rates"


def write_page(rows: Sequence[Row], plan: Mapping[str, Any], path: Path) -> Path:
    """Write the page, its chart (.svg) and one line per case (.csv) beside it.

    Args:
        rows: Finished cases.
        plan: Commit, seed, effort and machine of the run.
        path: File of the page.
    """
    chart = path.with_suffix(".svg")
    write_chart(rows, chart)
    write_text_atomic(path.with_suffix(".csv"), csv_text(rows))
    return write_text_atomic(path, "\n".join(_lines(rows, plan, path.stem)) + "\n")


def _lines(rows: Sequence[Row], plan: Mapping[str, Any], stem: str) -> list[str]:
    counts = Counter(r["domain"] for r in rows)
    domains = ", ".join(f"{n} {domain}" for domain, n in counts.items())
    again = f"{COMMAND} --master {plan['master']} --effort {plan['effort']}"
    again += " --far" if plan.get("far") else ""
    again += f" --domain {','.join(counts)} --n {max(counts.values(), default=0)} --out FOLDER"
    lines = [
        "# Rates of right and wrong answers",
        "",
        *_how(plan),
        "",
        f"{len(rows)} cases ({domains}), a third with nothing hidden, a third with a cause of the "
        "library, a third with a cause that the library is denied. Lambda is the visibility of the "
        "hidden cause, wanted log-uniformly from 3 to 30; lambda^2 / 2 are the nats that naming it "
        f"can gain. Each case follows from commit, master seed, domain and number; [{stem}.csv]"
        f"({stem}.csv) has a line for each.",
        "",
        "```sh",
        again,
        "```",
        "",
        *rate_tables(rows),
        "",
        "Bounds are Clopper and Pearson's. An outcome is *right* where the cause is named alone, "
        "where nothing is hidden and nothing said, and where a denied cause is `unknown`; "
        "*ambiguous* where the truth is in the set, or a look-alike of a denied cause is not said "
        "to be certain. *Certain wrong* is a cause, or a data sheet, that is said to be certain "
        "and is not. CPU seconds are the median of a diagnosis.",
        "",
        *outcome_table(rows),
        "",
        "## Reliability",
        "",
        f"![Stated probability against frequency]({stem}.svg)",
        "",
        "| stated probability | library | frequency | all, denied too | frequency |",
        "|---|---|---|---|---|",
        *_reliability_lines(rows),
    ]
    bands = band_lines(rows)
    if bands:
        lines += ["", "## Bands", "", "Readings of unseen runs inside their 90 % band.", "", *bands]
    wrong = wrong_lines(rows)
    if wrong:
        lines += ["", "## Certain wrong, and false alarms", "", *wrong]
    return lines


def _how(plan: Mapping[str, Any]) -> list[str]:
    sealed = (
        "**Sealed**: the master seed was drawn by the command, from a clean commit."
        if plan["sealed"]
        else "**A rehearsal, not sealed**: " + plan["why_not_sealed"]
    )
    machine, missing = plan["machine"], ", ".join(plan["left_out"])
    return [
        f"{sealed} Commit {plan['commit'][:10]}, master seed {plan['master']}, effort "
        f"{plan['effort']}, {plan['date']}; {machine['cpu']}, {machine['cores']} cores, "
        f"{machine['instruction_set']}, torch {machine['torch']}, numpy {machine['numpy']}."
        + (f" Left out, as not installed: {missing}." if missing else "")
    ]


def _reliability_lines(rows: Sequence[Row]) -> list[str]:
    known = {b.low: b for b in reliability([r for r in rows if r["kind"] != DENIED])}
    lines = []
    for b in reliability(rows):
        own = known.get(b.low)
        first = f"{own.count} | {own.hits / own.count:.2f}" if own else " | "
        lines.append(f"| {b.low:g} to {b.high:g} | {first} | {b.count} | {b.hits / b.count:.2f} |")
    return lines


def write_chart(rows: Sequence[Row], path: Path) -> None:
    """Draw the stated probability of causes against how often they act."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    figure, ax = new_figure(width=4.8, height=4.4)
    ax.plot([0.0, 1.0], [0.0, 1.0], color=LINE, lw=1.2)
    known = [r for r in rows if r["kind"] != DENIED]
    for part, label, role in (
        (rows, "with denied causes", "published"),
        (known, "nothing hidden, or a cause of the library", "fitted"),
    ):
        _draw_bins(ax, reliability(part), label, COLORS[role])
    ax.set_xlabel("stated probability of a cause", color=SOFT)
    ax.set_ylabel("share that acts (90 % bounds)", color=SOFT)
    ax.set_xlim(-0.02, 1.02)
    ax.set_ylim(-0.02, 1.02)
    # above the axes: bounds of few cases reach everywhere
    ax.legend(frameon=False, fontsize=8.5, labelcolor=INK, loc="lower left", bbox_to_anchor=(0, 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasSVG(figure).print_svg(str(path), metadata={"Date": None})


def _draw_bins(ax: Any, bins: Sequence[Bin], label: str, color: str) -> None:
    x = [b.mean for b in bins]
    y = [b.hits / b.count for b in bins]
    ends = [[v - b.bounds[0] for v, b in zip(y, bins, strict=True)],
            [b.bounds[1] - v for v, b in zip(y, bins, strict=True)]]  # fmt: skip
    ax.errorbar(x, y, yerr=ends, color=color, label=label, fmt="o-", ms=4, lw=1.2, capsize=2)
