"""A diagnosis as a rerun recording: every run's channels, measured and predicted, on one clock."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from diffsim.data.study import Run
from diffsim.diagnose.say.report import Report
from diffsim.viz.diagnosis_series import predicted
from diffsim.viz.figures import COLORS, INK
from diffsim.viz.scene import rgb, write_recording

_CLOCK = "time"


def write_recording_of(report: Report, path: str | Path) -> Path:
    """Write the ``.rrd``; a tab per run, a plot per channel and one of the commands.

    Entities: ``RUN/CHANNEL/measured``, ``.../null``, and ``.../extended`` where effects were named;
    ``RUN/command/NAME``, each part escaped.

    Raises:
        ImportError: rerun-sdk is not installed.
    """
    runs = (*report.study.fit_runs, *report.study.test_runs)

    def log(rr: Any, stream: Any) -> None:
        note = f"# Diagnosis of {report.study.name}\n\n**{report.verdict}**\n\n"
        text = rr.TextDocument(note + "\n\n".join(report.sentences), media_type="text/markdown")
        stream.log("note", text, static=True)
        for run in runs:
            _write_run(rr, stream, report, run)
        stream.send_blueprint(_blueprint(report, runs))

    return write_recording(path, f"diagnosis of {report.study.name}", log)


def _write_run(rr: Any, stream: Any, report: Report, run: Run) -> None:
    curves = {
        "measured": (run.measured, INK),
        "null": (predicted(report.null, run), COLORS["published"]),
    }
    if report.named:
        curves["extended"] = (predicted(report.best, run), COLORS["fitted"])
    for i, channel in enumerate(report.study.channels):
        for label, (record, color) in curves.items():
            name = f"{label} [{channel.unit}]"
            path = rr.new_entity_path([run.name, channel.name, label])
            _curve(rr, stream, path, run.time_s, record[:, i], name, color)
    for name, values in run.command.items():
        path = rr.new_entity_path([run.name, "command", name])
        _curve(rr, stream, path, run.time_s, values, name, COLORS["measured_2"])


def _curve(
    rr: Any, stream: Any, path: str, time_s: Any, values: Any, name: str, color: str
) -> None:
    valid = np.isfinite(values)
    stream.log(path, rr.SeriesLines(colors=[rgb(color)], names=[name]), static=True)
    if valid.any():
        stream.send_columns(
            path,
            indexes=[rr.TimeColumn(_CLOCK, duration=time_s[valid])],
            columns=rr.Scalars.columns(scalars=values[valid]),
        )


def _blueprint(report: Report, runs: Any) -> Any:
    """A tab per run; without it all curves of all runs would share one plot."""
    import rerun as rr
    import rerun.blueprint as rrb

    tabs = []
    for run in runs:
        names = [*(c.name for c in report.study.channels), *(["command"] if run.command else [])]
        origins = {n: rr.new_entity_path([run.name, n]) for n in names}
        views = [rrb.TimeSeriesView(origin=path, name=n) for n, path in origins.items()]
        label = f"{run.name} (test)" if run.use == "test" else run.name
        tabs.append(rrb.Vertical(*views, name=label))
    note = rrb.TextDocumentView(origin="/note", name="verdict")
    return rrb.Blueprint(rrb.Tabs(note, *tabs), collapse_panels=True)
