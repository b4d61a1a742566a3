"""A video of two colliding balls as a study: tracked, calibrated, its last part held out."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffsim.core.check import require_number
from diffsim.data.calibration import calibrate
from diffsim.data.importers.common import read_columns
from diffsim.data.importers.tennis_balls import CHANNELS, two_parts
from diffsim.data.study import Channel, Study
from diffsim.data.track import noise_px, without_merged
from diffsim.data.video import TENNIS_BALL, ColorBounds, Tracks, frame_size, track_video

LEAST_NOISE = 0.2  # [px] of a center: what the pixel grid and the lossy colors leave


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
    points, _ = read_columns(Path(corners), ["u_px", "v_px", "x_m", "y_m", "z_m"])
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
        frame_size(video),
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
        metadata={"camera": camera, "size_px": list(frame_size(video)), "source": str(video)},
    )


def _coming_last(tracks: Tracks) -> Tracks:
    """The ball that moves in the first frames becomes ball 1."""
    moved = np.nanmax(np.linalg.norm(tracks.centers[:6] - tracks.centers[0], axis=-1), axis=0)
    order = np.argsort(moved)
    return Tracks(tracks.frames, tracks.time_s, tracks.centers[:, order], tracks.merged)
