"""Series behind the figures of a diagnosis: predictions, residuals, phases, spectra."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import torch
from scipy.sparse.csgraph import connected_components

from diffsim.core.arrays import Array
from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose.judge.own_values import held_out_point
from diffsim.identify import Fit

CONFOUNDED = 0.95  # cosine beyond which two components are hardly told apart


@dataclass(frozen=True, kw_only=True, eq=False)
class PredictedRun(Run):
    """A recorded run with what the models predict for it."""

    null: Array  # prediction of the fitted model without effects, (num_samples, num_channels)
    # prediction with the named effects, same shape; None where nothing was named
    extended: Array | None = None
    # half of the width of the band around the last of these, same shape; None: no band
    band: Array | None = None
    # null_at, extended_at: coordinates of the fits in this run, its own nuisances fitted to it;
    # None: unknown
    null_at: Array | None = None
    extended_at: Array | None = None


def predicted_runs(
    study: Study,
    null: Fit,
    extended: Fit | None = None,
    uses: Sequence[str] = ("fit", "select", "test"),
    bands: Mapping[str, Array] = MappingProxyType({}),
) -> list[PredictedRun]:
    """Measured and predicted, runs for fitting first.

    Args:
        study: Recorded runs with their channels.
        null: Fit without effects.
        extended: Fit with effects; None where nothing was named.
        bands: Half of the width of the band by run.
    """
    return [
        _predicted_run(run, null, extended, bands.get(run.name))
        for use in uses
        for run in study.runs_for(use)
    ]


def _predicted_run(run: Run, null: Fit, extended: Fit | None, band: Array | None) -> PredictedRun:
    at = point_of(null, run)
    further = None if extended is None else point_of(extended, run)
    return PredictedRun(
        **vars(run),
        null=_at(null, run, at),
        extended=None if extended is None or further is None else _at(extended, run, further),
        band=band,
        null_at=at,
        extended_at=further,
    )


def point_of(fit: Fit, run: Run) -> Array:
    """Coordinates of a fit in a run, (num_coordinates,).

    Nuisances of a run that was not fitted are fitted to it, as the gain does.
    """
    return fit.x if run.use == "fit" else held_out_point(fit, run)[0]


def predicted(fit: Fit, run: Run) -> Array:
    """Prediction of a fit at ``point_of``, (num_samples, num_channels) [unit of the channel]."""
    return _at(fit, run, point_of(fit, run))


def _at(fit: Fit, run: Run, x: Array) -> Array:
    with torch.no_grad():
        return fit.problem.predict(run, torch.as_tensor(x)).numpy()


def with_noise(channels: Sequence[Channel], sd: Mapping[str, float]) -> list[Channel]:
    """Channels with the noise that was estimated.

    Args:
        sd: Standard deviation by name of the channel [unit of the channel].
    """
    return [replace(c, sd=float(sd[c.name])) for c in channels]


def blocks_of(confounding: Array, limit: float = CONFOUNDED) -> list[list[int]]:
    """Sets of two or more components that the data hardly part: linked by cosines above the limit.

    Args:
        confounding: Cosines between the responses of components, (n, n).
        limit: Limit on the absolute value of a cosine beyond which two components are linked.
    """
    count, label = connected_components(np.abs(np.nan_to_num(confounding)) > limit, directed=False)
    groups = [np.flatnonzero(label == k).tolist() for k in range(count)]
    return sorted((g for g in groups if len(g) > 1), key=len, reverse=True)


def command_phase(time_s: Array, command: Array) -> Array | None:
    """Phase angle [rad] of (value, -rate / mean frequency), each over its rms; None for steps.

    Args:
        time_s: Times of the samples, (n,) [s].
        command: Commanded value at each sample, (n,) in any unit.
    """
    if len(np.unique(command)) <= max(2, len(command) // 4):
        return None
    value = command - 0.5 * (command.max() + command.min())
    rate = np.gradient(command, time_s)
    return np.arctan2(-rate / np.sqrt((rate**2).mean()), value / np.sqrt((value**2).mean()))


def mean_periodogram(runs: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Frequencies [Hz] of the longest run and the mean power there; unit white noise has 1.

    Args:
        runs: Times (n,) [s] and residuals (n, channels); missing ones count as zero.
    """
    longest = max(runs, key=lambda run: len(run[0]))[0]
    step = float(np.median(np.diff(longest)))
    frequency: Array = np.fft.rfftfreq(len(longest), step).astype(np.float64)
    curves = []
    for time, left in runs:
        own = np.fft.rfftfreq(len(time), float(np.median(np.diff(time))))
        power = (np.abs(np.fft.rfft(np.nan_to_num(left), axis=0)) ** 2 / len(time)).mean(1)
        curves.append(np.interp(frequency, own, power, right=np.nan))
    return frequency, np.nanmean(np.stack(curves), 0)


def binned_rms(x: Array, left: Array, bins: int = 10) -> tuple[Array, Array]:
    """Middle of equally filled bins of x (n,), and rms of left (n, channels) in them."""
    parts = [p for p in np.array_split(np.argsort(x), bins) if len(p)]
    middle = np.array([x[p].mean() for p in parts])
    return middle, np.array([np.sqrt(np.nanmean(left[p] ** 2)) for p in parts])


def rms_of(left: Array) -> Array:
    """Root mean square of each column; zero where nothing was measured."""
    count = np.maximum(np.isfinite(left).sum(0), 1)
    return np.sqrt(np.nansum(left**2, 0) / count)
