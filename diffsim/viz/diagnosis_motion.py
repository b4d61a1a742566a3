"""What moved in the test runs, to turn and play: measured, and simulated before and after."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from diffsim.core.arrays import Array
from diffsim.diagnose.say.report import Report
from diffsim.identify import Fit, MovingShape
from diffsim.viz.charts import EXTENDED, NULL
from diffsim.viz.diagnosis_series import PredictedRun
from diffsim.viz.figures import INK
from diffsim.viz.moving import FRAME_RATE, MAX_TRIANGLES, Deforming, Moving, MovingChoice

MAX_RUNS = 12  # in the menu
_THROUGH = 0.45  # opacity of the model before, which the others show through
_MEASURED, _BEFORE, _AFTER = "measured", "model before", "extended model"
_COLORS = {_MEASURED: INK, _BEFORE: NULL, _AFTER: EXTENDED}


def moving_runs(report: Report, runs: Sequence[PredictedRun]) -> MovingChoice | None:
    """Bodies or vehicles of runs, the models on top of each other; None where nothing is to see.

    Args:
        report: The diagnosis, with its fits.
        runs: Runs with their predictions.
    """
    views = {}
    for run in runs[:MAX_RUNS]:
        shapes = _shapes(report, run)
        if shapes and (view := _view(run, shapes)) is not None:
            views[run.name] = view
    if not views:
        return None
    more = f" The first {MAX_RUNS} of {len(runs)} runs." if len(runs) > MAX_RUNS else ""
    caption = (
        "One body drawn as each of them has it; a button hides what it names. Drag to turn, wheel "
        f"to zoom, Shift and drag to move.{more}"
    )
    return MovingChoice(views=views, caption=caption)


def _shapes(report: Report, run: PredictedRun) -> dict[str, MovingShape]:
    """Surfaces by name, of what channels tell or what is simulated."""
    model = report.null.problem.model
    shapes: dict[str, MovingShape | None] = {
        _MEASURED: model.shape_of(run, torch.from_numpy(run.measured)),
        _BEFORE: _simulate_shape(report.null, run, run.null, run.null_at),
    }
    if run.extended is not None:
        shapes[_AFTER] = _simulate_shape(report.best, run, run.extended, run.extended_at)
    return {name: shape for name, shape in shapes.items() if shape is not None}


def _simulate_shape(
    fit: Fit, run: PredictedRun, channels: Array, at: Array | None
) -> MovingShape | None:
    """By one more simulation where that tells more than channels, else by the predicted ones."""
    shape = None if at is None else fit.problem.shape_at(run, torch.as_tensor(at))
    if shape is not None:
        return shape
    return fit.problem.model.shape_of(run, torch.from_numpy(channels))


def _view(run: PredictedRun, shapes: dict[str, MovingShape]) -> Moving | None:
    """At most ``FRAME_RATE``, where all that is shown is known."""
    known = np.all([np.isfinite(s.nodes_m).all((1, 2)) for s in shapes.values()], axis=0)
    frames = np.flatnonzero(known)
    if not len(frames) or sum(len(s.triangles) for s in shapes.values()) > MAX_TRIANGLES:
        return None
    slots = np.floor((run.time_s[frames] - run.time_s[frames[0]]) * FRAME_RATE + 1e-6)
    kept = frames[np.unique(slots, return_index=True)[1]]
    parts = [
        Deforming(
            name=name,
            color=_COLORS[name],
            triangles=s.triangles,
            nodes_m=s.nodes_m[kept],
            closed=s.closed,
            opacity=_THROUGH if name == _BEFORE and len(shapes) > 1 else 1.0,
        )
        for name, s in shapes.items()
    ]
    return Moving(time_s=run.time_s[kept], parts=parts, caption="")
