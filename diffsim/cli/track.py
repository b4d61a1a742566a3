"""``diffsim track``: from a video file to a table of tracks, or to a study."""

from __future__ import annotations

import argparse

import numpy as np

from diffsim.data.study_file import save_study
from diffsim.data.track import noise_px, tracks_study, without_merged
from diffsim.data.video import TENNIS_BALL, ColourBounds, track_video


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
