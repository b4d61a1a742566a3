"""Figures of a diagnosis: before and after, residuals over their noise, confounding, next runs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats
from scipy.sparse.csgraph import connected_components

from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose.gain import held_out_point
from diffsim.identify import Fit
from diffsim.viz.figures import COLORS, INK, LINE, SOFT, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
_KNOT = re.compile(r"(?P<shape>.*?)(?P<knot>\d+)")
CONFOUNDED = 0.95
NULL, EXTENDED = COLORS["published"], COLORS["fitted"]


@dataclass(frozen=True, kw_only=True, eq=False)
class PredictedRun(Run):
    """A recorded run with what the models predict for it.

    Attributes:
        null: Prediction of the fitted model without effects, (num_samples, num_channels).
        extended: Prediction with the named effects, same shape; None where nothing was named.
    """

    null: Array
    extended: Array | None = None


def predicted_runs(study: Study, null: Fit, extended: Fit | None = None) -> list[PredictedRun]:
    """Measured and predicted, runs for fitting first.

    Args:
        study: Recorded runs with their channels.
        null: Fit without effects.
        extended: Fit with effects; None where nothing was named.
    """
    return [
        PredictedRun(
            **vars(run),
            null=predicted(null, run),
            extended=None if extended is None else predicted(extended, run),
        )
        for run in (*study.fit_runs, *study.test_runs)
    ]


def predicted(fit: Fit, run: Run) -> Array:
    """Prediction of a fit at its parameters, (num_samples, num_channels) [unit of the channel].

    Nuisances of a held-out run are fitted to it, as the gain does.
    """
    x = held_out_point(fit, run) if run.use == "test" else fit.x
    with torch.no_grad():
        return fit.problem.predict(run, torch.as_tensor(x)).numpy()


def with_noise(channels: Sequence[Channel], sd: Mapping[str, float]) -> list[Channel]:
    """Channels with the noise that was estimated.

    Args:
        channels: Channels of a study.
        sd: Standard deviation by name of the channel [unit of the channel].
    """
    return [replace(c, sd=float(sd[c.name])) for c in channels]


@dataclass(frozen=True, eq=False)
class _Residuals:
    """Residuals of several runs in noise standard deviations, and how to draw them."""

    label: str
    color: str
    runs: Sequence[tuple[PredictedRun, Array]] = field(default_factory=tuple)

    @property
    def stacked(self) -> Array:
        return np.concatenate([left for _, left in self.runs])


def before_after(
    runs: Sequence[PredictedRun], channels: Sequence[Channel], most: int = 3
) -> Figure:
    """Measured and predicted channels over time, a row per run, worst channels first.

    Args:
        runs: Runs with their predictions, one or more.
        channels: All channels of the study.
        most: Largest number of channels to draw.
    """
    worst = worst_channels(runs, channels)[:most]
    figure, axes = new_figure(
        len(runs), len(worst), height=2.1 * len(runs) + 0.6, sharex="row", squeeze=False
    )
    for row, run in zip(axes, runs, strict=True):
        for ax, i in zip(row, worst, strict=True):
            ax.plot(run.time_s, run.measured[:, i], ".", ms=3.5, color=INK, label="measured")
            ax.plot(run.time_s, run.null[:, i], "--", lw=1.2, color=NULL, label="model before")
            if run.extended is not None:
                ax.plot(run.time_s, run.extended[:, i], lw=1.3, color=EXTENDED, label="extended")
            ax.set_title(f"{run.name}: {channels[i].name}", loc="left", fontsize=9.5, color=INK)
            ax.set_ylabel(f"[{channels[i].unit}]", color=SOFT)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]", color=SOFT)
    _shared_legend(figure, axes[0, 0])
    return figure


def residual_views(
    runs: Sequence[PredictedRun], channels: Sequence[Channel], command: str | None = None
) -> Figure:
    """Residuals in noise standard deviations over time, command, frequency and channel; the grey
    band is what noise alone does (95 %).

    Args:
        runs: Runs with their predictions, one or more.
        channels: All channels of the study.
        command: Command whose value and rate give the phase; None: the first one that changes.
    """
    varying = (n for n in runs[0].command if any(np.ptp(r.command[n]) > 0.0 for r in runs))
    command = command or next(varying, None)
    kinds = [_residuals("model before", NULL, runs, channels, extended=False)]
    if all(run.extended is not None for run in runs):
        kinds.append(_residuals("extended", EXTENDED, runs, channels, extended=True))
    figure, axes = new_figure(2, 2, height=6.2)
    _over_time(axes[0, 0], kinds)
    _over_phase(axes[0, 1], kinds, command)
    _over_frequency(axes[1, 0], kinds)
    _over_channels(axes[1, 1], kinds, channels)
    _shared_legend(figure, axes[0, 0])
    return figure


def over_position(
    runs: Sequence[PredictedRun], channels: Sequence[Channel], most: int = 3
) -> Figure | None:
    """Residuals of all channels over where the system is: a panel per position channel, those of
    the largest range first.

    Dots: residuals over the position that the model before predicts. Lines: their rms in ten bins;
    noise alone has 1.

    Args:
        runs: Runs with their predictions, one or more.
        channels: All channels of the study; positions are those of kind "position".
        most: Largest number of panels.

    Returns:
        None where no position was measured.
    """
    places = [i for i, c in enumerate(channels) if c.kind == "position"]
    if not places:
        return None
    spans = {i: float(np.ptp(np.concatenate([run.null[:, i] for run in runs]))) for i in places}
    places = sorted(places, key=lambda i: -spans[i])[:most]
    kinds = [_residuals("model before", NULL, runs, channels, extended=False)]
    if all(run.extended is not None for run in runs):
        kinds.append(_residuals("extended", EXTENDED, runs, channels, extended=True))
    figure, axes = new_figure(1, len(places), height=3.2, squeeze=False)
    for ax, i in zip(axes[0], places, strict=True):
        _noise_band(ax)
        for kind in kinds:
            x = np.concatenate([run.null[:, i] for run, _ in kind.runs])
            left = kind.stacked
            wide = np.repeat(x[:, None], left.shape[1], 1)
            ax.plot(wide.ravel(), left.ravel(), ".", ms=2, alpha=0.25, color=kind.color)
            middle, rms = _binned_rms(x, left)
            ax.plot(middle, rms, "o-", ms=3.5, lw=1.4, color=kind.color, label=kind.label)
        ax.set_xlabel(f"{channels[i].name} as predicted", color=SOFT)
    _shared_legend(figure, axes[0, 0])
    return figure


def _binned_rms(x: Array, left: Array, bins: int = 10) -> tuple[Array, Array]:
    """Middle of equally filled bins of x (n,), and rms of left (n, channels) in them."""
    parts = [p for p in np.array_split(np.argsort(x), bins) if len(p)]
    middle = np.array([x[p].mean() for p in parts])
    return middle, np.array([np.sqrt(np.nanmean(left[p] ** 2)) for p in parts])


def worst_channels(runs: Sequence[PredictedRun], channels: Sequence[Channel]) -> list[int]:
    """Channels by the misfit of the model before, in noise standard deviations, worst first."""
    left = _residuals("", "", runs, channels, extended=False).stacked
    return [int(i) for i in np.argsort(-_rms(left))]


def blocks_of(confounding: Array, limit: float = CONFOUNDED) -> list[list[int]]:
    """Sets of two or more components that the data hardly part: linked by cosines above the limit.

    Args:
        confounding: Cosines between the responses of components, (n, n).
        limit: Limit on the absolute value of a cosine beyond which two components are linked.
    """
    count, label = connected_components(np.abs(np.nan_to_num(confounding)) > limit, directed=False)
    groups = [np.flatnonzero(label == k).tolist() for k in range(count)]
    return sorted((g for g in groups if len(g) > 1), key=len, reverse=True)


def confounding_matrix(
    names: Sequence[str],
    confounding: Array,
    bar: str = "cosine of what the base parameters cannot absorb",
) -> Figure:
    """Cosines between the responses of candidates; sets that the data hardly part stand together,
    boxed.

    Args:
        names: Names of the components, (n,).
        confounding: Cosines between the responses of components, (n, n), in the order of ``names``.
        bar: What the colors mean.
    """
    blocks = blocks_of(confounding)
    grouped = [i for block in blocks for i in block]
    order = grouped + [i for i in range(len(names)) if i not in set(grouped)]
    side = min(9.6, 3.0 + 0.3 * len(names))
    figure, ax = new_figure(width=side + 0.8, height=side)
    drawn = ax.imshow(confounding[np.ix_(order, order)], cmap="RdBu_r", vmin=-1.0, vmax=1.0)
    labels = [names[i] for i in order]
    ax.set_xticks(range(len(names)), labels, rotation=90, fontsize=8)
    ax.set_yticks(range(len(names)), labels, fontsize=8)
    ax.grid(False)
    start = 0
    for block in blocks:
        x = np.array([start, start + len(block)]) - 0.5
        ax.plot(x[[0, 1, 1, 0, 0]], x[[0, 0, 1, 1, 0]], color=INK, lw=2.0, clip_on=False)
        start += len(block)
    figure.colorbar(drawn, ax=ax, shrink=0.7).set_label(bar, color=SOFT)
    return figure


def force_map(components: Sequence[str], groups: Sequence[str], z: Array) -> Figure:
    """Scores of a generic force: a panel per command, a row per shape, knots from left to right.

    Args:
        components: Names of the force's components; a number at the end is the knot in time.
        groups: Names of the commands, one panel each.
        z: (num_groups, num_components) scores in noise standard deviations.
    """
    parts = [_KNOT.fullmatch(name) for name in components]
    shapes = [m["shape"].strip("_") if m else n for m, n in zip(parts, components, strict=True)]
    knots = [int(m["knot"]) if m else 0 for m in parts]
    rows = list(dict.fromkeys(shapes))
    high = max(float(np.abs(z).max(initial=0.0)), 5.0)  # noise alone stays pale
    figure, axes = new_figure(
        len(groups), 1, height=0.7 + len(groups) * (0.7 + 0.24 * len(rows)), squeeze=False
    )
    for ax, group, scores in zip(axes[:, 0], groups, z, strict=True):
        table = np.full((len(rows), max(knots) + 1), np.nan)
        for shape, knot, score in zip(shapes, knots, scores, strict=True):
            table[rows.index(shape), knot] = score
        drawn = ax.imshow(table, cmap="RdBu_r", vmin=-high, vmax=high, aspect="auto")
        ax.set_yticks(range(len(rows)), rows, fontsize=8)
        ax.xaxis.get_major_locator().set_params(integer=True)
        ax.set_title(group, loc="left", fontsize=9.5, color=INK)
        ax.grid(False)
    axes[-1, 0].set_xlabel("knot in time", color=SOFT)
    figure.colorbar(drawn, ax=axes[:, 0].tolist(), shrink=0.8).set_label(
        "score [noise sd]", color=SOFT
    )
    return figure


def next_run_bars(chi2_gain: Mapping[str, float], best: str) -> Figure:
    """Expected chi2 that each run would add to the distance of the rivals, as bars.

    Args:
        chi2_gain: Expected chi2 between the nearest rivals by name of the run.
        best: Name of the run that is advised.
    """
    names = sorted(chi2_gain, key=lambda name: chi2_gain[name])
    figure, ax = new_figure(height=0.6 + 0.3 * len(names))
    colors = [EXTENDED if name == best else COLORS["measured_2"] for name in names]
    drawn = ax.barh(names, [chi2_gain[name] for name in names], 0.7, color=colors)
    ax.bar_label(drawn, [f"{chi2_gain[n]:.3g}" for n in names], padding=4, fontsize=8, color=SOFT)
    ax.set_xlabel("expected chi2 between the nearest rivals [-]", color=SOFT)
    ax.margins(x=0.1)
    ax.grid(False, axis="y")
    return figure


def _residuals(
    label: str,
    color: str,
    runs: Sequence[PredictedRun],
    channels: Sequence[Channel],
    *,
    extended: bool,
) -> _Residuals:
    sd = np.array([c.sd for c in channels])
    pairs = []
    for run in runs:
        shown = run.extended if extended else run.null
        assert shown is not None  # the caller looked
        pairs.append((run, (run.measured - shown) / sd))
    return _Residuals(label, color, pairs)


def _rms(left: Array) -> Array:
    """Root mean square of each column; zero where nothing was measured."""
    count = np.maximum(np.isfinite(left).sum(0), 1)
    return np.sqrt(np.nansum(left**2, 0) / count)


def _noise_band(ax: Axes) -> None:
    ax.axhspan(-1.96, 1.96, color=LINE, lw=0, alpha=0.7)
    ax.axhline(0.0, color=SOFT, lw=0.6)
    ax.set_ylabel("residual [noise sd]", color=SOFT)


def _over_time(ax: Axes, kinds: Sequence[_Residuals]) -> None:
    _noise_band(ax)
    for kind in kinds:
        for k, (run, left) in enumerate(kind.runs):
            label = kind.label if k == 0 else "_"
            time = np.repeat(run.time_s[:, None], left.shape[1], 1)
            ax.plot(time.ravel(), left.ravel(), ".", ms=3, alpha=0.5, color=kind.color, label=label)
    ax.set_title("over time", loc="left", fontsize=10, color=INK)
    ax.set_xlabel("time [s]", color=SOFT)


def _over_phase(ax: Axes, kinds: Sequence[_Residuals], command: str | None) -> None:
    """Against the phase of the command: the angle of (value, rate) about its middle; against its
    value where it only takes steps."""
    _noise_band(ax)
    ax.set_title(f"over the command {command or ''}", loc="left", fontsize=10, color=INK)
    if command is None:
        ax.set_xlabel("no command changes in these runs", color=SOFT)
        return
    ax.set_xlabel(f"{command}", color=SOFT)
    phases = [command_phase(run.time_s, run.command[command]) for run, _ in kinds[0].runs]
    turning = all(phase is not None for phase in phases)
    if turning:
        ax.set_xlabel("phase of the command [rad]", color=SOFT)
    for kind in kinds:
        for (run, left), phase in zip(kind.runs, phases, strict=True):
            x = phase if turning and phase is not None else run.command[command]
            x = np.repeat(x[:, None], left.shape[1], 1)
            ax.plot(x.ravel(), left.ravel(), ".", ms=3, alpha=0.5, color=kind.color)


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


def _over_frequency(ax: Axes, kinds: Sequence[_Residuals]) -> None:
    """Mean periodogram over runs and channels; 1 is white noise, grey its 95 %."""
    count = 2 * sum(left.shape[1] for _, left in kinds[0].runs)
    low, high = stats.chi2.ppf([0.025, 0.975], count) / count
    ax.axhspan(low, high, color=LINE, lw=0, alpha=0.7)
    for kind in kinds:
        frequency, power = mean_periodogram([(r.time_s, left) for r, left in kind.runs])
        ax.plot(frequency, power, lw=1.2, color=kind.color)
    ax.axhline(1.0, color=SOFT, lw=0.8, ls=":")
    ax.set_yscale("log")
    ax.set_title("spectrum (1: white noise)", loc="left", fontsize=10, color=INK)
    ax.set_xlabel("frequency [Hz]", color=SOFT)
    ax.set_ylabel("power [noise variances]", color=SOFT)


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


def _over_channels(ax: Axes, kinds: Sequence[_Residuals], channels: Sequence[Channel]) -> None:
    at = np.arange(len(channels))
    width = 0.8 / len(kinds)
    for k, kind in enumerate(kinds):
        x = at + (k - (len(kinds) - 1) / 2) * width
        ax.bar(x, _rms(kind.stacked), 0.92 * width, color=kind.color)
    ax.axhline(1.0, color=SOFT, lw=0.8, ls=":")
    ax.set_xticks(at, [c.name for c in channels], rotation=60, ha="right", fontsize=7.5)
    ax.set_title("over the channels (1: noise)", loc="left", fontsize=10, color=INK)
    ax.set_ylabel("rms residual [noise sd]", color=SOFT)
    ax.grid(False, axis="x")


def _shared_legend(figure: Figure, ax: Axes) -> None:
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper right", ncols=len(labels), frameon=False, fontsize=8.5
    )
