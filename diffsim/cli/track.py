"""``diffsim track``: from a video file to a table of tracks, or to a study."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "from a video of balls to their tracks in pixels"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``diffsim track``."""
    parser.add_argument("video", type=Path, metavar="VIDEO", help="a file that OpenCV can read")
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        required=True,
        metavar="PATH",
        help="tracks.csv: one table; a name without .csv: a folder with study.yaml and the table",
    )
    parser.add_argument("--balls", type=int, default=2, metavar="N", help="default: %(default)s")
    parser.add_argument("--first", type=int, default=0, metavar="FRAME", help="to read, default 0")
    parser.add_argument("--last", type=int, metavar="FRAME", help="to read, default: the end")
    for name in ("low", "high"):
        parser.add_argument(
            f"--{name}",
            type=int,
            nargs=3,
            metavar=("HUE", "SATURATION", "VALUE"),
            help=f"{name} bound of the balls' color, OpenCV's HSV; default: tennis balls",
        )
    parser.add_argument("--min-area", type=int, default=20, metavar="PX", help="default: 20")
    parser.add_argument(
        "--drop-merged", action="store_true", help="leave out frames in which balls touch"
    )


def command(args: argparse.Namespace) -> None:
    """Track, write, and say how much was seen."""
    import numpy as np

    from diffsim.data.study_save import save_study
    from diffsim.data.video import (
        TENNIS_BALL,
        ColorBounds,
        noise_px,
        track_video,
        tracks_study,
        without_merged,
    )

    low, high = args.low or TENNIS_BALL.low, args.high or TENNIS_BALL.high
    tracks = track_video(
        args.video,
        args.balls,
        ColorBounds(tuple(low), tuple(high)),
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
    lost = np.isnan(tracks.centers[..., 0]).sum(0)
    seen = ", ".join(
        f"ball {k} missing in {n}" + ("" if np.isnan(sd).any() else f", noise {sd.max():.2f} px")
        for k, (n, sd) in enumerate(zip(lost, noise_px(tracks), strict=True))
    )
    print(f"{len(tracks.frames)} frames, balls touch in {merged}; {seen}")
    print(f"written: {path}")
