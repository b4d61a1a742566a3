"""The loop's identification on the measured starfish (``import_starfish()``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from diffsim.data.study import Run, Study
from labs.loop.command import RATE_HZ
from labs.loop.identification import FitSettings, identify
from labs.loop.model import CHANNELS, Starfish, as_displacements, displacements
from labs.loop.recordings import COMMAND

SPACING_M = 0.0762  # of the markers m2 and m3, nominal
BEFORE_S = 0.2  # windows begin that long before the command does
FIT_RUN = "baseline"
HELD_OUT = ("horizontal_cyclic3", "horizontal_cyclic1")
CLOCKS_S = np.arange(-0.15, 0.2001, 0.005)


def on_real_recording(study: Study, model: Starfish, settings: FitSettings) -> dict[str, Any]:
    """Identify on the beginning of ``baseline``; predict other runs in water.

    Held out are the same sequence in another session, and another command. Each gets the clock
    that fits it best (one number, nuisance of the recording); theta stays as it is.

    Args:
        study: The starfish's study, as imported.
        model: Model with the priors of its parameters.
        settings: ``duration_s`` is the length of every window.

    Returns:
        For JSON: values, sd, names, correlation, undetermined, and per window the root mean square
        of a marker's coordinate [m], with the first guesses and with what was identified.
    """
    runs = {r.name: window(r, settings.duration_s) for r in study.runs}
    found = identify(model, [runs[FIT_RUN]], settings)
    guesses = {p.name: p.value for p in model.parameters}
    shared = {name: found.values[name] for name in guesses}
    rows = []
    for name in (FIT_RUN, *HELD_OUT):
        rows.append(
            {
                "run": name,
                "use": "fit" if name == FIT_RUN else "held out",
                "rms_still_m": _rms(float(np.nansum(_subtract_rest(runs[name]) ** 2)), runs[name]),
                "rms_before_m": best_clock(model, runs[name], guesses, settings.duration_s),
                "rms_after_m": best_clock(model, runs[name], shared, settings.duration_s),
            }
        )
    return {
        "runs": rows,
        "values": found.values,
        "sd": found.sd,
        "names": list(found.names),
        "correlation": found.correlation,
        "undetermined": list(found.undetermined),
        "at_bound": list(found.at_bound),
        "num_evaluations": found.num_evaluations,
    }


def window(run: Run, duration_s: float) -> Run:
    """A run from shortly before its command on, at 60 Hz, scaled by its marker spacing."""
    count = round(duration_s * RATE_HZ)
    times = np.arange(count) / RATE_HZ
    at = times - BEFORE_S
    scale = SPACING_M / run.setup["marker_spacing_m2_m3_m"]
    measured = [scale * np.interp(at, run.time_s, channel) for channel in run.measured.T]
    command = {COMMAND: np.interp(at, run.time_s, run.command[COMMAND])}
    return replace(run, time_s=times, measured=np.stack(measured, 1), command=command, columns={})


def best_clock(model: Starfish, run: Run, values: Mapping[str, float], duration_s: float) -> float:
    """Root mean square misfit of a marker's coordinate [m], at the clock offset that fits best.

    One simulation, looked at through every clock of ``CLOCKS_S``.
    """
    cut, _ = as_displacements(run, duration_s, 1.0)
    tensors = {name: torch.tensor(value, dtype=torch.float64) for name, value in values.items()}
    clocks = torch.from_numpy(CLOCKS_S)
    times = torch.from_numpy(cut.time_s - cut.time_s[0])
    contraction = torch.from_numpy(np.ascontiguousarray(cut.command[COMMAND]))
    scene = model.scene(tensors, contraction, times, clocks[0])
    with torch.no_grad():
        observed = scene.motion(scene.num_steps())  # the earliest clock looks furthest ahead
        losses = []
        for clock in clocks:
            seen = displacements(scene.changed(clock_offset=clock).channels(observed))
            left = seen[:, : len(CHANNELS)].numpy() - cut.measured
            losses.append(float(np.nansum(left**2)))
    return _rms(min(losses), run)


def _subtract_rest(run: Run) -> np.ndarray:
    return run.measured - np.nanmean(run.measured[:6], axis=0)


def _rms(loss: float, run: Run) -> float:
    return float(np.sqrt(loss / (len(run.time_s) * len(CHANNELS))))
