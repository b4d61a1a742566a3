"""Figure of ``benchmarks.hexarotor``: the best so far against CPU seconds, and two airframes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.plot_style import new_figure, style
from diffsim.copter.waypoints import WaypointTask
from diffsim.viz.palette import save

COLORS = {"gradient": "#0b6e75", "cma": "#c2571a", "controller only": "#8a93a3"}
LABELS = {"gradient": "L-BFGS", "cma": "CMA-ES", "controller only": "L-BFGS, controller only"}
Results = Mapping[str, Mapping[str, Any]]


def draw(results: Results, path: Path) -> None:
    """Two panels of curves, one per number of parameters, and the best airframe beside the flat."""
    figure = new_figure(12.5, 3.6)
    axes = figure.subplots(1, 4, width_ratios=[1.3, 1.3, 1.0, 1.0])
    for axis, free in zip(axes, (False, True), strict=False):
        rows = [r for r in results.values() if r["free_gain"] == free]
        for row in rows:
            seconds, values = np.array(row["curve"]).T
            label = LABELS[row["method"]] if row["seed"] == rows[0]["seed"] else None
            axis.step(
                np.append(seconds, row["cpu_s"]),
                np.append(values, values[-1]),
                where="post",
                color=COLORS[row["method"]],
                linewidth=1.2,
                label=label,
            )
        count = {r["method"]: len(r["x"]) for r in rows}.get("gradient", 0)
        style(axis, f"{count} numbers", "CPU seconds", "mean distance to the waypoint [m]")
        axis.set_ylim(0.6, 1.5)
        axis.legend(frameon=False, fontsize=7)
    task = WaypointTask()
    best = min(
        (r for r in results.values() if r["method"] == "gradient"), key=lambda r: r["unseen"]
    )
    for axis, x, title in (
        (axes[2], task.start.numpy(), "flat regular"),
        (axes[3], np.array(best["x"]), "by gradient"),
    ):
        airframe(axis, task, x, title)
    save(figure, path, dpi=120)


def airframe(axis: Any, task: WaypointTask, x: np.ndarray, title: str) -> None:
    """Rotors from above, an ellipse each, with the horizontal part of their thrust as an arrow."""
    places, ways = task.airframe.rotors(torch.from_numpy(x[: task.num_design]))
    angle = np.linspace(0.0, 2.0 * np.pi, 60)
    for place, way in zip(places.numpy(), ways.numpy(), strict=True):
        across = np.linalg.svd(way[None])[2][1:]  # two unit vectors in the disc
        ring = np.cos(angle)[:, None] * across[0] + np.sin(angle)[:, None] * across[1]
        ring = place + task.airframe.parts.radius * ring
        axis.plot(ring[:, 1], ring[:, 0], color="#0b6e75", linewidth=1.2)
        axis.plot([0.0, place[1]], [0.0, place[0]], color="#8a93a3", linewidth=1.0, zorder=0)
        axis.annotate(
            "",
            (place[1] + 0.1 * way[1], place[0] + 0.1 * way[0]),
            (place[1], place[0]),
            arrowprops={"arrowstyle": "->", "color": "#c2571a"},
        )
        axis.text(place[1], place[0], f"{-100.0 * place[2]:+.0f}", fontsize=6, ha="center")
    style(axis, title, "y [m], heights in cm", "x [m]")
    axis.set_aspect("equal")
    axis.set_xlim(-0.38, 0.38)
    axis.set_ylim(-0.38, 0.38)
