"""One case from its draw to its score: recorded, diagnosed by the command as by anybody, held."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from labs.unlisted.catalog import KINDS
from labs.unlisted.draw import drawn
from labs.unlisted.record import CLEAN, STUDY, TRUTH, recorded, write
from labs.unlisted.score import scored

Item = Mapping[str, Any]
CASES, ANSWER, MODEL = "cases", "answer", "extended_model.yaml"
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
    errors, failure = errors_without_noise(folder)
    return {**item, **judged(folder, report, errors), "cpu_s": cpu, "judge_failure": failure}


def judged(
    folder: Path, report: Mapping[str, Any], errors: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Facts of a recorded case with the score of an answer.

    Args:
        folder: Of the case.
        report: The answer.
        errors: Of its extended model on unseen runs without noise.
    """
    truth = yaml.safe_load((folder / TRUTH).read_text(encoding="utf-8"))
    facts = {name: truth[name] for name in ("case", "group", "machine", "dirt", "size", "lambda")}
    return {**facts, **scored(truth, report, errors)}


def diagnosed(folder: Path, effort: str) -> tuple[dict[str, Any], float]:
    """The answer to a recorded case, and its CPU time [s]; an error is an answer, too.

    Args:
        folder: Of the case.
        effort: Budget of the diagnosis.
    """
    report = folder / ANSWER / "report.json"
    report.unlink(missing_ok=True)
    (folder / ANSWER / MODEL).unlink(missing_ok=True)
    before = _seconds_of_children()
    log = _command(folder, "explain", STUDY, "--budget", effort, "--force")
    cpu = _seconds_of_children() - before
    if not report.is_file():
        return {"verdict": "failed", "error": log[-1] if log else "nothing was said"}, cpu
    return json.loads(report.read_text(encoding="utf-8")), cpu


def errors_without_noise(folder: Path) -> tuple[list[dict[str, Any]], str]:
    """Errors on the unseen runs without noise, before and after, and why there are none.

    The noise of a test run would move the share that a true model removes by a fifth.

    Args:
        folder: Of a case that was diagnosed.
    """
    model, judge = folder / ANSWER / MODEL, folder / ANSWER / "judge.json"
    judge.unlink(missing_ok=True)
    if not model.is_file():
        return [], ""
    log = _command(folder, "judge", CLEAN, "--model", str(model))
    if not judge.is_file():
        return [], " ".join(log)
    return json.loads(judge.read_text(encoding="utf-8"))["errors"], ""


def _command(folder: Path, verb: str, study: str, *more: str) -> list[str]:
    """What a command of the diagnosis says, line by line; its results are in the answer."""
    answer = folder / ANSWER
    answer.mkdir(parents=True, exist_ok=True)
    words = [sys.executable, "-m", "diffsim", "diagnose", verb, str(folder / study)]
    path = answer / f"{verb}.log"
    with path.open("w", encoding="utf-8") as log:
        one = dict.fromkeys(THREADS, "1")
        subprocess.run(
            [*words, "--out", str(answer), *more],
            stdout=log, stderr=subprocess.STDOUT, env={**os.environ, **one},
        )  # fmt: skip
    return path.read_text(encoding="utf-8").strip().splitlines()


def _seconds_of_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def in_order(row: Mapping[str, Any]) -> tuple[int, int]:
    """Place of a case on the page."""
    return list(KINDS).index(row["kind"]), int(row["turn"])
