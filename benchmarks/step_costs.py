"""What a simulation is counted as, beside what it takes: ``python -m benchmarks.step_costs``.

Budgets of a diagnosis are weighted steps (``SimModel.cost``), each about a microsecond of one core.
Only ratios between settings and the order of magnitude matter: this shows how far off they are.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

from diffsim.cli.arguments import described
from diffsim.cli.diagnose_inputs import inputs_of, read_study
from diffsim.core.errors import DiffsimError
from diffsim.diagnose.search.fit import Case
from diffsim.identify import Problem, WhiteNoise
from diffsim.identify.linearization import linearization_at
from diffsim.identify.model import Work

ROW = "{:20s} {:>5s} {:>8s} {:>12s} {:>14s} {:>12s} {:>14s}"


def plain_problem(given: str) -> Problem:
    """The plain model of a study with all candidates, on the runs to be fitted."""
    study = read_study(given)
    inputs = inputs_of(study, seed=0)
    study, setup = inputs.study.without_tests(), inputs.setup
    channels = [c if c.sd is not None else replace(c, sd=1.0) for c in study.channels]
    case = Case(study, setup.model, setup.effects, setup.unknowns, setup.settings)
    return replace(case.problem(WhiteNoise(channels)), effects=setup.effects)


def counted(problem: Problem, slopes: bool) -> tuple[Work, float]:
    """What simulating all runs, with all slopes or none, is counted as, and its CPU seconds."""
    tally, x = problem.model.simulations, np.zeros(len(problem.names))
    before, start = tally.work, time.process_time()
    if slopes:
        linearization_at(problem, x, screen=True)
    else:
        problem.record(x)
    return tally.since(before), time.process_time() - start


def main() -> None:
    """Print a row per study."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("studies", nargs="*", help="study.yaml, folder or published set")
    args = parser.parse_args()
    print(
        ROW.format("study", "runs", "samples", "steps", "CPU us/step", "with slopes", "CPU us/step")
    )
    for given in args.studies or [path.stem for path in described()]:
        try:
            problem = plain_problem(given)
            counted(problem, slopes=False)  # what is built once
            plain, wide = counted(problem, slopes=False), counted(problem, slopes=True)
        except (DiffsimError, OSError, ValueError) as error:
            print(f"{given}: {error}")
            continue
        cells = [f"{work.steps:,}" for work, _ in (plain, wide)]
        each = [f"{1e6 * seconds / work.steps:.2f}" for work, seconds in (plain, wide)]
        samples = sum(len(run.time_s) for run in problem.runs)
        row = (given, str(len(problem.runs)), str(samples))
        print(ROW.format(*row, cells[0], each[0], cells[1], each[1]))


if __name__ == "__main__":
    main()
