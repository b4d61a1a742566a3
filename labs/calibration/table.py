"""The table of thresholds: what each decides, who chose it, what changes when it is moved."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from labs.calibration.answers import BRIEF, variant
from labs.calibration.thresholds import FACTORS, Threshold, listed
from labs.rates.score import ALARM, CERTAIN_WRONG, HELD, RIGHT

Answers = Mapping[str, Mapping[str, Any]]
COUNTED = {"right": (RIGHT, HELD), "certain wrong": (CERTAIN_WRONG,), "false alarm": (ALARM,)}


def moved(plain: Answers, other: Answers) -> dict[str, int]:
    """What changes from the answers as they are to those with a threshold moved.

    Args:
        plain: Answers by case.
        other: Answers by case, some or all of these.
    """
    both = [(plain[case], other[case]) for case in other]
    out = {"answered": len(both)}
    out["verdicts"] = sum(a["verdict"] != b["verdict"] for a, b in both)
    out["words"] = sum(any(a[name] != b[name] for name in BRIEF) for a, b in both)
    for name, outcomes in COUNTED.items():
        out[name] = sum(b["outcome"] in outcomes for _, b in both) - sum(
            a["outcome"] in outcomes for a, _ in both
        )
    return out


def page(
    found: Mapping[str, Answers],
    cases: Mapping[str, Any],
    options: Mapping[str, Any],
    commit: str,
) -> str:
    """The table with how it was made, in Markdown.

    Args:
        found: Answers by variant and case, "plain" among the variants.
        cases: Cases by name.
        options: Of the command.
        commit: Of the code.
    """
    command = f"python -m labs.calibration --domain {','.join(options['domain'])}"
    command += f" --n {options['n']} --master {options['master']} --effort {options['effort']}"
    rows = [(t, [_moved(found, t, factor) for factor in FACTORS]) for t in listed()]
    done = [(t, moves) for t, moves in rows if all(moves)]
    still = [t for t, moves in done if not any(m["words"] for m in moves if m)]
    lines = [
        "# Thresholds, halved and doubled",
        "",
        f"{len(cases)} cases of [`labs.rates`](rates.md), commit {commit[:10]}: each threshold "
        "that decides verdicts is halved and doubled in turn, and all cases are answered again. A "
        "share close to one is moved by what is left to one. *Changed* is how many verdicts "
        "differ, in brackets how many answers differ at all; then come the changes of the numbers "
        "of right (alone or in the set), certain wrong, and false alarms.",
        "",
        "```sh",
        f"{command} --out FOLDER --page docs/measured/thresholds.md",
        "```",
        "",
        f"{len(done)} of {len(rows)} thresholds are counted; {len(still)} of these change no "
        "answer at all.",
        "",
        "| threshold | is | decides | chosen by | halved: changed, right, wrong, alarms "
        "| doubled: changed, right, wrong, alarms |",
        "|---|---|---|---|---|---|",
        *(_line(t, moves) for t, moves in rows),
    ]
    return "\n".join(lines) + "\n"


def _moved(
    found: Mapping[str, Answers], threshold: Threshold, factor: float
) -> dict[str, int] | None:
    answers = found.get(variant(threshold, factor))
    return moved(found["plain"], answers) if answers else None


def _line(threshold: Threshold, moves: list[dict[str, int] | None]) -> str:
    value = threshold.value
    shown = f"{value:g}" if isinstance(value, (int, float)) else str(value)
    cells = [f"`{threshold.key}`", shown, threshold.decides, threshold.chosen or "not recorded"]
    return "| " + " | ".join([*cells, *map(_cell, moves)]) + " |"


def _cell(move: dict[str, int] | None) -> str:
    if move is None:
        return "–"
    counts = ", ".join(f"{move[name]:+d}" if move[name] else "0" for name in COUNTED)
    return f"{move['verdicts']} ({move['words']}) of {move['answered']}, {counts}"
