"""``diffsim diagnose check|fit|explain|extend|next STUDY.yaml``."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from diffsim.data.study_check import check_study
from diffsim.data.study_file import load_study
from diffsim.errors import DiffsimError


class StudyError(DiffsimError):
    """Recordings that cannot be diagnosed."""


class NotConnectedError(DiffsimError):
    """A step of the command that this version cannot do yet; nothing was done."""


def diagnose_command(args: argparse.Namespace) -> None:
    """Run one step.

    Raises:
        FileNotFoundError: no such study.
        NotConnectedError: the step is not connected yet.
        StudyError: the study has errors, printed above.
    """
    if not args.study.is_file():
        raise FileNotFoundError(
            f"STUDY must be a YAML file of a study, got {args.study}, which does not exist"
        )
    step = CONNECTED.get(args.step)
    if step is None:
        raise NotConnectedError(
            f"diffsim diagnose {args.step} is not connected to the command line yet; nothing was "
            "read or written. Use diffsim.diagnose from Python"
        )
    step(args)


def _check(args: argparse.Namespace) -> None:
    """Read the study and say what is wrong with it."""
    study = load_study(args.study)
    problems = check_study(study)
    fit, held = len(study.fit_runs), len(study.holdout_runs)
    print(f"{study.name}: {len(study.channels)} channels, {fit} runs to fit, {held} held out")
    for problem in problems:
        print(problem)
    errors = sum(problem.severity == "error" for problem in problems)
    if errors:
        raise StudyError(f"{errors} of {len(problems)} problems keep {args.study} from a diagnosis")
    print("ready for a diagnosis")


CONNECTED: dict[str, Callable[[argparse.Namespace], None]] = {"check": _check}
"""Steps that work, by name."""
