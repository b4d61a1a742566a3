"""Methods x seeds on one task: run what is missing, sum up, tabulate."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.core.files import to_plain, write_json_atomic, write_text_atomic
from diffsim.learn.checkpoint import CHECKPOINT
from diffsim.learn.methods import METHODS
from diffsim.learn.run import Row, load_controller, read_rows
from diffsim.learn.setup import Setup, evaluate
from rl.quality import gradient_quality
from rl.reward_statistics import Scale, bootstrap_interval, first_reach, interquartile_mean
from rl.trainings import FAILURE, Plan, Training, searched, train_all, tune

UNTRAINED = 16  # networks that tell the zero of rewards
AXES = {
    "steps": "simulation steps",
    "seconds": "CPU seconds",
    "forward_equivalents": "forward-equivalents",
}
Runs = dict[str, dict[int, list[Row]]]
RECORD = "ratings.jsonl"  # all ratings of a task in one file, which stands in for its runs
HORIZONS = (5, 10, 25, 50, 100, 200)  # of gradient quality
GOAL = 0.9  # of the final gradient result


def run_all(
    plan: Plan,
    folder: Path,
    *,
    methods: Sequence[str] = METHODS,
    seeds: Sequence[int] | None = None,
    executor: Executor | None = None,
    show: bool = True,
) -> None:
    """Tune all methods, then train; finished runs are not repeated, unfinished ones continue.

    Args:
        plan: Task, budgets, candidates.
        folder: Folder of the task's results.
        methods, seeds: Some of them only; None: all. Methods that are not in the plan are passed
            over.
        executor: Executor of the runs (``core.open_executor``); None: one after another.
        show: Whether to draw progress bars.
    """
    known = [method for method in methods if method in plan.candidates]
    if executor is not None:  # the candidates of all methods at once; alone, one search at a time
        candidates = [run for method in known for run in searched(plan, method, folder)]
        train_all(candidates, executor, show=show)
    options = {method: tune(plan, method, folder, show=show) for method in known}
    trainings = [
        Training(
            plan.run_setup(method, seed), method, options[method], folder / method / f"seed_{seed}"
        )
        for seed in (plan.seeds if seeds is None else seeds)
        for method in known
    ]
    train_all(trainings, executor, show=show)


def collect(plan: Plan, folder: Path) -> Runs:
    """Ratings of the runs that ended, failed ones too, by method and seed.

    Runs that are not in the folder come from the record that ``keep_record`` left, so that methods
    and seeds can be added to a comparison whose runs are gone.
    """
    found: Runs = {}
    if (folder / RECORD).exists():
        for row in read_rows(folder / RECORD):
            method, seed = row.pop("method"), row.pop("seed")
            found.setdefault(method, {}).setdefault(seed, []).append(row)
    for method in METHODS:
        for path in sorted((folder / method).glob("seed_*")):
            rows = read_rows(path)
            if rows and (rows[-1]["finished"] or (path / FAILURE).exists()):
                found.setdefault(method, {})[int(path.name.removeprefix("seed_"))] = rows
    found = {method: dict(sorted(found[method].items())) for method in METHODS if method in found}
    extra = plan.setup.step_cost - 1.0
    for row in (r for by_seed in found.values() for rows in by_seed.values() for r in rows):
        row["forward_equivalents"] = row["steps"] + extra * row["gradient_steps"]
    return found


def keep_record(runs: Runs, folder: Path) -> None:
    """Write all ratings into one small file, from which figure and tables can be made again."""
    lines = [
        json.dumps(to_plain({"method": method, "seed": seed} | row), allow_nan=False)
        for method, by_seed in runs.items()
        for seed, rows in by_seed.items()
        for row in rows
    ]
    write_text_atomic(folder / RECORD, "\n".join(lines) + "\n")


def scale_of(plan: Plan, folder: Path, runs: Runs) -> Scale:
    """Zero and unit of reward; the untrained networks are rated once and remembered."""
    path = folder / "untrained.json"
    if not path.exists():
        write_json_atomic(path, {"reward": untrained_reward(plan.setup)})
    zero = float(json.loads(path.read_text())["reward"])
    finals = np.array([rows[-1]["reward"] for rows in runs["gradient"].values()])
    return Scale(zero, float(interquartile_mean(finals)))


def untrained_reward(setup: Setup) -> float:
    """Mean rating of untrained networks: the zero of normalized rewards (thesis Fig. 4-17)."""
    episodes = setup.evaluation_episodes
    task = setup.make_task()
    ratings = [
        evaluate(task, dataclasses.replace(setup, seed=1000 + k).first_controller(task), episodes)
        for k in range(UNTRAINED)
    ]
    return float(np.nanmean(ratings))


def summarize(runs: Runs, scale: Scale) -> list[Row]:
    """Per method: final normalized reward, and where runs reach 90 % of the gradient's.

    Also where the gradient's runs first reach what the method ends with (medians).
    """
    out = []
    goal = scale.zero + GOAL * (scale.one - scale.zero)
    for method, by_seed in runs.items():
        finals = scale(np.array([_final(rows) for rows in by_seed.values()]))
        low, high = bootstrap_interval(finals)
        row: Row = {
            "method": method,
            "runs": len(by_seed),
            "finished": sum(bool(rows[-1]["finished"]) for rows in by_seed.values()),
            "final": float(interquartile_mean(finals)),
            "low": float(low),
            "high": float(high),
            "final_reward": float(
                interquartile_mean(np.array([_final(rows) for rows in by_seed.values()]))
            ),
            "budget_steps": max(rows[-1]["steps"] for rows in by_seed.values()),
            "budget_seconds": float(np.median([rows[-1]["seconds"] for rows in by_seed.values()])),
        }
        for axis in AXES:
            places = [
                first_reach(rows, axis, row["final_reward"])
                for rows in runs.get("gradient", {}).values()
            ]
            row[f"gradient_{axis}_to_final"] = float(np.median(places)) if places else math.nan
            places = [first_reach(rows, axis, goal) for rows in by_seed.values()]
            row[f"{axis}_to_goal"] = float(np.median(places))
            row["reached"] = sum(math.isfinite(p) for p in places)
        out.append(row)
    return out


def quality_of(plan: Plan, folder: Path) -> dict[str, list[Row]]:
    """Gradient quality at the first controller and at a trained one; kept in ``quality.json``."""
    path = folder / "quality.json"
    if path.exists():
        kept: dict[str, list[Row]] = json.loads(path.read_text())
        return kept
    task, seed = plan.setup.make_task(), plan.seeds[0]
    controller = dataclasses.replace(plan.setup, seed=seed).first_controller(task)
    horizons = [h for h in HORIZONS if h <= task.max_steps]
    options = {"horizons": horizons} | dict(plan.quality)
    out = {"untrained": gradient_quality(task, controller, **options)}
    run = folder / "gradient" / f"seed_{seed}"
    if (run / CHECKPOINT).exists():
        load_controller(run, controller)
        out["trained"] = gradient_quality(task, controller, **options)
    write_json_atomic(path, out)
    return out


def table(task: str, summary: list[Row]) -> str:
    """The summary in Markdown."""
    lines = [
        f"| {task} | final reward (IQM, 95 %) | reached 90 % | steps to 90 % | CPU s to 90 % | "
        "forward-equivalents to 90 % | budget: steps, CPU s | "
        "gradient is as good after: steps, CPU s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in summary:
        cells = [_place(r[f"{axis}_to_goal"]) for axis in AXES]
        as_far = [_place(r[f"gradient_{axis}_to_final"]) for axis in ("steps", "seconds")]
        missing = r["runs"] - r["finished"]
        failures = f" ({missing} failed)" if missing else ""
        lines.append(
            f"| {r['method']} | {r['final']:.2f} ({r['low']:.2f} to {r['high']:.2f}) | "
            f"{r['reached']} of {r['runs']}{failures} | {' | '.join(cells)} | "
            f"{r['budget_steps']:,}, {r['budget_seconds']:.0f} | {', '.join(as_far)} |"
        )
    return "\n".join(lines)


def _place(value: float) -> str:
    """A place on an axis; a dash where it is never reached."""
    if not math.isfinite(value):
        return "-"
    return f"{value:,.3g}" if value < 100 else f"{value:,.0f}"


def quality_table(task: str, quality: dict[str, list[Row]]) -> str:
    """Gradient quality in Markdown."""
    lines = [
        f"| {task} | horizon | cosine | norm ratio | gradient norm | exploding | in contact |",
        "|---|---|---|---|---|---|---|",
    ]
    for where, rows in quality.items():
        for r in rows:
            numbers: list[Any] = [r["cosine"], r["norm_ratio"], r["norm"]]
            cells = " | ".join("-" if n is None else f"{n:.2g}" for n in numbers)
            lines.append(
                f"| {where} | {r['horizon']} | {cells} | {r['explosion_rate']:.0%} | "
                f"{r['contact_share']:.0%} |"
            )
    return "\n".join(lines)


def _final(rows: list[Row]) -> float:
    reward = float(rows[-1]["reward"])
    return reward if math.isfinite(reward) else float(rows[0]["reward"])
