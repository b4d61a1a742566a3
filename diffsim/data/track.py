"""``diffsim track``: from a video file to a table of tracks, or to a study."""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from diffsim.data.study import Channel, Run, Study
from diffsim.data.study_file import save_study
from diffsim.data.video import TENNIS_BALL, ColourBounds, Tracks, track_video


def track_command(args: argparse.Namespace) -> None:
    """Track, write, and say how much was seen."""
    low, high = args.low or TENNIS_BALL.low, args.high or TENNIS_BALL.high
    colour = ColourBounds(tuple(low), tuple(high))
    tracks = track_video(
        args.video,
        args.balls,
        colour,
        first=args.first,
        last=args.last,
        min_area=args.min_area,
    )
    merged = int(tracks.merged.sum())
    if args.drop_merged:
        tracks = without_merged(tracks)
    if args.out.suffix == ".csv":
        path = tracks.save(args.out)
    else:
        path = save_study(tracks_study(tracks, args.video.stem), args.out)
    lost = np.isnan(tracks.centres[..., 0]).sum(0)
    seen = ", ".join(
        f"ball {k} missing in {n}" + ("" if np.isnan(sd).any() else f", noise {sd.max():.2f} px")
        for k, (n, sd) in enumerate(zip(lost, noise_px(tracks), strict=True))
    )
    print(f"{len(tracks.frames)} frames, balls touch in {merged}; {seen}")
    print(f"written: {path}")


def without_merged(tracks: Tracks) -> Tracks:
    """The same with NaN where balls touch in the picture, and their centres are biased."""
    centres = np.where(tracks.merged[:, None, None], np.nan, tracks.centres)
    return replace(tracks, centres=centres)


def noise_px(tracks: Tracks) -> np.ndarray:
    """Noise of every ball's u and v, (num_balls, 2) [px]: median third difference over sqrt(20).

    Smooth motion leaves little in a third difference; the median passes over the impacts. NaN
    where fewer than four frames in a row were seen.
    """
    third = np.abs(np.diff(tracks.centres, n=3, axis=0))
    out = np.full(tracks.centres.shape[1:], np.nan)
    seen = np.isfinite(third).any(0) if len(third) else np.zeros_like(out, dtype=bool)
    out[seen] = np.nanmedian(third[:, seen], axis=0) / 0.6745 / np.sqrt(20.0)
    return out


def tracks_study(tracks: Tracks, name: str) -> Study:
    """A study of one run, channels ball0_u_px, ball0_v_px, ... with the noise of ``noise_px``."""
    count = tracks.centres.shape[1]
    noise = noise_px(tracks)
    channels = tuple(
        Channel(f"ball{k}_{c}_px", "px", "image", float(sd) if sd > 0.0 else None)
        for k in range(count)
        for c, sd in zip("uv", noise[k], strict=True)
    )
    run = Run(
        name="tracks",
        time_s=tracks.time_s,
        measured=tracks.centres.reshape(len(tracks.frames), -1),
        command={},
        group="tracks",
        setup={"first_frame": float(tracks.frames[0])},
    )
    merged = tracks.frames[tracks.merged].tolist()
    metadata = {"source": f"video {name}", "frames_in_which_balls_touch": merged}
    return Study(name, "rigid_body", channels, (run,), metadata)
