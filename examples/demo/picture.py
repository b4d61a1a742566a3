"""One picture of the demo for a README: the beam, and its tip's path as measured and simulated.

``diffsim demo --out runs/demo && cp runs/demo/figures/beam.png docs/images/beam.png``
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.viz import figures
from diffsim.viz.figures import COLORS, INK, SOFT
from examples.data.beam import TIP_MARKERS, BeamStudy
from examples.data.beam_motion import COMPARE_S
from examples.demo import verdict

Array = NDArray[np.float64]
SIZE_INCH, DPI = (12.0, 5.4), 100
NARROW_INCH, NARROW_DPI = (5.2, 8.0), 150


def beam(study: BeamStudy, results: dict[str, Any], *, narrow: bool = False) -> bytes:
    """PNG, 1200 x 540: simulated beam with measured markers, tip height beside it; 780 x 1200 with
    the height below, for a phone."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # an extra
    from matplotlib.figure import Figure

    _, case = verdict.cases(study)
    trial = study.repeats()[case][1]
    size, dpi = (NARROW_INCH, NARROW_DPI) if narrow else (SIZE_INCH, DPI)
    figure = Figure(figsize=size, dpi=dpi, facecolor="white")
    places = ((0.0, 0.48, 1.0, 0.42), (0.15, 0.08, 0.82, 0.39))
    if not narrow:
        places = ((0.0, 0.0, 0.46, 0.9), (0.535, 0.14, 0.45, 0.70))
    left = figure.add_axes(places[0], projection="3d")
    right = figure.add_axes(places[1])
    kept = np.load(results["simulated"]["joint"][case]["surface"])
    time_s, tip = trial.after_release(COMPARE_S)
    lowest = float(time_s[np.argmin(tip[:, 2])])
    _body(left, study, trial, kept, lowest)

    figures.style(right)
    right.axhline(0.0, color="#d9dde4", lw=0.8)
    for name, words, color, width in (
        ("published", "published practice", COLORS["published"], 1.5),
        ("joint", "E and damping identified", COLORS["fitted"], 2.4),
    ):
        run = results["simulated"][name][case]
        z = 1e3 * np.asarray(run["tip_m"])[:, 2]
        right.plot(run["time_s"], z, color=color, lw=width, label=words)
    right.plot(time_s, 1e3 * tip[:, 2], "o", ms=2.6, color=INK, label="virtual" if study.is_virtual
               else "measured (motion capture)", zorder=5)  # fmt: skip
    right.axvline(lowest, color=SOFT, lw=0.7, ls=":")
    right.set(xlim=(0.0, COMPARE_S), ylim=(None, 1.0))
    right.set_xlabel("time since release [s]", color=SOFT)
    right.set_ylabel("tip height [mm]", color=SOFT)
    right.legend(frameon=False, fontsize=9 if narrow else 10.5, labelcolor=INK,
                 loc="lower right")  # fmt: skip
    words = "VIRTUAL DATA — " if study.is_virtual else ""
    above = "above" if narrow else "left"
    below = "\nbelow" if narrow else "right"
    red = "\nred" if narrow else "red"
    size = (9 if words else 11) if narrow else 16  # the longer title is as wide as a phone
    figure.text(0.03, 0.955 if narrow else 0.93, f"{words}A silicone beam with a "
                f"{1e3 * trial.tip_load_mass_kg:.0f} g weight, released",
                fontsize=size, color=INK, fontweight="bold")  # fmt: skip
    figure.text(0.03, 0.945 if narrow else 0.885,
                f"{above}: simulated {1e3 * lowest:.0f} ms after release; {red}: the "
                f"tip markers and their measured path.  {below}: tip height on a recording "
                "that no fit has seen", va="top" if narrow else "baseline",
                fontsize=9 if narrow else 10.5, color=SOFT)  # fmt: skip
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()


def _body(ax: Any, study: BeamStudy, trial: Any, kept: Any, at_s: float) -> None:
    """The surface at a time, colored by its vertical displacement, and the tip markers."""
    from matplotlib.colors import LinearSegmentedColormap
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    nodes = 1e3 * kept["nodes_m"].astype(np.float64)
    now = nodes[int(np.argmin(np.abs(kept["time_s"] - at_s)))]
    quads = kept["quads"]
    corners = now[quads]
    normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    light = np.array([0.35, -0.55, 0.75])
    shade = 0.62 + 0.38 * np.clip(normal @ (light / np.linalg.norm(light)), 0.0, 1.0)
    drop = (nodes[0] - now)[quads][..., 2].mean(axis=1)
    ramp = LinearSegmentedColormap.from_list("drop", ["#cfe6e4", "#3f9a9c", "#0b5a66"])
    face = ramp(drop / max(drop.max(), 1e-9))
    face[:, :3] *= shade[:, None]
    wall = np.array([[-100.0, -10, -14], [-100, 40, -14], [-100, 40, 44], [-100, -10, 44]])
    wall[:, 0] = -1e3 * study.geometry.length_m
    ax.add_collection3d(  # behind the beam, drawn first: orders below are by hand
        Poly3DCollection(
            [wall], facecolors="#e6e8ec", edgecolors="#c3c8d1", linewidths=0.8, zorder=0
        )
    )
    ax.add_collection3d(
        Poly3DCollection(
            corners, zorder=2, facecolors=face, edgecolors="#ffffff40", linewidths=0.35
        )
    )
    outline = [[0, 0, 0], [0, 30, 0], [0, 30, 30], [0, 0, 30], [0, 0, 0]]
    box = np.array(outline, dtype=float) * [1, study.geometry.width_m / 0.03,
                                            study.geometry.height_m / 0.03]  # fmt: skip
    ax.plot(*box.T, color=SOFT, lw=0.8, ls="--", zorder=1)
    length = 1e3 * study.geometry.length_m
    for y, z in ((0, 0), (0, 30), (30, 30)):
        ax.plot([-length, 0], [y, y], [z, z], color=SOFT, lw=0.8, ls="--", zorder=1)
    # markers: nominal places moved as measured
    nominal = np.array([study.geometry.marker_place_m[name] for name in TIP_MARKERS])
    frame = int(np.argmin(np.abs(trial.time_s - at_s)))
    places = 1e3 * (nominal + trial.marker_displacement_m[frame])
    path = (trial.time_s >= 0) & (trial.time_s <= at_s)
    for i, place in enumerate(places):
        way = 1e3 * (nominal[i] + trial.marker_displacement_m[path, i])
        ax.plot(*way.T, color=COLORS["bad"], lw=1.0, zorder=10)
        ax.scatter(*place, color=COLORS["bad"], s=46, zorder=11, edgecolors="white",
                   linewidths=0.8, depthshade=False)  # fmt: skip
    ax.computed_zorder = False
    ax.set_proj_type("persp", focal_length=0.6)
    ax.set(xlim=(-length, 8), ylim=(-16, 48), zlim=(-30, 42))
    ax.set_box_aspect((length + 8, 64, 72), zoom=1.18)
    ax.view_init(elev=14, azim=-62)
    ax.set_axis_off()
