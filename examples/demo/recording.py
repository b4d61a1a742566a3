"""The demo as a rerun recording: simulated beams, measured markers, tip curves, one clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.viz import scene
from diffsim.viz.figures import COLORS
from diffsim.viz.frames import triangles
from examples.data.beam import TIP_MARKERS, BeamStudy
from examples.data.beam_motion import COMPARE_S
from examples.demo.ladder import Rung, run_of

ROLE = {"published": "published", "identified": "fitted", "mass": "third", "joint": "fourth"}
ASIDE_M = 0.07  # beams stand side by side, so that they can be seen


def write(study: BeamStudy, results: Mapping[str, Any], models: Sequence[Rung], path: Path) -> Path:
    """Write the ``.rrd``; every kept surface, and the markers of each case's second trial."""
    surfaces, points, plots = [], [], []
    for row, (case, trials) in enumerate(study.repeats().items()):
        trial = trials[-1]
        shown = (trial.time_s >= 0) & (trial.time_s <= COMPARE_S)
        time_s = trial.time_s[shown]
        nominal = np.array([study.geometry.marker_place_m[name] for name in TIP_MARKERS])
        places = nominal + trial.marker_displacement_m[shown]
        plots.append(_curve(f"tip/{case}/measured", time_s, trial.tip_displacement_m[shown, 2],
                            trial.name, "measured"))  # fmt: skip
        column = 0
        for rung in models:
            run = run_of(results["simulated"], rung, case)
            role = ROLE.get(rung.name, "third")
            if rung.name not in results["simulated"] or case not in results["simulated"][rung.name]:
                continue
            if rung.name in ROLE:
                plots.append(
                    _curve(f"tip/{case}/{rung.name}", np.asarray(run["time_s"]),
                           np.asarray(run["tip_m"])[:, 2], rung.title, role)
                )  # fmt: skip
            if "surface" not in run:
                continue
            kept = np.load(run["surface"])
            offset = np.array([0.16 * row, ASIDE_M * column, 0.0])
            column += 1
            where = f"beams/{case}/{rung.name}"
            surfaces.append(
                scene.MovingSurface(
                    path=f"{where}/surface",
                    time_s=kept["time_s"],
                    nodes_m=kept["nodes_m"] + offset.astype(np.float32),
                    triangles=triangles(kept["quads"]),
                    color=COLORS[role],
                )
            )
            points.append(
                scene.MovingPoints(
                    path=f"{where}/measured_{trial.name}",
                    time_s=time_s,
                    points_m=places + offset,
                    color=COLORS["bad"],
                )
            )
    kind = "VIRTUAL data, not measured" if study.is_virtual else "measured data"
    note = f"# Silicone beam ({kind})\n\n" + "\n\n".join(
        [
            "Red points: tip markers at their nominal places plus the displacement from the held "
            "state. Columns: models, rows: cases. Meters; clock: seconds since release.",
            *results["verdict"],
        ]
    )
    return scene.write(
        scene.Scene(
            title="silicone beam", note=note, surfaces=surfaces, points=points, plots=plots
        ),
        path,
    )


def _curve(path: str, time_s: np.ndarray, value_m: np.ndarray, name: str, role: str) -> scene.Plot:
    return scene.Plot(
        path=path, time_s=time_s, value=1e3 * value_m, name=f"{name} [mm]", color=COLORS[role]
    )
