"""Figures of a diagnosis: before and after, residuals over their noise, confounding, next runs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import special

from diffsim.data.study import Channel
from diffsim.viz.diagnosis_series import (
    PredictedRun,
    blocks_of,
    command_phase,
    mean_periodogram,
    rms_of,
    worst_channels,
)
from diffsim.viz.figures import COLORS, INK, LINE, SOFT, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
_KNOT = re.compile(r"(?P<shape>.*?)(?P<knot>\d+)")
NULL, EXTENDED = COLORS["published"], COLORS["fitted"]


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


def _over_frequency(ax: Axes, kinds: Sequence[_Residuals]) -> None:
    """Mean periodogram over runs and channels; 1 is white noise, grey its 95 %."""
    count = 2 * sum(left.shape[1] for _, left in kinds[0].runs)
    low, high = special.chdtri(count, [0.975, 0.025]) / count
    ax.axhspan(low, high, color=LINE, lw=0, alpha=0.7)
    for kind in kinds:
        frequency, power = mean_periodogram([(r.time_s, left) for r, left in kind.runs])
        ax.plot(frequency, power, lw=1.2, color=kind.color)
    ax.axhline(1.0, color=SOFT, lw=0.8, ls=":")
    ax.set_yscale("log")
    ax.set_title("spectrum (1: white noise)", loc="left", fontsize=10, color=INK)
    ax.set_xlabel("frequency [Hz]", color=SOFT)
    ax.set_ylabel("power [noise variances]", color=SOFT)


def _over_channels(ax: Axes, kinds: Sequence[_Residuals], channels: Sequence[Channel]) -> None:
    at = np.arange(len(channels))
    width = 0.8 / len(kinds)
    for k, kind in enumerate(kinds):
        x = at + (k - (len(kinds) - 1) / 2) * width
        ax.bar(x, rms_of(kind.stacked), 0.92 * width, color=kind.color)
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
