"""One case from its draw to its score: recorded, diagnosed by the command as by anybody, held."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from labs.unlisted.catalog import KINDS
from labs.unlisted.draw import drawn
from labs.unlisted.record import STUDY, TRUTH, recorded, write
from labs.unlisted.score import scored

Item = Mapping[str, Any]
CASES, ANSWER = "cases", "answer"
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def items(kinds: tuple[str, ...], count: int, plan: Mapping[str, Any]) -> dict[str, Item]:
    """Cases by name, each kind once before any comes again.

    Args:
        kinds: Of ``KINDS``.
        count: Number of cases.
        plan: Of the run, with ``master``, ``commit`` and ``effort``.
    """
    same = {name: plan[name] for name in ("master", "commit", "effort")}
    return {
        f"{kinds[k % len(kinds)]}_{k // len(kinds)}": {
            **same, "kind": kinds[k % len(kinds)], "turn": k // len(kinds)
        }
        for k in range(count)
    }  # fmt: skip


def solve(item: Item, out: Path) -> dict[str, Any]:
    """Record a case, diagnose it in a process of its own, and score the answer.

    Args:
        item: ``master``, ``kind``, ``turn`` and ``effort`` of the case.
        out: Folder of the run; all files of the case stay below it.
    """
    folder = out / CASES / f"{item['kind']}_{item['turn']}"
    write(recorded(drawn(item["master"], item["kind"], item["turn"])), folder)
    report, cpu = diagnosed(folder, item["effort"])
    return {**item, **judged(folder, report), "cpu_s": cpu}


def judged(folder: Path, report: Mapping[str, Any]) -> dict[str, Any]:
    """Facts of a recorded case with the score of an answer.

    Args:
        folder: Of the case.
        report: The answer.
    """
    truth = yaml.safe_load((folder / TRUTH).read_text(encoding="utf-8"))
    facts = {name: truth[name] for name in ("case", "group", "machine", "dirt", "size", "lambda")}
    return {**facts, **scored(truth, report)}


def diagnosed(folder: Path, effort: str) -> tuple[dict[str, Any], float]:
    """The answer to a recorded case, and its CPU time [s]; an error is an answer, too.

    Args:
        folder: Of the case.
        effort: Budget of the diagnosis.
    """
    answer = folder / ANSWER
    answer.mkdir(parents=True, exist_ok=True)
    report = answer / "report.json"
    report.unlink(missing_ok=True)
    command = [sys.executable, "-m", "diffsim", "diagnose", "explain", str(folder / STUDY),
               "--out", str(answer), "--budget", effort, "--force"]  # fmt: skip
    before = _seconds_of_children()
    with (answer / "log.txt").open("w", encoding="utf-8") as log:
        one = dict.fromkeys(THREADS, "1")
        subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, env={**os.environ, **one})
    cpu = _seconds_of_children() - before
    if not report.is_file():
        lines = (answer / "log.txt").read_text(encoding="utf-8").strip().splitlines()
        return {"verdict": "failed", "error": lines[-1] if lines else "nothing was said"}, cpu
    return json.loads(report.read_text(encoding="utf-8")), cpu


def _seconds_of_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def in_order(row: Mapping[str, Any]) -> tuple[int, int]:
    """Place of a case on the page."""
    return list(KINDS).index(row["kind"]), int(row["turn"])
