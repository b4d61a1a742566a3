"""Records brought to an even clock: flights are simulated from sample to sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from diffsim.core.arrays import Array, Mask
from diffsim.data.steps import GAP
from diffsim.data.study import Run, Study

_UNEVEN = 1e-3  # of the mean step: below it a clock is even


def evenly_sampled(study: Study, rate_hz: float | None, means: Sequence[bool]) -> Study:
    """A study whose runs have evenly spaced samples.

    Between samples values follow straight lines; in gaps of the clock nothing was recorded.
    Commands are means over the step that follows a sample.

    Args:
        study: Recorded runs.
        rate_hz: Samples per second; None: as recorded, and runs that are even stay as they are.
        means: Which channels are means over the step before: accelerations are.
    """
    runs = tuple(_make_even(run, rate_hz, np.array(means)) for run in study.runs)
    if all(a is b for a, b in zip(runs, study.runs, strict=True)):
        return study
    return replace(study, runs=runs)


def _make_even(run: Run, rate_hz: float | None, means: Mask) -> Run:
    steps = np.diff(run.time_s)
    usual = float(np.median(steps))
    mean = float(steps.mean())
    is_even = bool(np.abs(steps - mean).max() <= _UNEVEN * mean)
    if is_even and (rate_hz is None or abs(rate_hz * mean - 1.0) < _UNEVEN):
        return run
    dt = usual if rate_hz is None else 1.0 / rate_hz
    count = int((run.time_s[-1] - run.time_s[0]) / dt + 1e-6) + 1
    time = run.time_s[0] + dt * np.arange(count)
    limit = GAP * max(dt, usual)
    columns = [
        _resample_channel(run.time_s, values, time, dt, limit, is_mean=bool(m))
        for values, m in zip(run.measured.T, means, strict=True)
    ]
    command = {
        name: _average_held(
            run.time_s, np.asarray(values, dtype=np.float64), time, time + dt, is_before=False
        )
        for name, values in run.command.items()
    }
    beside = {name: np.interp(time, run.time_s, values) for name, values in run.columns.items()}
    return replace(run, time_s=time, measured=np.stack(columns, 1), command=command, columns=beside)


def _resample_channel(
    old: Array, values: Array, time: Array, dt: float, limit: float, *, is_mean: bool
) -> Array:
    """One channel at new times; NaN where no reading is near."""
    good = np.isfinite(values)
    if not good.any():
        return np.full(len(time), np.nan)
    at, there = old[good], values[good]
    out = (
        _average_held(at, there, time - dt, time, is_before=True)
        if is_mean
        else np.interp(time, at, there)
    )
    after = np.searchsorted(at, time).clip(1, len(at) - 1)
    inside = at[after] - at[after - 1] > limit
    near = np.minimum(np.abs(time - at[after]), np.abs(time - at[after - 1])) < 0.5 * dt
    return np.where(inside & ~near, np.nan, out)


def _average_held(old: Array, values: Array, start: Array, end: Array, *, is_before: bool) -> Array:
    """Means over intervals of what is held between samples; ends held.

    Args:
        old: Times of the samples, (num_samples,) [s].
        values: Held until the next sample, or since the one before where ``is_before``.
        start, end: Ends of the intervals [s].
        is_before: Whether a value holds over the step before its sample.
    """
    held = values[1:] if is_before else values[:-1]
    total = np.concatenate([[0.0], np.cumsum(held * np.diff(old))])

    def integral(t: Array) -> Array:
        found: Array = np.interp(t, old, total)
        beyond = np.where(t < old[0], values[0], values[-1]) * (t - np.clip(t, old[0], old[-1]))
        return found + beyond

    means: Array = (integral(end) - integral(start)) / (end - start)
    return means
