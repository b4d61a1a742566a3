"""``python -m benchmarks.diagnose_published``: every published data set by its YAML alone.

One row per data set: verdict, first sentence of the page, CPU seconds of the whole answer, the
machine being whatever it is, the share of gradient checks in it, and millions of weighted steps
(``SimModel.cost``), which are the same everywhere. ``--quick`` asks for first
answers, as ``diffsim diagnose explain --quick`` gives them. ``--only A,B`` and ``--out FILE.md``.

``--json FOLDER`` keeps every answer with all digits as FOLDER/NAME.json, without times: ``diff -r``
of two folders shows what a change of the code moved. Answers that are there are not asked for
again. ``--cheap`` asks for the sets of ``CHEAP`` alone.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from diffsim.cli.arguments import add_executor
from diffsim.cli.diagnose_check import require_ready
from diffsim.cli.diagnose_inputs import inputs_of, read_study
from diffsim.core import interruptible, open_executor, run_each
from diffsim.core.errors import DiffsimError
from diffsim.core.files import write_json_atomic, write_text_atomic
from diffsim.data.study import Study
from diffsim.diagnose.diagnosis import diagnosed
from diffsim.diagnose.faults import judge_faults
from diffsim.diagnose.faults.groups import groups_of
from diffsim.diagnose.inputs import Inputs
from diffsim.diagnose.say.report import Report
from diffsim.systems.registry import setup_of

PUBLISHED = Path(__file__).parents[1] / "diffsim/systems/published"
NAMES = tuple(sorted(path.stem for path in PUBLISHED.glob("*.yaml")))
CHEAP = (
    "cascaded_tanks",
    "cube_toss",
    "robot_fish",
    "rotor_drive",
    "silicone_tensile",
    "starfish",
)
"""Sets whose first answer takes no more than 10.5 million weighted steps."""
COLUMNS = ("data set", "verdict", "first sentence", "certain", "CPU s", "gradients", "steps")
HEAD = f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|"


class Clock:
    """CPU seconds at which the stages of a diagnosis begin."""

    def __init__(self) -> None:
        self.start = time.process_time()
        self.checks: float | None = None
        self.gradients = 0.0

    def __call__(self, stage: str, fraction: float, message: str) -> None:
        """Progress of ``diagnose``: what lies between the gradients' message and the next."""
        now = time.process_time()
        if message == "gradients":
            self.checks = now
        elif self.checks is not None:
            self.gradients, self.checks = now - self.checks, None


def library_answer(inputs: Inputs) -> Report:
    """The answer among causes of the library alone, without advice on what to record next."""
    return diagnosed(replace(inputs, setup=replace(inputs.setup, laws=None, bank=())))


@dataclass(frozen=True)
class Asked:
    """The answer of one data set, from its YAML alone, and what it took."""

    content: Mapping[str, Any]  # of ``report.json``, or of ``faults.json``
    verdict: str  # of the answer; "faults" of one of groups
    said: str  # the headline; of groups, how many faults are named and how many rightly
    certain: tuple[str, ...]  # certain causes
    cpu_s: float  # CPU seconds, checks and pages' numbers included
    gradients: float = 0.0  # share of gradient checks in them
    # weighted steps that were simulated, in millions; 0 of groups, which count none
    steps: float = 0.0


def asked(name: str, *, quick: bool = False) -> Asked:
    """The answer of a published data set, as ``diffsim diagnose explain`` gives it.

    Args:
        name: Name of the data set.
        quick: Ask for a first answer.

    Raises:
        DiffsimError: the answer failed.
        ValueError: the study cannot be asked.
    """
    clock = Clock()
    study = read_study(name)
    require_ready(study, name, plan=study.faults is None)
    if study.faults is not None:
        return _asked_of_faults(study, clock.start)
    inputs = inputs_of(study, seed=0, budget="quick" if quick else "full")
    report = diagnosed(inputs, progress=clock)
    cpu_s = time.process_time() - clock.start
    return Asked(
        report.to_dict(),
        report.verdict,
        report.headline,
        tuple(c.name for c in report.causes if c.status == "certain"),
        cpu_s,
        clock.gradients / cpu_s,
        1e-6 * inputs.setup.model.simulations.work.steps,
    )


def row(name: str, *, quick: bool = False, kept: Path | None = None) -> str:
    """One data set, from its YAML to the first sentence of its page.

    Args:
        name: Name of a published data set.
        quick: Ask for a first answer.
        kept: Folder that gets the answer.
    """
    start = time.process_time()
    try:
        found = asked(name, quick=quick)
    except (DiffsimError, ValueError) as error:
        cpu = time.process_time() - start
        return f"| {name} | failed | {' '.join(str(error).split())} | – | {cpu:.0f} | – | – |"
    if kept is not None:
        write_json_atomic(kept / f"{name}.json", found.content)
    said = f"| {name} | {found.verdict} | {found.said} | {', '.join(found.certain) or '–'} "
    return f"{said}| {found.cpu_s:.0f} | {found.gradients:.1%} | {found.steps:.1f} |"


def _asked_of_faults(study: Study, start: float) -> Asked:
    """A data set whose groups are judged for faults, each by the others."""
    assert study.faults is not None
    labels = [g.label for g in groups_of(study, study.faults)]
    report = judge_faults(study, setup_of(study), groups=labels)
    named = [v for v in report.verdicts if v.causes]
    right = sum(v.is_right is not False for v in named)
    alarms = sum(v.known == () for v in named)
    said = f"{len(named)} of {len(labels)} groups have a named fault, {right} of them rightly, "
    said += f"{alarms} false alarms."
    return Asked(report.to_dict(), "faults", said, (), time.process_time() - start)


def main() -> None:
    """Print the table, row by row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default=",".join(NAMES), help="names, comma between them")
    parser.add_argument("--quick", action="store_true", help="first answers")
    parser.add_argument("--cheap", action="store_true", help="those of few weighted steps")
    parser.add_argument("--out", type=Path, help="Markdown file that gets the table, too")
    parser.add_argument("--json", type=Path, help="folder that keeps each answer, all digits")
    add_executor(parser, "data sets")
    args = parser.parse_args()
    names = CHEAP if args.cheap else args.only.split(",")
    if args.json is not None:
        names = [name for name in names if not (args.json / f"{name}.json").exists()]
    made: dict[int, str] = {}
    print(HEAD)

    def keep(k: int, line: str) -> None:
        made[k] = line
        print(line, flush=True)
        if args.out is not None:
            lines = [HEAD, *(made[i] for i in sorted(made))]
            write_text_atomic(args.out, "\n".join(lines) + "\n")

    with open_executor(args.executor) as executor:
        run_each(partial(row, quick=args.quick, kept=args.json), names, executor, done=keep)


if __name__ == "__main__":
    with interruptible():
        main()
