"""Arguments of ``diffsim track``; light, so that ``diffsim --help`` imports nothing heavy."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_track_arguments(track: argparse.ArgumentParser) -> None:
    """Arguments of the subcommand."""
    track.add_argument("video", type=Path, metavar="VIDEO", help="a file that OpenCV can read")
    track.add_argument(
        "-o",
        "--out",
        type=Path,
        required=True,
        metavar="PATH",
        help="tracks.csv: one table; a name without .csv: a folder with study.yaml and the table",
    )
    track.add_argument("--balls", type=int, default=2, metavar="N", help="default: %(default)s")
    track.add_argument("--first", type=int, default=0, metavar="FRAME", help="to read, default 0")
    track.add_argument("--last", type=int, metavar="FRAME", help="to read, default: the end")
    for name in ("low", "high"):
        track.add_argument(
            f"--{name}",
            type=int,
            nargs=3,
            metavar=("HUE", "SATURATION", "VALUE"),
            help=f"{name} bound of the balls' colour, OpenCV's HSV; default: tennis balls",
        )
    track.add_argument("--min-area", type=int, default=20, metavar="PX", help="default: 20")
    track.add_argument(
        "--drop-merged", action="store_true", help="leave out frames in which balls touch"
    )
