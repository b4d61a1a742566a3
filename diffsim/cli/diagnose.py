"""``diffsim diagnose``: what a simulation gets wrong against recorded runs."""

from __future__ import annotations

import argparse
from pathlib import Path

from diffsim.cli.arguments import (
    DIAGNOSES,
    FULL,
    NO_STUDY,
    QUICK,
    fact,
    names,
    positive,
    study_file,
)

HELP = "what a simulation gets wrong against recorded runs"
STEPS = {
    "init": "look at a folder of recordings and write a first study.yaml",
    "check": "what the study holds, and every mistake that can be seen before a simulation",
    "fit": "fit the model without effects, and say what misfit is left",
    "explain": "find the cause: verdict, evidence, report.html",
    "extend": "refit a saved extended model, and measure its gain on test runs",
    "judge": "errors of a saved model on new runs; nothing is fitted",
    "faults": "which groups of runs have a fault, and which, against the scatter between groups",
    "export": "constants of a saved model in the words of other programs",
    "next": "which run to record next to settle what is open",
    "schema": "JSON Schema of study.yaml, for editors that complete keys",
    "command": "the commands with which a saved model follows a task's courses best",
    "worth": "what it would buy a task to mend a cause, in half or as a whole",
}


def add_arguments(parser: argparse.ArgumentParser, common: argparse.ArgumentParser) -> None:
    """Add a subcommand per step of the diagnosis."""
    steps = parser.add_subparsers(dest="step", required=True, metavar="STEP")
    made = {
        name: steps.add_parser(name, parents=[common], help=what, description=what)
        for name, what in STEPS.items()
    }
    _starting(made.pop("init"))
    _finding(made.pop("faults"))
    made.pop("schema").add_argument(
        "--out",
        type=Path,
        default=Path("study.schema.json"),
        help="file to write (default: %(default)s)",
    )
    for name, step in made.items():
        step.add_argument(
            "study", metavar="STUDY", help="study.yaml, its folder, or a published data set's name"
        )
        if name not in ("check", "export", "command", "worth"):
            _judging(step)
    _choosing(made["explain"])
    made["explain"].add_argument(
        "--force", action="store_true", help="diagnose again although --out holds the answer"
    )
    made["judge"].add_argument(
        "--runs", type=names, default=(), metavar="A,B", help="default: all with use: test"
    )
    made["next"].add_argument(
        "--csv", action="store_true", help="write the commands of the best run to OUT/next.csv"
    )
    for name in ("export", "command", "worth"):
        made[name].add_argument(
            "--out", type=Path, help=f"folder of the results (default: {DIAGNOSES}/STUDY)"
        )
    made["export"].add_argument(
        "--to",
        choices=("mujoco", "bam", "urdf", "yaml"),
        help="write the whole answer for a program, say what it carries, and fly it on your runs",
    )
    for name in ("command", "worth"):
        made[name].add_argument(
            "--task", type=Path, required=True, metavar="FILE", help="task.yaml: what is wanted"
        )
    made["command"].add_argument(
        "--draws",
        type=int,
        default=0,
        metavar="N",
        help="good in the mean of N draws from the posterior (default: at the file's values)",
    )
    made["command"].add_argument("--seed", type=int, default=0, help="of the draws (default: 0)")
    for name in ("check", "fit", "explain", "extend", "judge", "next"):
        _accepting(made[name])
    for name in ("extend", "judge", "export", "next", "command", "worth"):
        made[name].add_argument(
            "--report" if name == "next" else "--model",
            dest="saved",
            type=Path,
            metavar="FILE",
            help="of an earlier `explain` (default: the one in --out)",
        )


def _starting(step: argparse.ArgumentParser) -> None:
    step.add_argument("folder", metavar="FOLDER", type=Path, help="folder of your recordings")
    step.add_argument("--out", type=Path, help="file to write (default: FOLDER/study.yaml)")
    step.add_argument(
        "--system",
        metavar="KIND",
        help="kind of system (default: `outside` where an MJCF lies in the folder, else `ode`)",
    )
    step.add_argument(
        "--part",
        dest="parts",
        action="append",
        default=[],
        metavar="PART",
        help="table of files that hold several (a topic, a group); repeated: the record first",
    )
    step.add_argument("--force", action="store_true", help="replace a file that is there")


