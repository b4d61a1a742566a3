"""Figures of simulated flights: motor outputs (thesis Fig. 3-9)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from diffsim.copter.simulator import FlightLog
from diffsim.viz.figures import COLORS, CYCLE, INK, SOFT, new_figure, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def motor_outputs(flights: Sequence[tuple[str, FlightLog]], *, columns: int = 2) -> Figure:
    """Pulse widths of all motors over time, one panel per flight, with the clamp.

    Bars above the clamp show when a motor was asked for more than it may give.
    """
    columns = min(columns, len(flights))
    rows = -(-len(flights) // columns)
    figure, axes = new_figure(
        rows, columns, width=5.0 * columns, height=3.1 * rows, squeeze=False, sharey=True
    )
    for ax, (title, log) in zip(axes.flat, flights, strict=False):
        _motor_panel(ax, title, log)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]", color=SOFT)
    for ax in axes[:, 0]:
        ax.set_ylabel("pulse width [us]", color=SOFT)
    clamp = flights[0][1].metadata["pwm_max_us"]
    axes[0, 0].text(0.0, clamp + 8.0, "bars above: saturated", fontsize=8, color=SOFT)
    axes[0, 0].legend(frameon=False, fontsize=8, labelcolor=INK, ncols=3, loc="lower center")
    return figure


def _motor_panel(ax: Axes, title: str, log: FlightLog) -> None:
    time, pwm, saturated = (log.series(name) for name in ("time", "pwm", "saturated"))
    clamp = log.metadata["pwm_max_us"]
    for k, values in enumerate(pwm.T):
        color = CYCLE[k % len(CYCLE)]
        ax.plot(time, values, color=color, lw=0.9, label=f"motor {k + 1}")
        at = saturated[:, k]
        ax.plot(time[at], np.full(at.sum(), clamp + 10.0 + 9.0 * k), "|", color=color, ms=4)
    ax.axhline(clamp, color=COLORS["bad"], lw=0.8, ls="--")
    ax.set_ylim(1250.0, clamp + 70.0)
    ax.set_title(title, loc="left", fontsize=10, color=INK)


def save_png(figure: Figure, path: str | Path) -> Path:
    """Write a figure as PNG on white, atomically."""
    return save(figure, path, dpi=120)
