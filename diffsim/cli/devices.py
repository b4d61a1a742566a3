"""``diffsim devices``: design a fluidic device, write its numbers and picture."""

from __future__ import annotations

import argparse

from diffsim.cli.arguments import add_executor

HELP = "design a fluidic device of slow flow, write its numbers and picture"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``diffsim devices``."""
    parser.add_argument("name", help="amplifier, averager, funnel, gate, twister, switch or yours")
    parser.add_argument("--out", metavar="FOLDER", help="numbers, picture and state; resumable")
    parser.add_argument("--resolution", type=float, default=1.0, help="factor on cells per axis")
    parser.add_argument(
        "--sample-resolution",
        type=float,
        help="draw and first improve designs on this coarser grid (see coarse_to_fine)",
    )
    parser.add_argument(
        "--coarse-evaluations", type=int, default=50, help="on the coarser grid, at most, per start"
    )
    parser.add_argument("--starts", type=int, default=3, help="to improve on the coarser grid")
    parser.add_argument(
        "--checked", type=int, help="random designs on both grids, for the unit loss (8)"
    )
    parser.add_argument("--samples", type=int, help="random designs (the thesis's number)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--evaluations", type=int, default=50, help="of loss and gradient, at most")
    add_executor(parser, "random designs and coarse descents")
    parser.add_argument("--no-slip", action="store_true", help="walls of the twister")
    parser.add_argument(
        "--export",
        action="store_true",
        help="the optimized device as .stl, its flow as .vti, .rrd and streamlines (.png)",
    )
    parser.add_argument(
        "--size", type=float, default=0.1, help="longest side of the exported solid's box [m]"
    )


def command(args: argparse.Namespace) -> None:
    """Design the device that the arguments name.

    Raises:
        ValueError: options that exclude each other, or ``--out`` holds another run.
    """
    if wrong := _conflict(args):
        raise ValueError(wrong)
    import torch

    from diffsim.cli.device_design import run
    from diffsim.core.executors import open_executor
    from diffsim.core.optional import ask_for
    from diffsim.stokes.devices import make

    if args.out is not None:
        ask_for(["matplotlib"], purpose="the picture of a device")
    if args.export:
        ask_for(["rerun"], purpose="--export")
    torch.set_num_threads(1)
    options = {"wall": "no_slip"} if args.no_slip else {}
    device = make(args.name, args.resolution, **options)
    coarse = None
    if args.sample_resolution is not None:
        coarse = make(args.name, args.sample_resolution, **options)
    with open_executor(args.executor) as executor:
        run(
            device,
            args.out,
            coarse=coarse,
            num_samples=args.samples,
            seed=args.seed,
            max_evaluations=args.evaluations,
            max_coarse_evaluations=args.coarse_evaluations,
            num_starts=args.starts,
            num_checked=args.checked,
            with_export=args.export,
            size=args.size,
            executor=executor,
        )


def _conflict(args: argparse.Namespace) -> str:
    """Message about options that exclude each other; empty: none."""
    if args.export and not args.out:
        return "--export needs --out, the folder to write to"
    if args.no_slip and args.name != "twister":
        return "--no-slip is for the twister; the other devices have the thesis's walls"
    return ""
