"""Balls as filmed and as simulated: overlays as in thesis Fig. 4-18, and a strip of frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray

Array = NDArray[np.float64]
COLOURS = ("#1f6f9f", "#c8502b")  # ball 0, ball 1
SEEN = "#e8b800"


@dataclass(frozen=True, eq=False)
class Shown:
    """One row of pictures.

    Attributes:
        title: What it is.
        outlines: (num_frames, num_balls, n, 2) of the balls [px]; None: only what was seen.
        centres: (num_frames, num_balls, 2) [px].
    """

    title: str
    outlines: Array | None
    centres: Array


def overlay(
    rows: Sequence[Shown],
    seen: Array,
    corners: Array,
    size_px: tuple[float, float],
    *,
    held_out_from: int,
    every: int = 4,
) -> Figure:
    """Motion sequences side by side; yellow squares are the centres in the video.

    Args:
        rows: From left to right.
        seen: (num_frames, num_balls, 2) tracked [px]; NaN where not seen.
        corners: (n, 2) clicked [px].
        size_px: Width and height of the picture.
        held_out_from: Frame from which squares are hollow: not fitted.
        every: Which frames show a whole ball.
    """
    figure = Figure(figsize=(4.6 * len(rows), 3.2), layout="constrained")
    for ax, row in zip(np.atleast_1d(figure.subplots(1, len(rows))), rows, strict=True):
        _frame(ax, size_px, _around(seen))
        ax.plot(*corners.T, "+", color="0.6", ms=5)
        for k in range(seen.shape[1]):
            if row.outlines is not None:
                for i in range(0, len(row.outlines), every):
                    _ball(ax, row.outlines[i, k], k, 0.15 + 0.5 * i / len(row.outlines))
            ax.plot(*row.centres[:, k].T, "-", color=COLOURS[k], lw=1.2)
            for part, fill in ((slice(0, held_out_from), SEEN), (slice(held_out_from, None), "w")):
                ax.plot(*seen[part, k].T, "s", ms=3.2, mfc=fill, mec="0.25", mew=0.5)
        ax.set_title(row.title, fontsize=9)
    return figure


def strip(
    rows: Sequence[Shown],
    seen: Array,
    size_px: tuple[float, float],
    frames: Sequence[int],
    first: int,
) -> Figure:
    """Some frames, one row per motion; yellow squares are the centres in the video.

    Args:
        rows: From top to bottom.
        seen: (num_frames, num_balls, 2) tracked [px].
        size_px: Width and height of the picture.
        frames: Which samples.
        first: Number of the first sample's video frame.
    """
    figure = Figure(figsize=(1.9 * len(frames), 1.5 * len(rows) + 0.3), layout="constrained")
    axes = figure.subplots(len(rows), len(frames), squeeze=False)
    for row, line in zip(rows, axes, strict=True):
        for i, ax in zip(frames, line, strict=True):
            _frame(ax, size_px, _around(seen))
            for k in range(seen.shape[1]):
                if row.outlines is not None:
                    _ball(ax, row.outlines[i, k], k, 0.6)
                ax.plot(*seen[i, k], "s", ms=3.5, mfc=SEEN, mec="0.25", mew=0.5)
            if row is rows[0]:
                ax.set_title(f"frame {first + i}", fontsize=8)
        line[0].set_ylabel(row.title, fontsize=8)
    return figure


def misfits(rows: Sequence[tuple[str, Array]], first: int, held_out_from: int) -> Figure:
    """Distance of projected from tracked centres over the frames.

    Args:
        rows: Name and distances (num_frames, num_balls) [px].
        first: Number of the first video frame.
        held_out_from: Sample from which nothing was fitted.
    """
    figure = Figure(figsize=(8, 3), layout="constrained")
    ax = figure.subplots()
    styles = (":", "--", "-", "-.")
    for (name, distance), style in zip(rows, styles, strict=False):
        for k in range(distance.shape[1]):
            frames = first + np.arange(len(distance))
            ax.plot(frames, distance[:, k], style, color=COLOURS[k], label=f"{name}, ball {k}")
    ax.axvspan(first + held_out_from - 0.5, frames[-1] + 0.5, color="0.92", label="held out")
    ax.set(xlabel="video frame", ylabel="error [px]", yscale="log")
    ax.legend(fontsize=7, ncols=2)
    ax.grid(color="0.93")
    return figure


def _around(seen: Array) -> tuple[Array, Array]:
    """The part of the picture where balls were seen, with room for them."""
    flat = seen.reshape(-1, 2)
    low, high = np.nanmin(flat, axis=0), np.nanmax(flat, axis=0)
    room = 0.18 * (high - low).max()
    return low - room, high + room


def _frame(ax, size_px: tuple[float, float], window: tuple[Array, Array]) -> None:
    (left, top), (right, bottom) = window
    ax.set(xlim=(max(left, 0.0), min(right, size_px[0])))
    ax.set(ylim=(min(bottom, size_px[1]), max(top, 0.0)))  # v runs down
    ax.set(aspect="equal", xticks=[], yticks=[], facecolor="#f4f4f2")


def _ball(ax, edge: Array, k: int, alpha: float) -> None:
    ax.add_patch(Polygon(edge, facecolor=COLOURS[k], edgecolor="none", alpha=alpha * 0.5))
