"""Two tennis balls on a table, tracked in one video, and the corners clicked in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from diffsim.data.importers.common import facts, read_columns, read_metadata
from diffsim.data.study import Channel, Run, Study

#: Channel -> noise [px]: rms third difference over sqrt(20) of frames 162 to 170, free motion after
#: the impact (up to 0.54 px; README: 0.1 px, of the last frames); of the corners: of a click.
CHANNELS = {
    "ball0_u_px": 0.37,
    "ball0_v_px": 0.23,
    "ball1_u_px": 0.20,
    "ball1_v_px": 0.54,
    "corner_u_px": 1.0,
    "corner_v_px": 1.0,
}
HELD_OUT_FROM = 21  # sample of the video frame 171


def import_tennis_balls(folder: Path) -> Study:
    """Pixels, which is what was measured: the first 21 frames, the last 12 held out, the clicks."""
    meta = read_metadata(folder)
    data, _ = read_columns(folder / "tracks.csv", ["time_s", *list(CHANNELS)[:4]])
    balls = np.column_stack([data[c] for c in list(CHANNELS)[:4]])
    setup = {
        "ball_diameter_m": float(meta["geometry"]["ball_diameter_m"]),
        "ball_mass_kg": float(meta["geometry"]["ball_mass_kg_typical"]),
    }
    parts = {"collision": slice(0, HELD_OUT_FROM), "after": slice(HELD_OUT_FROM, None)}
    runs = [
        Run(
            name=name,
            time_s=data["time_s"][part],
            measured=_padded(balls[part], first=0),
            command={},
            group=name,
            order=order,
            use="holdout" if name == "after" else "fit",
            setup=setup,
        )
        for order, (name, part) in enumerate(parts.items())
    ]
    points, what = read_columns(
        folder / "calibration_points.csv", ["u_px", "v_px", "x_m", "y_m", "z_m"], ["what"]
    )
    extra: dict[str, Any] = {
        "camera_by_authors": meta["camera_by_authors"],
        "calibration_points": {**points, **what},
    }
    return Study(
        name="tennis_balls",
        system="rigid_body",
        channels=tuple(Channel(c, "px", "image", sd) for c, sd in CHANNELS.items()),
        runs=(*runs, _clicks(points)),
        metadata=facts(
            meta,
            held_out="after: frames 171 to 182 of the one video; the model is started at frame "
            "150 and fitted until 170, so that they judge a prediction in time, not another "
            "collision",
            notes="the run corners is no motion: its samples are the corners clicked in the first "
            "frame, in the order of the file, one per frame interval",
        )
        | extra,
    )


def _clicks(points: dict[str, Any]) -> Run:
    """The eight corners as a run without time."""
    count = len(points["u_px"])
    return Run(
        name="corners",
        time_s=np.arange(count) / 60.0,
        measured=_padded(np.column_stack([points["u_px"], points["v_px"]]), first=4),
        command={f"corner_{a}_m": points[f"{a}_m"] for a in "xyz"},
        group="corners",
        order=2,
    )


def _padded(values: Any, *, first: int) -> Any:
    """All channels, those not measured in this run as gaps."""
    out = np.full((len(values), len(CHANNELS)), np.nan)
    out[:, first : first + values.shape[1]] = values
    return out
