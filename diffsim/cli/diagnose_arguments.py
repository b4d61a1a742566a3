"""Arguments of ``diffsim diagnose``; light, so that ``diffsim --help`` imports no simulator."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

STEPS = {
    "check": "are the runs fit to be judged: clocks, shapes, repeats, held-out runs",
    "fit": "fit the model without effects, and say what misfit is left",
    "explain": "find the cause: verdict, evidence, report.html",
    "extend": "refit a saved extended model, and measure its gain on held-out runs",
    "next": "which run to record next to settle what is open",
    "blind": "hide effects in virtual laboratories, diagnose them unseen, and count what is right",
}
SYSTEMS = ("beam", "copter", "network")  # virtual laboratories, as users call them
DEFAULT_OUT = "runs/diagnose"


def positive(text: str) -> int:
    """A whole number from 1."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be 1 or more, got {value}")
    return value


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def add_diagnose_arguments(diagnose: argparse.ArgumentParser) -> None:
    """A subcommand per step."""
    steps = diagnose.add_subparsers(dest="step", required=True, metavar="STEP")
    made = {
        name: steps.add_parser(name, help=what, description=what) for name, what in STEPS.items()
    }
    for name, step in made.items():
        step.add_argument("--debug", action="store_true", help="show the traceback of an error")
        if name == "blind":
            _blind(step)
            continue
        step.add_argument(
            "study", metavar="STUDY", help="study.yaml, its folder, or a published data set's name"
        )
        if name != "check":
            _judging(step)
    _choosing(made["explain"])
    made["explain"].add_argument(
        "--force", action="store_true", help="diagnose again although --out holds the answer"
    )
    for name in ("extend", "next"):
        made[name].add_argument(
            "--model" if name == "extend" else "--report",
            dest="saved",
            type=Path,
            metavar="FILE",
            help="of an earlier `explain` (default: the one in --out)",
        )


def _judging(step: argparse.ArgumentParser) -> None:
    step.add_argument(
        "--out", type=Path, help=f"folder of the results (default: {DEFAULT_OUT}/STUDY)"
    )
    step.add_argument("--seed", type=int, default=0, help="of the bootstrap (default: 0)")
    step.add_argument(
        "--setup", type=Path, metavar="FILE.py", help="own model: a file with setup(study)"
    )
    step.add_argument("--quick", action="store_true", help="fewer refits: a first impression")
    step.add_argument(
        "--workers", type=positive, default=1, metavar="N", help="threads over runs (default: 1)"
    )
    step.add_argument(
        "--accept-numerics",
        action="store_true",
        help="go on although step, mesh or tolerance move the prediction by more than the noise",
    )


def _choosing(step: argparse.ArgumentParser) -> None:
    step.add_argument(
        "--effects", type=_names, default=(), metavar="A,B", help="judge only these causes"
    )
    step.add_argument(
        "--without", type=_names, default=(), metavar="C", help="leave these causes out"
    )


def _blind(step: argparse.ArgumentParser) -> None:
    step.add_argument("--n", type=positive, default=40, help="cases (default: 40)")
    step.add_argument("--seed", type=int, help="of the cases; fresh and printed if not given")
    step.add_argument("--system", choices=SYSTEMS, default="copter", help="default: %(default)s")
    step.add_argument("--kinds", type=_names, default=(), metavar="A,B", help="only such cases")
    step.add_argument("--out", type=Path, help="default: runs/blind/SYSTEM_SEED; resumes there")
    step.add_argument(
        "--vault", type=Path, help="folder of the labels, outside --out (default: OUT.vault)"
    )
    step.add_argument("--quick", action="store_true", help="fewer refits")
    step.add_argument(
        "--setup", type=Path, metavar="FILE.py", help="own model of the laboratory: setup(study)"
    )
    step.add_argument(
        "--timeout", type=float, default=3600.0, metavar="S", help="per case (default: 3600)"
    )
    step.add_argument(
        "--workers",
        type=positive,
        default=1,
        metavar="N",
        help=f"cases side by side (default: 1; this machine has {os.cpu_count()} processors)",
    )
