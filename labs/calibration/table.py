"""The table of thresholds: what each decides, who chose it, what changes when it is moved."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from labs.calibration.answers import BRIEF
from labs.calibration.thresholds import FACTORS, Threshold, listed, variant
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
    first: Mapping[str, Any],
    again: Mapping[str, Answers],
    options: Mapping[str, Any],
    commit: str,
) -> str:
    """The table with how it was made, in Markdown.

    Args:
        first: What was followed, by case: the ``plain`` answer, and variants ``asked`` for.
        again: Answers by variant and case.
        options: Of the command.
        commit: Of the code.
    """
    rows = [(t, [_count(first, again, variant(t, f)) for f in FACTORS]) for t in listed()]
    silent = [t for t, counts in rows if not any(c["asked"] for c in counts)]
    still = [t for t, counts in rows if t not in silent and not any(c["words"] for c in counts)]
    whole = sum(result["followed"] for result in first.values())
    lines = [
        "# Thresholds, halved and doubled",
        "",
        f"{len(first)} cases of [`labs.rates`](rates.md) ({_domains(first)}), "
        f"commit {commit[:10]}. Each threshold that decides verdicts is followed through the first "
        "answer to each case, at half its value, at its value and at double. Where it is not read, "
        "or every comparison falls on one side at all three, it cannot change the answer. Where it "
        f"may, the first {options['again']} cases are answered again with it. {whole} cases could "
        "be followed; the others count as asked by all.",
        "",
        "A share close to one is moved by what is left to one. *May change* is in how many cases "
        "it is asked so; *changed* how many verdicts differ of those answered again, in brackets "
        "how many answers differ at all; then come the changes of the numbers of right (alone or "
        "in the set), certain wrong, and false alarms.",
        "",
        "```sh",
        _command(options),
        "```",
        "",
        f"All {len(rows)} thresholds are counted. {len(silent)} are asked by no case, {len(still)} "
        f"change no answer of those that ask, {len(rows) - len(silent) - len(still)} change some.",
        "",
        "| threshold | is | decides | chosen by | may change, halved "
        "| changed, right, wrong, alarms | may change, doubled | changed, right, wrong, alarms |",
        "|---|---|---|---|---|---|---|---|",
        *(_line(t, counts) for t, counts in rows),
    ]
    return "\n".join(lines) + "\n"


def _command(options: Mapping[str, Any]) -> str:
    n = ",".join(map(str, options["n"]))
    return (
        f"python -m labs.calibration --domain {','.join(options['domain'])} --n {n} "
        f"--again {options['again']} --master {options['master']} --effort {options['effort']} "
        "--out FOLDER --page studies/records/thresholds.md"
    )


def _domains(first: Mapping[str, Any]) -> str:
    counts = Counter(name.rpartition("_")[0] for name in first)
    return ", ".join(f"{count} {domain}" for domain, count in counts.items())


def _count(first: Mapping[str, Any], again: Mapping[str, Answers], name: str) -> dict[str, int]:
    """What a variant changes, and by how many cases it is ``asked``."""
    plain = {case: result["plain"] for case, result in first.items()}
    may = sum(name in result["asked"] for result in first.values())
    return {**moved(plain, again.get(name, {})), "asked": may}


def _line(threshold: Threshold, counts: list[dict[str, int]]) -> str:
    cells = [f"`{threshold.key}`", f"{threshold.value:g}", threshold.decides]
    cells.append(threshold.chosen or "not recorded")
    return "| " + " | ".join([*cells, *(cell for c in counts for cell in _cells(c))]) + " |"


def _cells(count: Mapping[str, int]) -> tuple[str, str]:
    if not count["answered"]:
        return f"{count['asked']}", "–"
    right = ", ".join(f"{count[name]:+d}" if count[name] else "0" for name in COUNTED)
    return (
        f"{count['asked']}",
        f"{count['verdicts']} ({count['words']}) of {count['answered']}, {right}",
    )
