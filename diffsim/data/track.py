"""Tracks of balls as a study: without merged frames, with the noise of the tracker."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from diffsim.data.signal import scatter
from diffsim.data.study import Channel, Run, Study
from diffsim.data.video import Tracks


def without_merged(tracks: Tracks) -> Tracks:
    """The same track with NaN where balls touch in the picture, and their centers are biased."""
    centers = np.where(tracks.merged[:, None, None], np.nan, tracks.centers)
    return replace(tracks, centers=centers)


def noise_px(tracks: Tracks) -> np.ndarray:
    """Noise of every ball's u and v, (num_balls, 2) [px]: median third difference over sqrt(20).

    Smooth motion leaves little in a third difference; the median passes over the impacts. NaN
    where fewer than four frames in a row were seen.
    """
    third = np.diff(tracks.centers, n=3, axis=0)
    out = np.full(tracks.centers.shape[1:], np.nan)
    seen = np.isfinite(third).any(0) if len(third) else np.zeros_like(out, dtype=bool)
    out[seen] = scatter(third[:, seen], 3)
    return out


def tracks_study(tracks: Tracks, name: str) -> Study:
    """A study of one run, channels ball0_u_px, ball0_v_px, ... with the noise of ``noise_px``."""
    count = tracks.centers.shape[1]
    noise = noise_px(tracks)
    channels = tuple(
        Channel(f"ball{k}_{c}_px", "px", "image", float(sd) if sd > 0.0 else None)
        for k in range(count)
        for c, sd in zip("uv", noise[k], strict=True)
    )
    run = Run(
        name="tracks",
        time_s=tracks.time_s,
        measured=tracks.centers.reshape(len(tracks.frames), -1),
        command={},
        group="tracks",
        setup={"first_frame": float(tracks.frames[0])},
    )
    merged = tracks.frames[tracks.merged].tolist()
    metadata = {"source": f"video {name}", "frames_in_which_balls_touch": merged}
    return Study(name, "rigid_body", channels, (run,), metadata)
