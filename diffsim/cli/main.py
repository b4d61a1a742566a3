"""The ``diffsim`` command: demo, examples, diagnose, fly, fabricate, track and info."""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import platform
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from diffsim import __version__
from diffsim.cli.diagnose_arguments import add_diagnose_arguments, positive
from diffsim.cli.track_arguments import add_track_arguments
from diffsim.core import paths
from diffsim.core.errors import DiffsimError

EXIT_MISTAKE = 2  # what argparse uses too
EXIT_INTERRUPTED = 130  # 128 + SIGINT


def parser() -> argparse.ArgumentParser:
    """The command line, as ``diffsim --help`` shows it."""
    top = argparse.ArgumentParser(
        prog="diffsim", description="Design robots through differentiable simulation."
    )
    top.add_argument("--version", action="version", version=f"diffsim {__version__}")
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--debug", action="store_true", help="show the traceback of an error")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    demo = commands.add_parser("demo", parents=[common], help="run the tour of all systems")
    demo.add_argument("--data", type=Path, help="folder of the measured data (else DIFFSIM_DATA)")
    demo.add_argument("--out", type=Path, default=Path("runs/demo"), help="default: %(default)s")
    demo.add_argument("--quick", action="store_true", help="fewer steps, smaller meshes")
    demo.add_argument("--resume", action="store_true", help="go on with what --out holds")
    demo.add_argument("--threads", type=positive, default=os.cpu_count() or 1, metavar="N")
    demo.set_defaults(run=_demo)

    examples = commands.add_parser("examples", help="list the examples, or run one by its name")
    _add_examples_arguments(examples, common)

    fabricate = commands.add_parser(
        "fabricate", parents=[common], help="cut list, STL files, bill and wiring of a multicopter"
    )
    fabricate.add_argument("design", help="a shipped design such as pentacopter, or a YAML file")
    fabricate.add_argument("--out", type=Path, help="default: runs/fabricate/DESIGN")
    fabricate.add_argument("--stock", type=float, default=1.0, help="rods as sold [m], default 1")
    fabricate.add_argument("--kerf", type=float, default=0.0015, help="of the saw [m]")
    fabricate.add_argument(
        "--bed",
        type=float,
        nargs=3,
        default=(220.0, 220.0, 250.0),
        metavar="MM",
        help="of the printer",
    )
    fabricate.set_defaults(run=_fabricate)

    fly = commands.add_parser("fly", parents=[common], help="fly a multicopter in simulation")
    _add_fly_arguments(fly)
    fly.set_defaults(run=_fly)

    diagnose = commands.add_parser(
        "diagnose", help="what a simulation gets wrong against recorded runs"
    )
    add_diagnose_arguments(diagnose)
    diagnose.set_defaults(run=_diagnose)

    track = commands.add_parser(
        "track", parents=[common], help="from a video of balls to their tracks in pixels"
    )
    add_track_arguments(track)
    track.set_defaults(run=_track)

    info = commands.add_parser("info", parents=[common], help="versions, processor, data folder")
    info.set_defaults(run=_info)
    return top


def _demo(args: argparse.Namespace) -> None:
    if args.data is not None and not args.data.is_dir():
        raise ValueError(f"--data must be an existing folder, got {args.data}")
    # Imported only here: `diffsim info` must work where a demo's dependency is missing.
    from diffsim.demo import main as run_demo

    run_demo(
        data=args.data,
        out=args.out,
        quick=args.quick,
        resume=args.resume,
        threads=args.threads,
    )


def _add_examples_arguments(
    examples: argparse.ArgumentParser, common: argparse.ArgumentParser
) -> None:
    steps = examples.add_subparsers(dest="step", required=True, metavar="list|run|gallery")
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
    examples.set_defaults(run=_examples)


def _examples(args: argparse.Namespace) -> int:
    # as for the demo
    from diffsim.applications import catalogue

    if args.step == "list":
        print(catalogue.listing(catalogue.examples()))
        return 0
    if args.step == "gallery":
        from diffsim.applications import gallery

        gallery.require_success(gallery.make(args.out, args.names, args.docs))
        print(f"page: {args.out / 'gallery.md'}")
        return 0
    return catalogue.run(args.name, quick=args.quick, options=args.options)


