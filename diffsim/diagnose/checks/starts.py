"""Runs that begin elsewhere, or in another motion, than their study says: only a model can tell.

The model simulates the first rows of each run at its priors. What all runs have alike, such as an
offset or a scale of a sensor, is no start; what differs from run to run is, if other start states
give it without what the record contradicts: a slip of a wheel is a slope that no start gives.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from diffsim.core.arrays import Array, Mask
from diffsim.core.figures import figure
from diffsim.core.units import to_si
from diffsim.data.shown import shown_step
from diffsim.data.signal import scatter
from diffsim.data.study import Channel, Run, Study
from diffsim.data.study_check import Problem
from diffsim.diagnose.checks.one_run import MOST_RUNS, NUDGE
from diffsim.identify.model import SimModel
from diffsim.identify.setup import DiagnosisSetup

RULE = "starts"
LEAST_ROWS, MOST_ROWS, ROW_SHARE = 6, 32, 0.01  # of a run, that show where and how fast it begins
COMMAND_CHANGES = 3.0  # likewise: times what the run's commands, moved by their sd, change
FAR_SHARES = np.array([[0.2], [0.5]])  # of the usual motion and of the usual speed
SURE_SDS = 6.0  # sd of noise and priors together
ROOM = 0.1  # of 273 K: temperatures that a rig begins with
ALIKE_SHARE = 0.5  # of the largest difference, that all runs have alike; of each, not by starts


@dataclass(frozen=True)
class _Begin:
    """How a run begins: level and slope of each channel, (2, num_channels) each."""

    run: Run
    seen: Array  # as it was measured
    told: Array  # as the model has it, at its priors
    sd: Array  # of their difference, by noise, priors and what may be wrong with commands


def start_problems(study: Study, setup: DiagnosisSetup) -> Iterator[Problem]:
    """Runs whose first rows contradict the start states of the study.

    Args:
        study: Study with the description; only ``ode`` is asked.
    """
    model = study.model or {}
    states = model.get("states")
    if model.get("system") != "ode" or not isinstance(states, dict):
        return
    runs = [r for r in study.fit_runs if len(r.time_s) > MOST_ROWS][:MOST_RUNS]
    begins = [b for run in runs if (b := _begin(setup.model, study, run)) is not None]
    yield from _in_celsius(study.channels, begins)
    if len(begins) < 2:
        return
    far = _far(begins, _usual([begin.run for begin in begins]))
    for begin, places in zip(begins, far, strict=True):
        if places.any():
            places &= _given_by_starts(setup.model, begin)
    if not far.any():
        return
    k, what, i = (int(place) for place in np.argwhere(far)[0])
    begin, channel = begins[k], study.channels[i]
    others = [
        b.run.name for b, rows in zip(begins[k + 1 :], far[k + 1 :], strict=True) if rows.any()
    ]
    likewise = f" (likewise {', '.join(others)})" if others else ""
    moves, each = ("begins at", "") if what == 0 else ("begins with a slope of", " per second")
    seen, told = (shown_step(channel, float(v[what, i])) + each for v in (begin.seen, begin.told))
    yield Problem(
        "error",
        f"run {begin.run.name}",
        f"it begins in motion{likewise}: channel {channel.name} {moves} {seen}, and the `states:` "
        f"of the study say {told}: {_remedy(states, model.get('readings') or {})}",
        RULE,
    )


def _in_celsius(channels: Sequence[Channel], begins: Sequence[_Begin]) -> Iterator[Problem]:
    """Temperatures in kelvin, as all readings are, of a study whose numbers are degrees Celsius."""
    zero = to_si("degC").offset
    for i, channel in enumerate(channels):
        off = np.array([b.seen[0, i] - b.told[0, i] for b in begins])
        unsure = SURE_SDS * np.array([b.sd[0, i] for b in begins])
        is_off = np.abs(off - zero) < np.maximum(unsure, ROOM * zero)
        if channel.unit == "K" and len(begins) and (is_off & (unsure < zero)).all():
            seen, told = (figure(float(of[0, i]), 4) for of in (begins[0].seen, begins[0].told))
            yield Problem(
                "error",
                f"run {begins[0].run.name}",
                f"channel {channel.name} begins at {seen} K, where the study says {told}: a number "
                "without a unit is in K; write `20 degC` in `states:`, and so each temperature "
                "among the numbers",
                RULE,
            )


def _begin(model: SimModel, study: Study, run: Run) -> _Begin | None:
    """How a run begins; None where nothing was measured there or simulated."""
    part, q = run.part(slice(_num_rows(run))), model.at_prior()
    asks = _level_and_slope(part.time_s)
    points = torch.cat([q[None], q + NUDGE * torch.eye(len(q), dtype=q.dtype)])
    pushed = {n: part.command[n] + np.nanstd(values) for n, values in run.command.items()}
    with torch.no_grad():
        told = asks @ model.predict_many(part, points).numpy()
        driven = asks @ model.predict(replace(part, command=pushed), q).numpy() - told[0]
    seen = asks @ part.measured
    if not (np.isfinite(told).all() and np.isfinite(seen).all()):
        return None
    by_number = (told[1:] - told[0]) / NUDGE
    noise = np.linalg.norm(asks, axis=1)[:, None] * scatter(np.diff(run.measured, 2, axis=0), 2)
    of_priors = (by_number**2).sum(0)
    doubt = np.sqrt(noise**2 + of_priors + (COMMAND_CHANGES / SURE_SDS * driven) ** 2)
    return _Begin(run, seen, told[0], doubt)


def _given_by_starts(model: SimModel, begin: _Begin) -> Mask:
    """Of which differences the starts that fit all of them best leave little, (2, num_channels)."""
    part = begin.run.part(slice(_num_rows(begin.run)))
    asks = _level_and_slope(part.time_s)
    scene: Any = model.scene(part, model.at_prior())
    with torch.no_grad():
        plain, *moved = (s.simulate().numpy() for s in (scene, *scene.each_start_moved(NUDGE)))
    ways_of_states = [asks @ (other - plain) / NUDGE for other in moved]
    by_start = np.array([way for way in ways_of_states if np.isfinite(way).all()])
    if not len(by_start):  # at no other start a formula has a value
        return np.zeros_like(begin.seen, dtype=bool)
    off = begin.seen - begin.told
    weight = 1.0 / np.maximum(begin.sd, np.finfo(float).tiny)
    ways = (by_start * weight).reshape(len(by_start), -1).T
    best = np.linalg.lstsq(ways, (off * weight).ravel(), rcond=None)[0]
    left = off - np.tensordot(best, by_start, axes=1)
    return np.asarray(np.abs(left) < ALIKE_SHARE * np.abs(off))


def _far(begins: Sequence[_Begin], usual: Array) -> Mask:
    """Where runs begin elsewhere, (num_runs, 2, num_channels)."""
    off = np.stack([b.seen - b.told for b in begins])
    sure = np.abs(off) > SURE_SDS * np.stack([b.sd for b in begins])
    told, own = np.stack([b.told for b in begins]), np.zeros_like(off)
    for place in np.ndindex(off.shape[1:]):
        of_all = (slice(None), *place)
        given, wanted = told[of_all], off[of_all]
        columns = [np.ones(len(begins))]
        if np.ptp(given) > ALIKE_SHARE * np.ptp(wanted):
            columns.append(given)  # as a scale of the sensor would have it
        if len(begins) > len(columns):
            alike = np.stack(columns, axis=1)
            own[of_all] = wanted - alike @ np.linalg.lstsq(alike, wanted, rcond=None)[0]
    differs = np.abs(own).max(0) > ALIKE_SHARE * np.abs(off).max(0)
    return np.asarray(sure & differs & (np.abs(off) > FAR_SHARES * usual))


def _level_and_slope(times: Array) -> Array:
    """What takes first level and slope in the beginning from samples, (2, num_rows)."""
    line = np.stack([np.ones(len(times)), times - times[0]], axis=1)
    return np.stack([np.eye(len(times))[0], np.linalg.pinv(line)[1]])


def _usual(runs: Sequence[Run]) -> Array:
    """Usual motion and usual speed of each channel, (2, num_channels)."""
    ways = []
    for run in runs:
        rows = _num_rows(run)
        moved = run.measured[rows:] - run.measured[:-rows]
        ways.append(moved / (run.time_s[rows:] - run.time_s[:-rows])[:, None])
    speeds = np.sqrt(np.nanmean(np.concatenate(ways) ** 2, axis=0))
    return np.stack([np.nanstd(np.concatenate([run.measured for run in runs]), axis=0), speeds])


def _num_rows(run: Run) -> int:
    """Rows that show how a run begins."""
    return int(np.clip(ROW_SHARE * len(run.time_s), LEAST_ROWS, MOST_ROWS))


def _remedy(states: Mapping[str, object], readings: Mapping[str, str]) -> str:
    """What to write for the states that are stated as numbers."""
    shown = {formula: f"first_{name}" for name, formula in readings.items()}
    stated = [name for name, start in states.items() if _is_number(start)] or list(states)
    fitted = "{value: 0, sd: .., per: run}"
    entries = ", ".join(f"{name}: {shown.get(name, fitted)}" for name in stated)
    return f"`states: {{{entries}}}` begins where each run does, or let it begin at rest"


def _is_number(start: object) -> bool:
    try:
        float(str(start).split()[0])
    except (ValueError, IndexError):
        return False
    return True