def _accepting(step: argparse.ArgumentParser) -> None:
    step.add_argument(
        "--accept-record",
        action="store_true",
        help="go on although the record itself is at fault (frozen, wrapped, in another unit, ...)",
    )


def _finding(step: argparse.ArgumentParser) -> None:
    _accepting(step)
    step.add_argument(
        "study", metavar="STUDY", help="study.yaml with `faults`, its folder, or a published set"
    )
    step.add_argument(
        "--new",
        type=Path,
        nargs="+",
        action="append",
        default=[],
        metavar="CSV",
        help="judge runs that are not in the study: one group; again for another group",
    )
    step.add_argument(
        "--fact",
        type=fact,
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="fact of the new runs that the study needs, such as vehicle=E9; new_2:vehicle=E7 is "
        "one of the second new group alone, b.csv:vehicle=E7 of the group with this file",
    )
    step.add_argument(
        "--groups", type=names, default=(), metavar="A,B", help="judge only these groups"
    )
    step.add_argument(
        "--all", action="store_true", help="judge known groups too, each by the others"
    )
    step.add_argument(
        "--out", type=Path, help=f"folder of the results (default: {DIAGNOSES}/STUDY)"
    )
    step.add_argument("--seed", type=int, default=0, help="of draws of the scatter (default: 0)")


def _budget(text: str) -> str | float:
    """quick, full or a count of steps."""
    try:
        return text if text in (QUICK, FULL) else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"expected {QUICK}, {FULL} or a number of steps such as 5e7, got {text!r}"
        ) from None


def _judging(step: argparse.ArgumentParser) -> None:
    step.add_argument(
        "--out", type=Path, help=f"folder of the results (default: {DIAGNOSES}/STUDY)"
    )
    step.add_argument("--seed", type=int, default=0, help="of the bootstrap (default: 0)")
    step.add_argument(
        "--setup", type=Path, metavar="FILE.py", help="own model: a file with setup(study)"
    )
    step.add_argument(
        "--budget",
        type=_budget,
        default=FULL,
        metavar="quick|full|N",
        help="what may be simulated: a first answer, all (default), or N weighted steps a search",
    )
    step.add_argument(
        "--quick", dest="budget", action="store_const", const=QUICK, help="same as --budget quick"
    )
    step.add_argument(
        "--threads",
        dest="workers",
        type=positive,
        default=1,
        metavar="N",
        help="simulate N runs at a time (default: 1)",
    )
    # its name before all commands had one word for it
    step.add_argument(
        "--workers",
        dest="workers",
        type=positive,
        default=argparse.SUPPRESS,
        help=argparse.SUPPRESS,
    )
    step.add_argument(
        "--accept-numerics",
        action="store_true",
        help="go on although step, mesh or tolerance move the prediction by more than the noise",
    )


def _choosing(step: argparse.ArgumentParser) -> None:
    step.add_argument(
        "--effects", type=names, default=(), metavar="A,B", help="judge only these causes"
    )
    step.add_argument(
        "--without", type=names, default=(), metavar="C", help="leave these causes out"
    )


def command(args: argparse.Namespace) -> None:
    """Run one step of the diagnosis.

    Raises:
        FileNotFoundError: no such study.
        StudyError: the study has errors, printed above.
        ValueError: names that the setup does not have.
    """
    _refuse_early(args)
    from diffsim.cli.diagnose_steps import run_step

    run_step(args)


def _refuse_early(args: argparse.Namespace) -> None:
    """What needs no simulator to be refused: PyTorch takes seconds to load."""
    if args.step == "init":
        from diffsim.cli.init_target import require_target

        require_target(args.folder, args.out, force=args.force)
    if not hasattr(args, "study"):
        return
    path = study_file(args.study)
    file = path / "study.yaml" if path.is_dir() else path
    if not file.is_file():
        raise FileNotFoundError(f"{file}: {NO_STUDY}")
    for file in (file for files in getattr(args, "new", ()) for file in files):
        if not file.is_file():
            raise FileNotFoundError(f"{file}: no such file of a new run")
