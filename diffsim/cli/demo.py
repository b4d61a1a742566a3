"""``diffsim demo``: the silicone beam's story, which lies in ``examples/demo``."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from diffsim.cli.arguments import positive
from diffsim.core.optional import ask_for
from diffsim.core.paths import import_script

HELP = "the silicone beam's story: measured against simulated, on one page"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``diffsim demo``."""
    parser.add_argument("--data", type=Path, help="folder of the measured data (else DIFFSIM_DATA)")
    parser.add_argument("--out", type=Path, default=Path("runs/demo"), help="default: %(default)s")
    parser.add_argument("--quick", action="store_true", help="fewer steps, smaller meshes")
    parser.add_argument(
        "--all", action="store_true", help="compute stored answers again, too, and compare"
    )
    parser.add_argument("--resume", action="store_true", help="go on with what --out holds")
    parser.add_argument("--threads", type=positive, default=os.cpu_count() or 1, metavar="N")


def command(args: argparse.Namespace) -> None:
    """Run the story of the demo.

    Raises:
        ValueError: ``--data`` is no folder.
        FileNotFoundError: the scripts are neither in a checkout nor in the installed package.
        ImportError: what draws the page is not installed.
    """
    if args.data is not None and not args.data.is_dir():
        raise ValueError(f"--data must be an existing folder, got {args.data}")
    story = import_script("examples.demo")
    ask_for(["matplotlib", "plotly", "jinja2"], purpose="the page of the demo")
    story.main(
        data=args.data,
        out=args.out,
        quick=args.quick,
        resume=args.resume,
        threads=args.threads,
        anew=args.all,
    )
