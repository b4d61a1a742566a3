"""The files of an explanation, and which are lacking; tables of what a model says of new runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.figures import figure
from diffsim.core.files import csv_text, write_text_atomic
from diffsim.data.shown import shown
from diffsim.data.study import Run, Study
from diffsim.diagnose.judge.records import CERTAIN, LIKELY
from diffsim.diagnose.judge.unseen import Unseen
from diffsim.identify.model_file import MODEL_FILE

INPUTS_FILE, REPORT_FILE = "inputs.json", "report.json"
PAGE_FILE, RECORDING_FILE = "report.html", "runs.rrd"
NEEDS = {PAGE_FILE: "matplotlib", RECORDING_FILE: "rerun"}
"""Packages of the ``viz`` extra that pictures need; results need none."""


def lacking(out: Path, before: Mapping[str, Any] | None) -> list[str]:
    """Files that an explanation should have and has not: a run is finished when all are there.

    Args:
        before: Content of its ``inputs.json``, which is written last; None: there is none.

    Returns:
        Names of files. A picture that could not be drawn counts once its package is installed.
    """
    if before is None:
        return [INPUTS_FILE]
    undrawn = before.get("not_drawn", ())
    return [
        name
        for name in (REPORT_FILE, MODEL_FILE, PAGE_FILE, RECORDING_FILE)
        if not (out / name).is_file() and not (name in undrawn and find_spec(NEEDS[name]) is None)
    ]


def against_before(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """What an answer adds to the one that stood in its folder, in a sentence; nothing without one.

    Args:
        before: Content of its ``report.json``.
    """
    if "causes" not in before:
        return ""
    was, now = (
        {row["name"]: row for row in answer["causes"] if row["status"] in (CERTAIN, LIKELY)}
        for answer in (before, after)
    )
    said = []
    if before["verdict"] != after["verdict"]:
        said.append(f"verdict {after['verdict']}, was {before['verdict']}")
    for name, row in now.items():
        if name not in was:
            said.append(f"{row['words']} is {row['status']}, was not named")
        elif was[name]["status"] != row["status"]:
            said.append(f"{row['words']} is {row['status']}, was {was[name]['status']}")
    said += [f"{row['words']} is not named any more" for n, row in was.items() if n not in now]
    said = list(dict.fromkeys(said)) or ["the same verdict and causes"]
    left, left_before = (_times_noise(answer["errors"]) for answer in (after, before))
    if left is not None and left_before is not None:
        said.append(f"unseen error {figure(left)} times the noise, was {figure(left_before)}")
    return f"Against the answer before: {'; '.join(said)}."


def _times_noise(errors: Sequence[Mapping[str, Any]]) -> float | None:
    """Error over all runs of the kind of channel that is worst, over its noise; None: no runs."""
    sums: dict[str, list[float]] = {}
    for row in errors:
        of = sums.setdefault(f"{row['kind']} {row['unit']}", [0.0, 0.0])
        of[0] += row["num_samples"] * row["after"] ** 2
        of[1] += row["num_samples"] * row["noise"] ** 2
    return max(((a / n) ** 0.5 for a, n in sums.values() if n > 0.0), default=None)


def is_drawn(write: Callable[[], Path]) -> bool:
    """Whether it was written: pictures need packages of the ``viz`` extra; results do not."""
    try:
        print(f"wrote {write()}")
    except ImportError as error:
        print(f"not drawn: {error}")
        return False
    return True


FOLDER = "judged"
MODELS = ("measured", "before", "after")


def write_judged(out: Path, study: Study, found: Unseen) -> list[Path]:
    """One CSV file per judged run: time, and each channel as measured, before and after.

    Args:
        out: Folder of the results.
        found: Answer about them.

    Returns:
        Files, in the order of the runs; none for a run that could not be simulated.
    """
    by_name = {run.name: run for run in study.runs}
    return [
        write_text_atomic(
            out / FOLDER / f"{file_name(name)}.csv", _table(by_name[name], study, *said)
        )
        for name, said in found.predicted.items()
    ]


def _table(run: Run, study: Study, before: Array, after: Array) -> str:
    """Header and rows; an empty cell was not measured."""
    header, columns = ["time_s"], [run.time_s]
    for c, channel in enumerate(study.channels):
        unit = channel.shown_unit or channel.unit
        of_unit = "" if unit == "-" else f" ({unit})"
        header += [f"{channel.name} {what}{of_unit}" for what in MODELS]
        columns += [shown(channel, values[:, c]) for values in (run.measured, before, after)]
    rows = ((v if np.isfinite(v) else "" for v in row) for row in zip(*columns, strict=True))
    return csv_text(header, rows, ".9g")


def file_name(name: str) -> str:
    """The run's name, what divides folders encoded: another one for every run."""
    return name.replace("%", "%25").replace("/", "%2F").replace("\\", "%5C")
