"""Figures of a sim-to-real loop, after thesis Figs. 5-6 to 5-9."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from diffsim.viz.figures import COLORS, CYCLE, INK, LINE, SOFT, new_figure
from labs.loop.command import RATE_HZ
from labs.loop.model import CHANNELS, PLACES_M

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from labs.loop.records import Iteration

Array = NDArray[np.float64]
_MARKER_Z = np.array(PLACES_M)


def markers(pairs: Sequence[tuple[str, Array, Array]]) -> Figure:
    """Fig. 5-6: measured and simulated markers in the camera's plane.

    Args:
        pairs: (title, measured, simulated) displacements (n, 8) from the start [m].
    """
    columns = 2
    rows = -(-len(pairs) // columns)
    figure, axes = new_figure(
        rows, columns, height=2.1 * rows + 0.4, squeeze=False, sharex=True, sharey=True
    )
    for ax, (title, measured, simulated) in zip(axes.flat, pairs, strict=False):
        for moved, role, label in (
            (measured, "fourth", "measured"),
            (simulated, "fitted", "simulated"),
        ):
            x, z = 1e3 * moved[:, ::2], 1e3 * (moved[:, 1::2] + _MARKER_Z)
            # across the page: along z; up the page: the way it swims
            ax.plot(z, -x, color=COLORS[role], lw=0.6, alpha=0.55)
            ax.scatter(z[-1], -x[-1], s=26, color=COLORS[role], label=label, zorder=3)
            ax.scatter(z[0], -x[0], s=26, facecolors="none", edgecolors=COLORS[role], zorder=3)
        left = np.sqrt(np.nanmean((measured - simulated) ** 2))
        ax.set_title(f"{title}: {1e3 * left:.1f} mm rms", loc="left", fontsize=9.5, color=INK)
    for ax in axes.flat[len(pairs) :]:
        ax.set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel("z [mm]", color=SOFT)
    for ax in axes[:, 0]:
        ax.set_ylabel("forwards [mm]", color=SOFT)
    axes[0, 0].legend(frameon=False, fontsize=8.5, labelcolor=INK, ncols=2, loc="lower center")
    return figure


def travel(iterations: Sequence[Iteration]) -> Figure:
    """Fig. 5-7: where the robot is over time, mean of its four markers, measured and simulated."""
    figure, axes = new_figure(1, 2, height=3.6, sharey=False, squeeze=False)
    titles = ("every iteration, predicted and measured", "the last iteration")
    for ax, chosen, title in zip(axes[0], (iterations, iterations[-1:]), titles, strict=True):
        for it in chosen:
            color = CYCLE[it.idx % len(CYCLE)]
            measured = -1e3 * np.nanmean(it.run.measured[:, ::2] - _start(it.run.measured), axis=1)
            simulated = -1e3 * (it.markers_m[:, ::2] - _start(it.markers_m)).mean(1)
            ax.plot(it.run.time_s, measured, color=color, lw=1.1, label=f"{it.idx} measured")
            times = np.arange(len(simulated)) / RATE_HZ
            ax.plot(times, simulated, color=color, lw=1.0, ls="--", label=f"{it.idx} simulated")
        ax.set_title(title, loc="left", fontsize=10, color=INK)
        ax.set_xlabel("time [s]", color=SOFT)
        ax.legend(frameon=False, fontsize=7.5, labelcolor=INK, ncols=2)
    axes[0, 0].set_ylabel("travel forwards [mm]", color=SOFT)
    return figure


def commands(iterations: Sequence[Iteration]) -> Figure:
    """Fig. 5-8: contraction over one period, one panel per iteration over the baseline."""
    figure, axes = new_figure(
        len(iterations), 1, height=1.15 * len(iterations) + 0.6, sharex=True, sharey=True,
        squeeze=False,
    )  # fmt: skip
    base = iterations[0].command.contraction_m
    times = np.arange(len(base)) / RATE_HZ
    for ax, it in zip(axes[:, 0], iterations, strict=True):
        if it.idx:
            ax.plot(times, 1e3 * base, color=LINE, lw=1.2)
        color = CYCLE[it.idx % len(CYCLE)]
        ax.plot(times, 1e3 * it.command.contraction_m, color=color, lw=1.3)
        ax.set_title(name_of(it), loc="left", fontsize=9, color=INK)
    axes[-1, 0].set_xlabel("time in the period [s]", color=SOFT)
    axes[len(iterations) // 2, 0].set_ylabel("contraction [mm]", color=SOFT)
    return figure


def strip(
    shots: Sequence[tuple[str, Sequence[tuple[float, Array, Array]]]],
    faces: Array,
) -> Figure:
    """Fig. 5-9: the simulated robot from the side, with the measured markers on it.

    Args:
        shots: One row each: title, and (time [s], vertices (num_nodes, 3) of the quarter,
            measured markers (4, 2) as x and z) [m].
        faces: (num_faces, 3) surface of the quarter.
    """
    from matplotlib.collections import PolyCollection

    columns = max(len(row) for _, row in shots)
    figure, axes = new_figure(
        len(shots), columns, height=2.0 * len(shots), sharex=True, sharey=True, squeeze=False
    )
    places = [-p[:, 0] for _, row in shots for _, x, seen in row for p in (x, seen)]
    low, high = 1e3 * np.nanmin(np.concatenate(places)), 1e3 * np.nanmax(np.concatenate(places))
    rest = shots[0][1][0][1][faces].mean(1)
    towards_us = (rest[:, 1] > rest[:, 2]) & (rest[:, 1] > 0.02)
    for line, (title, row) in zip(axes, shots, strict=True):
        for ax, (time, x, seen) in zip(line, row, strict=True):
            for color, chosen in (("#f8dcb9", towards_us), ("#f0a95c", ~towards_us)):
                for side in (-1.0, 1.0):
                    flat = 1e3 * np.stack([side * x[:, 2], -x[:, 0]], 1)[faces[chosen]]
                    ax.add_collection(PolyCollection(list(flat), facecolors=color, lw=0))
            ax.scatter(1e3 * seen[:, 1], -1e3 * seen[:, 0], s=12, color=INK, zorder=3)
            ax.set_title(f"{title}, {time:.2f} s", loc="left", fontsize=8, color=INK)
            ax.set(xlim=(-80.0, 80.0), ylim=(low - 6.0, high + 6.0), aspect="equal")
    for ax in axes[-1]:
        ax.set_xlabel("z [mm]", color=SOFT)
    for ax in axes[:, 0]:
        ax.set_ylabel("forwards [mm]", color=SOFT)
    return figure


def progress(iterations: Sequence[Iteration]) -> Figure:
    """Predicted and measured speed of every iteration [cm/s]."""
    figure, ax = new_figure(height=3.0)
    k = [i.idx for i in iterations]
    simulated = [1e2 * i.speed_simulated for i in iterations]
    ax.plot(k, simulated, "o--", color=COLORS["fitted"], label="predicted before the experiment")
    measured = [1e2 * i.speed_measured for i in iterations]
    ax.plot(k, measured, "o-", color=COLORS["published"], label="measured")
    ax.axhline(0.0, color=SOFT, lw=0.6)
    ax.set_xticks(k, [name_of(i) for i in iterations])
    ax.set_ylabel("forward speed [cm/s]", color=SOFT)
    ax.legend(frameon=False, fontsize=8.5, labelcolor=INK)
    return figure


def name_of(iteration: Iteration) -> str:
    """Label of an iteration, as in Table 5.2."""
    names = {0: "0 (bl-ctrl)", 1: "1 (bl-one-iter)"}
    return names.get(iteration.idx, str(iteration.idx))


def _start(measured: Array) -> Any:
    assert measured.shape[1] == len(CHANNELS)
    return np.nanmean(measured[:6, ::2], axis=0)
