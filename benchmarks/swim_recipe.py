"""What each part of the swimmers' recipe does: variants x seeds, each leaving out one part.

python -m benchmarks.swim_recipe --task SharkSwim                    # all variants, resumable
python -m benchmarks.swim_recipe --task SharkSwim --variants recipe sac
python -m benchmarks.swim_recipe --task SharkSwim --report           # the table of what is there
python -m benchmarks.swim_recipe --task SharkSwim --executor processes:5

Runs lie in ``--out``/TASK/VARIANT/seed_N; the ratings of all finished ones are kept in
``--record``/TASK.jsonl, from which ``--report`` makes the table again. Bodies are coarse.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from diffsim.cli.arguments import add_executor
from diffsim.core import interruptible, open_executor
from diffsim.core.files import to_plain, write_text_atomic
from diffsim.core.paths import PROJECT
from diffsim.core.runs import run_each
from diffsim.learn.methods import Options
from diffsim.learn.recipes import recipe
from diffsim.learn.run import Row, is_finished, read_rows
from diffsim.learn.setup import Setup
from rl.trainings import Training

SWIMS = 0.1  # mean reward per step above which a run counts as swimming
RECORD = PROJECT / "rl" / "results" / "recipe"


@dataclass(frozen=True)
class Variant:
    """One way to train."""

    method: str = "gradient"  # as ``diffsim.learn.METHODS`` names it
    # of the method, over the recipe's where it is "gradient"
    options: Options = field(default_factory=dict)
    # task_options, setup: over the recipe's
    task_options: Options = field(default_factory=dict)
    setup: Options = field(default_factory=dict)
    seeds: int = 5  # how many


_SAC = {"passes": 64, "learning_rate": 1e-3}
_SAC_SETUP = {"steps": 7_680, "evaluate_every": 3_840}
VARIANTS: dict[str, Variant] = {
    "recipe": Variant(),
    "no clock": Variant(task_options={"clock": ()}),
    "quiet clock": Variant(setup={"balance_clock": False}),
    "gain 0.01": Variant(setup={"output_gain": 0.01}),
    "no decay": Variant(options={"last_rate": 1.0}),
    "twice the steps": Variant(setup={"steps": 2_400, "evaluate_every": 400}),
    "sac": Variant("sac", _SAC, setup=_SAC_SETUP, seeds=2),
}


def main(argv: Sequence[str] | None = None) -> None:
    """Run what is missing, then print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--task", choices=("SharkSwim", "StarfishSwim"), default="SharkSwim", help="(SharkSwim)")
    add("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS), help="(all)")
    add("--seeds", type=int, nargs="+", help="which (0 to as many as the variant has)")
    add("--out", type=Path, default=Path("runs/recipe"), help="of the runs (runs/recipe)")
    add("--record", type=Path, default=RECORD, help="of the ratings (rl/results/recipe)")
    add("--report", action="store_true", help="run nothing")
    add_executor(parser, "runs")
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    record = args.record / f"{args.task}.jsonl"
    known = _read(record)
    missing = [
        (name, seed)
        for name in ([] if args.report else args.variants)
        for seed in args.seeds or range(VARIANTS[name].seeds)
        if (name, seed) not in known
    ]
    trainings = [_training(args.task, name, seed, args.out) for name, seed in missing]

    def keep(k: int, failure: str | None) -> None:
        (name, seed), folder = missing[k], trainings[k].folder
        if failure is None and is_finished(folder):
            known[name, seed] = read_rows(folder)
            _keep(known, record)
        print(f"{name}, seed {seed}: {failure or known[name, seed][-1]}", flush=True)

    with open_executor(args.executor) as executor:
        run_each(partial(Training.run, show=False), trainings, executor, done=keep)
    print(table(args.task, known))


def _training(task: str, name: str, seed: int, out: Path) -> Training:
    """A run of a variant."""
    variant = VARIANTS[name]
    setup, options = plan(task, variant, seed)
    folder = out / task / name.replace(" ", "_") / f"seed_{seed}"
    return Training(setup, variant.method, options, folder)


def plan(task: str, variant: Variant, seed: int) -> tuple[Setup, dict[str, Any]]:
    """Set-up and options of one run."""
    base = recipe(task)
    options = {"robot": {"coarse": True}, **variant.task_options}
    setup = base.setup_of(task, task_options=options, seed=seed, **variant.setup)
    if variant.method != "gradient":
        return setup, dict(variant.options)
    return setup, dataclasses.asdict(base.gradient_options(**variant.options))


def table(task: str, runs: dict[tuple[str, int], list[Row]]) -> str:
    """Final ratings of all runs, in Markdown."""
    lines = [
        f"| {task}, coarse | steps | CPU s | swim at half of the steps | swim at the end | "
        "median | final rewards |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in VARIANTS:
        mine = [rows for (variant, _), rows in sorted(runs.items()) if variant == name]
        if not mine:
            continue
        finals = [float(rows[-1]["reward"]) for rows in mine]
        lines.append(
            f"| {name} | {mine[0][-1]['steps']:,} | "
            f"{np.median([rows[-1]['seconds'] for rows in mine]):.0f} | "
            f"{sum(_halfway(rows) > SWIMS for rows in mine)} of {len(mine)} | "
            f"{sum(f > SWIMS for f in finals)} of {len(mine)} | {np.median(finals):.2f} | "
            f"{', '.join(f'{f:.2f}' for f in finals)} |"
        )
    return "\n".join(lines)


def _halfway(rows: list[Row]) -> float:
    """Rating at half of the budget."""
    half = rows[-1]["steps"] / 2
    return float(next(row["reward"] for row in rows if row["steps"] >= half))


def _read(record: Path) -> dict[tuple[str, int], list[Row]]:
    runs: dict[tuple[str, int], list[Row]] = {}
    for row in read_rows(record):
        runs.setdefault((row.pop("variant"), row.pop("seed")), []).append(row)
    return runs


def _keep(runs: dict[tuple[str, int], list[Row]], record: Path) -> None:
    lines = [
        json.dumps(to_plain({"variant": name, "seed": seed} | row), allow_nan=False)
        for (name, seed), rows in sorted(runs.items())
        for row in rows
    ]
    record.parent.mkdir(parents=True, exist_ok=True)
    write_text_atomic(record, "\n".join(lines) + "\n")


if __name__ == "__main__":
    with interruptible("the same command goes on"):
        main()
