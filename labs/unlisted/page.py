"""The page of a run: rates beside their goals, and one line for each case."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.core.files import write_text_atomic
from labs.rates.table import Rate
from labs.unlisted.catalog import LISTED, SOUND, UNLISTED

Row = Mapping[str, Any]
COMMAND = "python -m labs.unlisted"


def rates(rows: Sequence[Row]) -> list[Rate]:
    """What the goals are about.

    Args:
        rows: Scored cases.
    """
    hidden = [r for r in rows if r["group"] == UNLISTED]
    sound = [r for r in rows if r["group"] == SOUND]
    inside = [n["inside"] for r in hidden for n in r["sizes"].values()]
    return [
        _rate("place and variable right", ">= 85 %",
              [r["place"] and r["variable"] for r in hidden]),
        _rate("place right", "", [r["place"] for r in hidden]),
        _rate("variable right", "", [r["variable"] for r in hidden]),
        _rate("form right", ">= 65 %", [r["form"] for r in hidden]),
        _rate("sizes in their 90 % interval", ">= 85 %", inside),
        _rate("certain and wrong", "<= 3 %", [bool(r["certain_and_wrong"]) for r in rows]),
        _rate("80 % of the error above the noise removed on unseen runs", ">= 75 %",
              [r["removed"] for r in hidden]),
        _rate("not `none` where nothing is hidden", "<= 2 %", [r["false_find"] for r in sound]),
        _rate("a law or a cause where nothing is hidden", "", [r["false_name"] for r in sound]),
        _rate("name kept where the library has the cause", "all",
              [r["name_kept"] for r in rows if r["group"] == LISTED]),
        _rate("extended model that cannot be judged", "none",
              [bool(r["judge_failure"]) for r in rows if r["group"] != SOUND]),
        _rate("no answer", "none", [r["verdict"] == "failed" for r in rows]),
    ]  # fmt: skip


def _rate(what: str, goal: str, hits: Sequence[bool | None]) -> Rate:
    return Rate(what, goal, sum(bool(hit) for hit in hits), len(hits))


def write_page(rows: Sequence[Row], plan: Mapping[str, Any], path: Path) -> Path:
    """Write the page of a run.

    Args:
        rows: Scored cases.
        plan: Commit, master seed, effort and machine of the run.
        path: File of the page.
    """
    return write_text_atomic(path, "\n".join(_lines(rows, plan)) + "\n")


def _lines(rows: Sequence[Row], plan: Mapping[str, Any]) -> list[str]:
    counts = {g: sum(r["group"] == g for r in rows) for g in (UNLISTED, LISTED, SOUND)}
    kinds = len({r["kind"] for r in rows if r["group"] == UNLISTED})
    sealed = (
        "**Sealed**: the master seed was drawn by the command, from a clean commit."
        if plan["sealed"]
        else f"**A rehearsal, not sealed**: {plan['why_not_sealed']}"
    )
    machine = plan["machine"]
    return [
        "# Causes that no library lists",
        "",
        f"{sealed} Commit {plan['commit'][:10]}, master seed {plan['master']}, effort "
        f"{plan['effort']}, {plan['date']}; {machine['cpu']}, {machine['cores']} cores, "
        f"{machine['instruction_set']}.",
        "",
        f"{len(rows)} cases: {counts[UNLISTED]} of {kinds} kinds hide a law that the library "
        f"lacks, {counts[LISTED]} one that it has, {counts[SOUND]} nothing. Recordings are "
        "computed in plain numpy by code that the package does not share; their truth lies "
        "outside of what the command is shown. Lambda is the misfit of the fitted plain model to "
        "the runs to fit, in noise sd, drawn log-uniformly from 20 to 60.",
        "",
        "```sh",
        f"{COMMAND} --seed {plan['master']} --effort {plan['effort']} --cases {len(rows)} "
        "--out FOLDER",
        "```",
        "",
        "| figure | goal | measured (90 % bounds) |",
        "|---|---|---|",
        *(f"| {r.what} | {r.goal} | {r.words} |" for r in rates(rows) if r.count),
        *_cpu_lines(rows),
        "",
        "Bounds are Clopper and Pearson's. A form counts where place and variable are right, sizes "
        "where the form is. *Certain and wrong* is a law with another place or variable, a cause "
        "of the library that is not the one hidden, or a data sheet far from the truth. What is "
        "removed is held against unseen runs without noise.",
        "",
        "## Cases",
        "",
        "| case | machine | lambda | verdict | place | variable | form | sizes inside | removed | "
        "CPU s | said |",
        "|---" * 11 + "|",
        *(_case_line(r) for r in rows),
    ]


def _cpu_lines(rows: Sequence[Row]) -> list[str]:
    if not rows:
        return []
    lines = [f"| CPU s of an answer, median | | {np.median([r['cpu_s'] for r in rows]):.0f} |"]
    extra = [r["extra_cpu_s"] for r in rows if r["extra_cpu_s"] is not None]
    if extra:
        lines.append(
            f"| CPU s of the search for laws, median and most | <= 180 | {np.median(extra):.0f}, "
            f"{max(extra):.0f} |"
        )
    return lines


def _case_line(row: Row) -> str:
    if row["group"] == UNLISTED:
        marks = [_mark(row[name]) for name in ("place", "variable", "form")]
    else:
        is_right = row["name_kept"] if row["group"] == LISTED else not row["false_find"]
        marks = [_mark(is_right), "", ""]
    inside = [n["inside"] for n in row["sizes"].values()]
    sizes = f"{sum(inside)} of {len(inside)}" if inside else ""
    removed = "" if row["share_removed"] is None else f"{row['share_removed']:.0%}"
    wrong = "; ".join(row["certain_and_wrong"])
    said = row["said"].replace("|", "\\|") + (f" **certain and wrong: {wrong}**" if wrong else "")
    return (
        f"| {row['case']} | {row['machine']} | {row['lambda']:.0f} | {row['verdict']} | "
        f"{' | '.join(marks)} | {sizes} | {removed} | {row['cpu_s']:.0f} | {said} |"
    )


def _mark(is_right: bool | None) -> str:
    return "yes" if is_right else "**no**"
