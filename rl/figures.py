"""The figure of a comparison (thesis Fig. 4-17)."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from diffsim.core.files import write_bytes_atomic
from diffsim.core.optional import optional
from diffsim.viz.figures import CYCLE, INK, LINE, SOFT
from rl.comparison import AXES, Runs
from rl.reward_statistics import Row, Scale, bootstrap_interval, held, interquartile_mean

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LOOK = {
    "gradient": ("Adam through the simulator", CYCLE[0]),
    "shac": ("short-horizon actor-critic", CYCLE[2]),
    "sapo": ("SAPO", CYCLE[6]),
    "mixed": ("mix with sampled gradients", CYCLE[5]),
    "ppo": ("PPO", CYCLE[1]),
    "sac": ("SAC", CYCLE[3]),
    "tqc": ("TQC", "#a3324f"),
    "cma": ("CMA-ES, open loop", CYCLE[4]),
}
NUM_PLACES = 200


def comparison_figure(path: Path, title: str, runs: Runs, scale: Scale) -> Path:
    """Normalized reward against steps, seconds and forward-equivalents; written as PNG.

    Lines are interquartile means over runs, bands 95 % bootstrap intervals. A line ends where the
    median of its runs does; runs that ended before hold their last reward.
    """
    figure_module = optional("matplotlib.figure", purpose="a figure")
    ticker = optional("matplotlib.ticker", purpose="a figure")
    figure = figure_module.Figure(figsize=(10.5, 3.6), layout="constrained", facecolor="white")
    panels = figure.subplots(1, len(AXES), sharey=True)
    for ax, (axis, label) in zip(panels, AXES.items(), strict=True):
        for method, by_seed in runs.items():
            _curve(ax, axis, method, list(by_seed.values()), scale)
        ax.set_xscale("log")
        ax.xaxis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.xaxis.set_major_formatter(ticker.FuncFormatter(_plain))
        ax.xaxis.set_minor_formatter(ticker.NullFormatter())
        ax.set_xlabel(label, color=SOFT, fontsize=9)
        ax.grid(True, color=LINE, linewidth=0.6)
        ax.tick_params(colors=SOFT, labelsize=8)
        ax.axhline(1.0, color=SOFT, linewidth=0.8, linestyle=":")
        ax.axhline(0.0, color=SOFT, linewidth=0.8, linestyle=":")
        for side in ("top", "right"):
            ax.spines[side].set_visible(False)
    panels[0].set_ylabel("normalized reward", color=SOFT, fontsize=9)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.suptitle(title, x=0.01, ha="left", fontsize=10, color=INK, fontweight="bold")
    columns = len(labels) if len(labels) < 5 else (len(labels) + 1) // 2
    figure.legend(
        handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=8.5
    )
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=160)
    return write_bytes_atomic(path, content.getvalue())


def _plain(value: float, _: object) -> str:
    return f"{value:,.4g}" if value < 1e4 else f"{value / 1e3:,.4g}k"


def _curve(ax: Axes, axis: str, method: str, runs: list[list[Row]], scale: Scale) -> None:
    name, color = LOOK[method]
    first = min(rows[1][axis] for rows in runs if len(rows) > 1)
    last = float(np.median([rows[-1][axis] for rows in runs]))
    at = np.geomspace(max(first, 1e-3), max(last, first), NUM_PLACES)
    values = scale(np.stack([held(rows, axis, at) for rows in runs]))
    low, high = bootstrap_interval(values, resamples=500)
    ax.fill_between(at, low, high, color=color, alpha=0.2, linewidth=0)
    ax.plot(at, interquartile_mean(values), color=color, label=f"{name} ({len(runs)} runs)")
