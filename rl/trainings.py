"""Runs of a comparison, and the small search for the options of a method."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.core.files import to_plain, write_json_atomic, write_text_atomic
from diffsim.core.progress import show_progress
from diffsim.core.runs import run_each
from diffsim.learn.gradient import BadGradients
from diffsim.learn.methods import Options, make_learner
from diffsim.learn.run import is_finished, read_rows, train
from diffsim.learn.setup import Setup, broke_down

FAILURE = "failure.txt"  # why a run ended before its budget
TUNING_SEED = 100  # of no compared run


@dataclass(frozen=True)
class Plan:
    """One task of a comparison."""

    setup: Setup  # task; seed and budget are set per run
    steps: Mapping[str, int]  # budget of simulation steps of a compared run, by method
    tuning_steps: Mapping[str, int]  # the same of a candidate's run
    # options among which the search chooses, by method; as many for each. Methods without
    # candidates are not compared.
    candidates: Mapping[str, Sequence[Options]]
    seeds: Sequence[int] = (0, 1, 2, 3, 4)  # seeds of the compared runs
    ratings: int = 10  # per run, spread evenly over its budget
    # arguments of ``gradient_quality``, where it differs from the defaults
    quality: Options = field(default_factory=dict)

    def run_setup(self, method: str, seed: int) -> Setup:
        """Setup of one run; the search's are those of ``TUNING_SEED``."""
        steps = (self.tuning_steps if seed == TUNING_SEED else self.steps)[method]
        every = max(1, steps // self.ratings)
        return dataclasses.replace(self.setup, seed=seed, steps=steps, evaluate_every=every)


@dataclass(frozen=True)
class Training:
    """One run of a comparison or of a search."""

    setup: Setup  # task, seed and budget
    method: str  # name of the method
    options: Options  # options of the method
    folder: Path  # folder of the run; on a cluster one that all machines see

    def run(self, *, show: bool = True) -> str | None:
        """See ``train_once``."""
        return train_once(self.setup, self.method, self.options, self.folder, show=show)


def train_all(
    trainings: Sequence[Training], executor: Executor | None = None, *, show: bool = True
) -> list[str | None]:
    """Run or continue what is not finished, side by side where there is an executor.

    Each run keeps its own checkpoints: one that lost its worker goes on from its last.
    """
    alone = executor is None
    with show_progress(total=len(trainings), unit="run", disable=alone or not show) as bar:
        run = partial(Training.run, show=show and alone)
        return run_each(run, trainings, executor, done=lambda *_: bar.update())


def searched(plan: Plan, method: str, folder: Path) -> list[Training]:
    """The runs of a search, one per candidate; none where nothing is to be chosen or run."""
    candidates = plan.candidates[method]
    record = folder / f"tuning_{method}.json"
    if len(candidates) == 1 or _recorded_best(plan, method, record) is not None:
        return []
    setup = plan.run_setup(method, TUNING_SEED)
    runs = folder / "tuning" / method
    return [
        Training(setup, method, options, runs / f"candidate_{k}")
        for k, options in enumerate(candidates)
    ]


def tune(
    plan: Plan, method: str, folder: Path, executor: Executor | None = None, *, show: bool = True
) -> Options:
    """The best of a method's candidates after one run each; every result is written down.

    Best by the mean of the last two ratings of one seed that no compared run uses. Candidates that
    ran already are not run again, nor is a search whose record holds the same candidates on the
    same budget. A single candidate is taken as it is.

    Args:
        plan: Task and candidates.
        method: Name of the method.
        folder: Folder of runs; the record is ``tuning_METHOD.json``.
        executor: Executor of the candidates; None: one after another.
        show: Whether to draw progress bars.
    """
    candidates = plan.candidates[method]
    if len(candidates) == 1:
        return candidates[0]
    path = folder / f"tuning_{method}.json"
    if (known := _recorded_best(plan, method, path)) is not None:
        return candidates[known]
    record: list[dict[str, Any]] = []
    trainings = searched(plan, method, folder)
    errors = train_all(trainings, executor, show=show)
    for training, error in zip(trainings, errors, strict=True):
        options, rows = training.options, read_rows(training.folder)
        score = float(np.mean([r["reward"] for r in rows[-2:]])) if rows else float("nan")
        used = {key: rows[-1][key] for key in ("steps", "seconds")} if rows else {}
        record.append({"options": dict(options), "score": score, "error": error} | used)
    scores = [r["score"] if r["error"] is None else -np.inf for r in record]
    best = int(np.nanargmax(scores))
    write_json_atomic(
        path, {"method": method, "seed": TUNING_SEED, "candidates": record, "best": best}
    )
    return candidates[best]


def _recorded_best(plan: Plan, method: str, path: Path) -> int | None:
    """What an earlier search of the same candidates chose; None where it asked for something else.

    The runs of a search are large and thrown away, its record is kept with the results.
    """
    if not path.exists():
        return None
    kept = json.loads(path.read_text())
    asked = [to_plain(dict(options)) for options in plan.candidates[method]]
    if [row["options"] for row in kept["candidates"]] != asked:
        return None
    budget = plan.tuning_steps[method]
    complete = all(row["error"] or row.get("steps", 0) >= budget for row in kept["candidates"])
    return int(kept["best"]) if complete else None


def train_once(
    setup: Setup, method: str, options: Options, folder: Path, *, show: bool = True
) -> str | None:
    """Run or continue, unless the run is finished or failed before.

    Returns:
        None, or what a failed run died of: a failure is a result and is kept.
    """
    failure = folder / FAILURE
    if failure.exists():
        return failure.read_text()
    if is_finished(folder):
        return None
    try:
        train(setup, make_learner(method, setup, options), folder, resume=True, show=show)
    except (ArithmeticError, RuntimeError, ValueError) as error:
        if not (isinstance(error, BadGradients) or broke_down(error)):
            raise  # a mistake, not a result
        write_text_atomic(failure, f"{type(error).__name__}: {error}")
        return failure.read_text()
    return None
