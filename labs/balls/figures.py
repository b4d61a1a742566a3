"""Balls as filmed and as simulated: overlays as in thesis Fig. 4-18, and a strip of frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim.viz import scene
from labs.balls.film import outline, view_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from labs.balls.soft import SoftBallModel

Array = NDArray[np.float64]
COLORS = ("#1f6f9f", "#c8502b")  # ball 0, ball 1
SEEN = "#e8b800"


@dataclass(frozen=True, eq=False)
class ShownBall:
    """One row of pictures: a title, outlines and centers of the balls."""

    title: str  # title above the row
    # (num_frames, num_balls, n, 2) of the balls [px]; None: only what was seen
    outlines: Array | None
    centers: Array  # centers of the balls in the picture, (num_frames, num_balls, 2) [px]


def simulated(name: str, model: SoftBallModel, x: Array, seen: Array) -> ShownBall:
    """What a model shows at coordinates x, titled with its misfit to ``seen`` (as below)."""
    view = view_of(model, x)
    with torch.no_grad():
        motion = model.balls.centers(model.values_at(x), len(seen)).numpy()
    edges = [[outline(view, c, model.balls.radius) for c in pair] for pair in motion]
    centers = view.project(motion)
    off = float(np.sqrt(np.nanmean(((centers - seen) ** 2).sum(-1))))
    return ShownBall(f"{name}: {off:.1f} px", np.array(edges), centers)


def recording(
    model: SoftBallModel, points: Mapping[str, Array], num_frames: int, path: Path
) -> Path:
    """A rerun recording of the deforming balls at some coordinates, by name."""
    balls, surfaces = model.balls, []
    faces = balls.ball.elements[:, [0, 2, 1]].numpy()  # a tetrahedron's last corner is the center
    for name, x in points.items():
        with torch.no_grad():
            nodes = balls.rollout(model.values_at(x), num_frames)[:, balls.nodes].numpy()
        surfaces += [
            scene.MovingSurface(
                path=f"{name}/ball{k}",
                time_s=np.arange(num_frames) * np.float64(balls.frame_s),
                nodes_m=nodes[:, k].astype(np.float32),
                triangles=faces,
                color=COLORS[k],
            )
            for k in (0, 1)
        ]
    note = "Two soft balls: " + ", ".join(points)
    return scene.write(scene.Scene(title="tennis balls", note=note, surfaces=surfaces), path)


def overlay(
    rows: Sequence[ShownBall],
    seen: Array,
    size_px: tuple[float, float],
    held_out_from: int,
    *,
    every: int = 4,
) -> Figure:
    """Motion sequences side by side; yellow squares are the centers in the video.

    Args:
        rows: Sequences from left to right.
        seen: (num_frames, num_balls, 2) tracked [px]; NaN where not seen.
        size_px: Width and height of the picture.
        held_out_from: Frame from which squares are hollow: not fitted.
        every: Step between the frames that show a whole ball.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6 * len(rows), 3.2), layout="constrained")
    for ax, row in zip(np.atleast_1d(figure.subplots(1, len(rows))), rows, strict=True):
        _frame(ax, size_px, _around(seen))
        for k in range(seen.shape[1]):
            if row.outlines is not None:
                for i in range(0, len(row.outlines), every):
                    _ball(ax, row.outlines[i, k], k, 0.15 + 0.5 * i / len(row.outlines))
            ax.plot(*row.centers[:, k].T, "-", color=COLORS[k], lw=1.2)
            for part, fill in ((slice(0, held_out_from), SEEN), (slice(held_out_from, None), "w")):
                ax.plot(*seen[part, k].T, "s", ms=3.2, mfc=fill, mec="0.25", mew=0.5)
        ax.set_title(row.title, fontsize=9)
    return figure


def strip(
    rows: Sequence[ShownBall],
    seen: Array,
    size_px: tuple[float, float],
    frames: Sequence[int],
    first: int,
) -> Figure:
    """Some frames, one row per motion; yellow squares are the centers in the video.

    Args:
        rows: Sequences from top to bottom.
        seen: (num_frames, num_balls, 2) tracked [px].
        size_px: Width and height of the picture.
        frames: Indices of the samples that are shown.
        first: Number of the first sample's video frame.
    """
    from matplotlib.figure import Figure

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


def misfits(rows: Sequence[ShownBall], seen: Array, first: int, held_out_from: int) -> Figure:
    """Distance of simulated from tracked centers over the frames; arguments as above."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3), layout="constrained")
    ax = figure.subplots()
    frames = first + np.arange(len(seen))
    for row, style in zip(rows, (":", "-", "--", "-."), strict=False):
        distance = np.linalg.norm(row.centers - seen, axis=-1)
        for k in range(seen.shape[1]):
            ax.plot(frames, distance[:, k], style, color=COLORS[k], label=f"{row.title}, ball {k}")
    if first + held_out_from <= frames[-1]:
        ax.axvspan(first + held_out_from - 0.5, frames[-1] + 0.5, color="0.92", label="held out")
    ax.set(xlabel="video frame", ylabel="error [px]", ylim=(0, None))
    ax.legend(fontsize=7, ncols=2)
    ax.grid(color="0.93")
    return figure


def _around(seen: Array) -> tuple[Array, Array]:
    """The part of the picture where balls were seen, with room for them."""
    flat = seen.reshape(-1, 2)
    low, high = np.nanmin(flat, axis=0), np.nanmax(flat, axis=0)
    room = 0.18 * (high - low).max()
    return low - room, high + room


def _frame(ax: Axes, size_px: tuple[float, float], window: tuple[Array, Array]) -> None:
    (left, top), (right, bottom) = window
    ax.set(xlim=(max(left, 0.0), min(right, size_px[0])))
    ax.set(ylim=(min(bottom, size_px[1]), max(top, 0.0)))  # v runs down
    ax.set(aspect="equal", xticks=[], yticks=[], facecolor="#f4f4f2")


def _ball(ax: Axes, edge: Array, k: int, alpha: float) -> None:
    from matplotlib.patches import Polygon

    ax.add_patch(Polygon(edge, facecolor=COLORS[k], edgecolor="none", alpha=alpha * 0.5))
