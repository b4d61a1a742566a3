"""Two tennis balls on a table, tracked in one video, and the corners clicked in it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.data.importers.common import Array, facts, read_columns, read_metadata
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
    points, what = read_columns(
        folder / "calibration_points.csv", ["u_px", "v_px", "x_m", "y_m", "z_m"], ["what"]
    )
    runs = two_parts(data["time_s"], balls, points, setup, HELD_OUT_FROM)
    extra: dict[str, Any] = {
        "camera_by_authors": meta["camera_by_authors"],
        "calibration_points": {**points, **what},
    }
    return Study(
        name="tennis_balls",
        system="rigid_body",
        channels=tuple(Channel(c, "px", "image", sd) for c, sd in CHANNELS.items()),
        runs=runs,
        metadata=facts(
            meta,
            held_out="after: frames 171 to 182 of the one video; the model is started at frame "
            "150 and fitted until 170, so that they judge a prediction in time, not another "
            "collision",
            notes="the channels corner_u_px and corner_v_px are no motion: the first eight samples "
            "of collision hold the corners clicked in the first frame, in the order of the file; "
            "the command corner_*_m says where they are",
        )
        | extra,
    )


def two_parts(
    time_s: Array,
    balls: Array,
    points: Mapping[str, Array],
    setup: Mapping[str, float],
    held_out_from: int,
) -> tuple[Run, Run]:
    """The first samples with the clicks, and the last ones, held out.

    Args:
        time_s: Times of the samples, (num_samples,) [s].
        balls: Clicked centers u, v of both balls, (num_samples, 4) [px].
        points: "u_px", "v_px", "x_m", "y_m", "z_m" of the clicked corners.
        setup: Facts that hold for both runs, such as the frame rate, by name.
        held_out_from: Sample with which the second run begins.
    """
    clicks = np.column_stack([points["u_px"], points["v_px"]])
    parts = {"collision": slice(0, held_out_from), "after": slice(held_out_from, None)}
    first, last = (
        Run(
            name=name,
            time_s=time_s[part],
            measured=_with_clicks(balls[part], clicks if name == "collision" else clicks[:0]),
            command={
                f"corner_{a}_m": _filled_up(points[f"{a}_m"], len(balls[part])) for a in "xyz"
            },
            group=name,
            order=order,
            use="test" if name == "after" else "fit",
            setup=setup,
        )
        for order, (name, part) in enumerate(parts.items())
    )
    return first, last


def _with_clicks(balls: Array, clicks: Array) -> Array:
    """All channels: a corner's click per sample while they last."""
    out = np.full((len(balls), len(CHANNELS)), np.nan)
    out[:, :4] = balls
    out[: len(clicks), 4:] = clicks
    return out


def _filled_up(values: Array, length: int) -> Array:
    """The first values, then zeros."""
    out = np.zeros(length)
    out[: min(len(values), length)] = values[:length]
    return out
