"""Tables of what a saved model says of new runs, beside what was measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.files import write_text_atomic
from diffsim.data.shown import shown
from diffsim.data.study import Run, Study
from diffsim.diagnose.judge.unseen import Unseen

FOLDER = "judged"
MODELS = ("measured", "before", "after")


def write_judged(out: Path, study: Study, found: Unseen) -> list[Path]:
    """One CSV file per judged run: time, and each channel as measured, before and after.

    Args:
        out: Folder of the results.
        study: Study that holds the runs.
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
    rows = [
        ",".join(f"{v:.9g}" if np.isfinite(v) else "" for v in row)
        for row in zip(*columns, strict=True)
    ]
    return "\n".join([",".join(header), *rows]) + "\n"


def file_name(name: str) -> str:
    """The run's name, what divides folders encoded: another one for every run."""
    return name.replace("%", "%25").replace("/", "%2F").replace("\\", "%5C")
