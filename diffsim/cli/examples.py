"""``diffsim examples``: list them, run one, or make the gallery."""

from __future__ import annotations

import argparse
from pathlib import Path

from diffsim.core.paths import import_script

HELP = "list the examples, or run one by its name"


def add_arguments(parser: argparse.ArgumentParser, common: argparse.ArgumentParser) -> None:
    """A subcommand each for the list, one example and the gallery."""
    steps = parser.add_subparsers(dest="step", required=True, metavar="list|run|gallery")
    steps.add_parser("list", parents=[common], help="every example and its question")
    one = steps.add_parser("run", parents=[common], help="run one")
    one.add_argument("name", metavar="NAME", help="as diffsim examples list shows it")
    one.add_argument("--quick", action="store_true", help="its short version")
    one.epilog = "What follows -- goes to the script: diffsim examples run plant -- --help"
    gallery = steps.add_parser(
        "gallery", parents=[common], help="run what has a picture and a number, and make the page"
    )
    gallery.add_argument("names", nargs="*", metavar="NAME", help="only these (default: all)")
    gallery.add_argument(
        "--out", type=Path, default=Path("runs/gallery"), help="default: %(default)s"
    )
    gallery.add_argument("--docs", type=Path, help="put page and pictures into this docs folder")


def command(args: argparse.Namespace) -> int:
    """List, run, or make the gallery; returns the exit status."""
    from diffsim.cli import catalog

    if args.step == "list":
        print(catalog.listing(catalog.examples()))
        return 0
    if args.step == "gallery":
        gallery = import_script("examples.gallery")
        gallery.require_success(gallery.make(args.out, args.names, args.docs))
        print(f"page: {args.out / 'gallery.md'}")
        return 0
    return catalog.run(args.name, quick=args.quick, options=args.options)