def _fabricate(args: argparse.Namespace) -> None:
    from diffsim.copter import load_design  # only here: see _demo
    from diffsim.copter.fabrication import Printer, plan
    from diffsim.viz.fabrication_page import write_fabrication

    design = load_design(args.design)
    found = plan(design, stock=args.stock, kerf=args.kerf, printer=Printer(bed=tuple(args.bed)))
    page = write_fabrication(found, args.out or Path("runs/fabricate") / design.name)
    prints = sum(len(p.names) for p in found.printed if p.process == "print")
    print(
        f"{design.name}: {1e3 * found.mass:.0f} g, {found.price:.0f} EUR, "
        f"{len(found.bars)} bars of rod, {prints} printed parts"
    )
    for problem in found.problems:
        print(f"problem: {problem}")
    print(f"page: {page}")


def _add_fly_arguments(fly: argparse.ArgumentParser) -> None:
    fly.add_argument("design", metavar="DESIGN", help="a shipped design or a YAML file")
    pilot = fly.add_mutually_exclusive_group()
    pilot.add_argument(
        "--mission", default="hover", help="a shipped one or a YAML file (default: %(default)s)"
    )
    pilot.add_argument("--sticks", type=Path, metavar="FILE", help="recorded sticks (CSV)")
    pilot.add_argument("--input", metavar="DEVICE", help="keyboard or gamepad (needs pygame)")
    fly.add_argument(
        "--stick-mode", default="position", help="position or attitude (default: %(default)s)"
    )
    fly.add_argument("--controller", default="lqr", help="lqr or pid (default: %(default)s)")
    fly.add_argument("--payload", type=float, default=0.0, metavar="KG", help="load carried")
    fly.add_argument(
        "--pwm-max", type=float, default=1800.0, metavar="US", help="clamp (default: %(default)g)"
    )
    fly.add_argument("--seconds", type=float, help="end after that long")
    fly.add_argument(
        "--speed",
        type=float,
        help="of the simulation per wall clock, 0: as fast as possible (default: 1 with --view or "
        "--input, else 0)",
    )
    fly.add_argument("--seed", type=int, default=0, help="of the sensors' noise")
    fly.add_argument("--out", type=Path, default=Path("runs/fly"), help="default: %(default)s")
    fly.add_argument("--view", action="store_true", help="watch it in the rerun viewer")


def _fly(args: argparse.Namespace) -> None:
    # as for the demo
    from diffsim.cli.fly import fly_command

    fly_command(args)


def _diagnose(args: argparse.Namespace) -> None:
    # as for the demo
    if args.step == "blind":
        from benchmarks.blind.sessions import blind_command

        blind_command(args)
        return
    from diffsim.cli.diagnose import diagnose_command

    diagnose_command(args)


def _track(args: argparse.Namespace) -> None:
    # as for the demo
    from diffsim.cli.track import track_command

    track_command(args)


def _info(_args: argparse.Namespace) -> None:
    rows = [("diffsim", __version__), ("python", platform.python_version())]
    for name in ("torch", "numpy", "scipy"):
        try:
            rows.append((name, importlib.metadata.version(name)))
        except importlib.metadata.PackageNotFoundError:
            rows.append((name, "missing"))
    rows.append(("system", f"{platform.system()} {platform.machine()}"))
    try:
        from diffsim.core import compiled

        rows.append(("instruction set", compiled.core.instruction_set))
        rows.append(("available here", ", ".join(compiled.available())))
    except ImportError as err:
        rows.append(("compiled core", f"not loaded: {err}"))
    rows.append(("processors", str(os.cpu_count())))
    rows.append(("package", str(Path(__file__).parents[1])))
    found = paths.data_folder()
    rows.append(("data", str(found) if found else "not found (set DIFFSIM_DATA)"))
    rows += [("  looked for in", str(path)) for path in paths.data_candidates()]
    for name, value in rows:
        print(f"{name:<16} {value}")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments without the program's name; None takes the process's own.

    Returns:
        Exit status: 0, 2 after a user's or a numerical error, 130 after Ctrl-C.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    cut = given.index("--") if given[:2] == ["examples", "run"] and "--" in given else len(given)
    args = parser().parse_args(given[:cut])
    args.options = given[cut + 1 :]
    try:
        status = args.run(args) or 0
        sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        print("\ninterrupted; finished work is kept", file=sys.stderr)
        again = given
        if args.command == "demo" and not args.resume:
            again.append("--resume")
        if args.command in ("demo", "diagnose"):
            print(f"go on with: diffsim {shlex.join(again)}", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:  # `diffsim info | head`: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_MISTAKE
    except (DiffsimError, ValueError, ImportError, OSError) as err:
        if args.debug:
            raise
        message = " ".join(str(err).split())
        print(f"diffsim: {type(err).__name__}: {message}", file=sys.stderr)
        print("(--debug shows where it came from)", file=sys.stderr)
        return EXIT_MISTAKE


if __name__ == "__main__":
    raise SystemExit(main())
