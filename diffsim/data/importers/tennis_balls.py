"""Two tennis balls on a table, tracked in one video."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffsim.data.importers.common import facts, read_columns, read_metadata
from diffsim.data.study import Channel, Run, Study

PIXELS = ("ball0_u_px", "ball0_v_px", "ball1_u_px", "ball1_v_px")


def import_tennis_balls(folder: Path) -> Study:
    """Centres in the picture [px], which is what was measured; the camera is in the metadata."""
    meta = read_metadata(folder)
    data, _ = read_columns(folder / "tracks.csv", ["time_s", *PIXELS])
    points, what = read_columns(
        folder / "calibration_points.csv", ["u_px", "v_px", "x_m", "y_m", "z_m"], ["what"]
    )
    run = Run(
        name="collision",
        time_s=data["time_s"],
        measured=np.column_stack([data[c] for c in PIXELS]),
        command={},
        group="collision",
        setup={
            "ball_diameter_m": float(meta["geometry"]["ball_diameter_m"]),
            "ball_mass_kg": float(meta["geometry"]["ball_mass_kg_typical"]),
        },
    )
    sd = float(meta["noise"]["pixel_std_moving"])
    extra = {
        "camera_by_authors": meta["camera_by_authors"],
        "calibration_points": {**points, **what},
    }
    return Study(
        name="tennis_balls",
        system="rigid_body",
        channels=tuple(Channel(c, "px", "image", sd) for c in PIXELS),
        runs=(run,),
        metadata=facts(meta, held_out="none: there is one video; nothing can be left out") | extra,
    )
