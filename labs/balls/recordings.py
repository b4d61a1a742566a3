"""Two colliding balls as a study: tracked and calibrated, the last part held out.

The lay-out is that of the soft balls' fit: clicked corners lie beside the balls, one per sample.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffsim.core.check import require_number
from diffsim.core.yaml_text import read_yaml_file
from diffsim.data.calibration import calibrate
from diffsim.data.study import Channel, Run, Study
from diffsim.data.table import read_numbers
from diffsim.data.video import (
    TENNIS_BALL,
    ColorBounds,
    TrackingError,
    Tracks,
    noise_px,
    opencv,
    track_video,
    without_merged,
)

Array = NDArray[np.float64]
LEAST_NOISE = 0.2  # [px] of a center: what the pixel grid and the lossy colors leave
#: Channel -> noise [px] of the published tracks, see tennis_balls.yaml; of the corners: of a click.
CHANNELS = {
    "ball0_u_px": 0.37,
    "ball0_v_px": 0.23,
    "ball1_u_px": 0.20,
    "ball1_v_px": 0.54,
    "corner_u_px": 1.0,
    "corner_v_px": 1.0,
}
_POINTS = ("u_px", "v_px", "x_m", "y_m", "z_m")


def ball_tracks_study(folder: str | Path, held_out_from: int = 21) -> Study:
    """The published tracks of two tennis balls, for the fit of soft balls.

    Args:
        folder: Folder with tracks.csv, calibration_points.csv and metadata.yaml.
        held_out_from: Sample with which the held-out run begins.
    """
    folder = Path(folder)
    meta = read_yaml_file(folder / "metadata.yaml")
    data = read_numbers(folder / "tracks.csv", ["time_s", *list(CHANNELS)[:4]])
    points = read_numbers(folder / "calibration_points.csv", list(_POINTS))
    geometry = meta["geometry"]
    setup = {
        "ball_diameter_m": float(geometry["ball_diameter_m"]),
        "ball_mass_kg": float(geometry["ball_mass_kg_typical"]),
    }
    balls = np.column_stack([data[c] for c in list(CHANNELS)[:4]])
    return Study(
        name="tennis_balls",
        system="rigid_body",
        channels=tuple(Channel(c, "px", "image", sd) for c, sd in CHANNELS.items()),
        runs=two_parts(data["time_s"], balls, points, setup, held_out_from),
        metadata={"camera_by_authors": meta["camera_by_authors"]},
    )


def ball_video_study(
    video: str | Path,
    corners: str | Path,
    *,
    diameter_m: float,
    mass_kg: float,
    color: ColorBounds = TENNIS_BALL,
    first: int = 0,
    last: int | None = None,
    held_out: float = 1.0 / 3.0,
) -> Study:
    """Track both balls and calibrate the camera.

    Frames in which the balls touch in the picture count as missing, since the tracker cuts the
    merged region where it is not sure. Ball 1 is the one that moves first.

    Args:
        video: File that OpenCV can read.
        corners: CSV with columns u_px, v_px, x_m, y_m, z_m: at least six points, clicked in the
            first picture, not all in one plane.
        diameter_m, mass_kg: Diameter [m] and mass [kg] of each of the two equal balls.
        color: Color range that marks a pixel as belonging to a ball.
        first, last: Frames to read; in the first, one ball rests and the other comes.
        held_out: Share of the frames, the last ones, that judge and are not fitted.

    Returns:
        Channels as those of the published tennis balls, with the noise of the track.

    Raises:
        ValueError: too few frames for the clicked corners (one row holds one corner).
    """
    require_number("held_out", held_out, at_least=0.0, below=1.0)
    points = read_numbers(Path(corners), list(_POINTS))
    tracks = _coming_last(without_merged(track_video(video, 2, color, first=first, last=last)))
    cut = round((1.0 - held_out) * len(tracks.frames))
    if cut < max(10, len(points["u_px"])):
        raise ValueError(
            f"{video}: {cut} frames to fit, expected at least 10 and one per clicked corner "
            f"({len(points['u_px'])}); read more frames or hold out less"
        )
    camera = calibrate(
        np.column_stack([points[f"{a}_m"] for a in "xyz"]),
        np.column_stack([points["u_px"], points["v_px"]]),
        _frame_size(video),
    )
    noise = np.maximum(noise_px(tracks).ravel(), LEAST_NOISE)
    sds = [*np.nan_to_num(noise, nan=1.0), 1.0, 1.0]
    balls = tracks.centers.reshape(len(tracks.frames), 4)
    setup = {"ball_diameter_m": diameter_m, "ball_mass_kg": mass_kg}
    runs = two_parts(tracks.time_s, balls, points, setup, cut)
    return Study(
        name=Path(video).stem,
        system="rigid_body",
        channels=tuple(
            Channel(c, "px", "image", float(sd)) for c, sd in zip(CHANNELS, sds, strict=True)
        ),
        runs=runs if held_out else runs[:1],
        metadata={"camera": camera, "size_px": list(_frame_size(video)), "source": str(video)},
    )


def _coming_last(tracks: Tracks) -> Tracks:
    """The ball that moves in the first frames becomes ball 1."""
    moved = np.nanmax(np.linalg.norm(tracks.centers[:6] - tracks.centers[0], axis=-1), axis=0)
    order = np.argsort(moved)
    return Tracks(tracks.frames, tracks.time_s, tracks.centers[:, order], tracks.merged)


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


def _frame_size(path: str | Path) -> tuple[int, int]:
    """Width and height of a video [px]; raises as ``track_video``."""
    cv2 = opencv()
    video = cv2.VideoCapture(str(path))
    try:
        size = tuple(
            int(video.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        )
    finally:
        video.release()
    if min(size) < 1:
        raise TrackingError(f"{path} is no video that OpenCV can read")
    return size[0], size[1]
