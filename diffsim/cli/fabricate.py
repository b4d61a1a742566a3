"""``diffsim fabricate``: what it takes to build a multicopter."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "cut list, STL files, bill and wiring of a multicopter"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``diffsim fabricate``."""
    parser.add_argument("design", help="a shipped design such as pentacopter, or a YAML file")
    parser.add_argument("--out", type=Path, help="default: runs/fabricate/DESIGN")
    parser.add_argument("--stock", type=float, default=1.0, help="rods as sold [m], default 1")
    parser.add_argument("--kerf", type=float, default=0.0015, help="of the saw [m]")
    parser.add_argument(
        "--bed",
        type=float,
        nargs=3,
        default=(220.0, 220.0, 250.0),
        metavar="MM",
        help="of the printer",
    )


def command(args: argparse.Namespace) -> None:
    """Plan the fabrication, write its files and, where pictures can be drawn, its page."""
    from diffsim.copter import load_design
    from diffsim.copter.fabrication import Printer, plan
    from diffsim.copter.fabrication.files import write_plan
    from diffsim.core.optional import advice, present

    design = load_design(args.design)
    made = plan(design, stock=args.stock, kerf=args.kerf, printer=Printer(bed=tuple(args.bed)))
    folder = args.out or Path("runs/fabricate") / design.name
    lacks = [name for name in ("matplotlib", "jinja2") if not present(name)]
    if lacks:
        write_plan(made, folder)
    else:
        from diffsim.viz.fabrication_page import write_fabrication

        write_fabrication(made, folder)
    prints = sum(len(p.names) for p in made.printed if p.process == "print")
    print(
        f"{design.name}: {1e3 * made.mass:.0f} g, {made.price:.0f} EUR, "
        f"{len(made.bars)} bars of rod, {prints} printed parts"
    )
    for problem in made.problems:
        print(f"problem: {problem}")
    print(f"plan: {folder}" if lacks else f"page: {folder / 'index.html'}")
    if lacks:
        print(f"no page with pictures: {advice(lacks)}")
