"""Airframe and controller of a hexarotor together: by gradient and by CMA-ES at equal cost.

    python -m benchmarks.hexarotor --out runs/hexarotor --executor processes:2
    python -m benchmarks.hexarotor --quick

The task is ``diffsim.copter.waypoints``: 15 numbers of the airframe (after arXiv 2510.04724), 8
weights of an LQR, and in a second round 72 more, every entry of its gain. Each run has the same CPU
seconds, the same random start per seed, and starts anew from further random points when a search
ends. Baseline: the flat regular hexarotor, its controller alone improved by gradient. Every run is
kept when it ends.
"""

from __future__ import annotations

import argparse
import contextlib
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim import optim
from diffsim.cli.arguments import add_executor
from diffsim.copter.waypoints import WaypointTask
from diffsim.core import interruptible, open_executor, run_kept
from diffsim.core.errors import DiffsimError
from diffsim.core.files import write_json_atomic, write_text_atomic
from diffsim.core.optional import ask_for
from labs.machine import machine

Array = NDArray[np.float64]
FAILED = 1e4  # loss where a design does not hover or cannot be controlled
FAILURES = (DiffsimError, ValueError, ArithmeticError)
METHODS = ("gradient", "cma", "controller only")
SPREAD = 0.3  # of CMA-ES at its start, as its manual advises for bounds of 0 and 1
DESCENT = 400  # evaluations of one descent
ON_FILE = 60  # points of a curve


class Spent(Exception):
    """The CPU seconds of a run are used up."""


class Counted:
    """An objective that keeps the best it has seen against CPU seconds."""

    def __init__(self, task: WaypointTask, budget: float):
        self.task, self.budget, self.began = task, budget, time.process_time()
        self.calls, self.best, self.x = 0, np.inf, task.random_start(0)
        self.curve: list[tuple[float, float]] = []

    def value(self, x: Array) -> float:
        """The loss; ``FAILED`` where there is none."""
        return self._kept(x, lambda: self.task.value(x))

    def value_and_gradient(self, x: Array) -> tuple[float, Array]:
        """The loss and its gradient."""
        found = self.task.value_and_gradient(x)
        self._kept(x, lambda: found[0])
        return found

    def _kept(self, x: Array, loss: Callable[[], float]) -> float:
        spent = time.process_time() - self.began
        if spent > self.budget:
            raise Spent
        self.calls += 1
        try:
            value = loss()
        except FAILURES:
            return FAILED
        if value < self.best:
            self.best, self.x = value, np.array(x)
            self.curve.append((time.process_time() - self.began, value))
        return value


def by_gradient(objective: Counted, starts: Callable[[int], Array], bounds: Any) -> None:
    """L-BFGS from one start after another until the time is up."""
    options = optim.Options(
        budget=optim.Budget(DESCENT),
        tolerances=optim.Tolerances(ftol=1e-5),
        wall=optim.Wall(failures=FAILURES),
    )
    for k in range(10_000):
        try:
            optim.minimize(objective.value_and_gradient, starts(k), bounds, options)
        except FAILURES:
            continue  # this start cannot be flown


def by_cma(objective: Counted, starts: Callable[[int], Array], bounds: Any) -> None:
    """CMA-ES, started anew with twice the population when it ends (IPOP, Auger and Hansen 2005)."""
    import cma

    for k in range(10_000):
        options = {"bounds": [0.0, 1.0], "seed": k + 1, "verbose": -9}
        size = int((4 + 3 * np.log(len(starts(k)))) * 2**k)
        search = cma.CMAEvolutionStrategy(starts(k), SPREAD, {**options, "popsize": size})
        while not search.stop():
            points = search.ask()
            search.tell(points, [objective.value(np.clip(x, 0.0, 1.0)) for x in points])


def run(item: Mapping[str, Any]) -> dict[str, Any]:
    """One method, one seed.

    Args:
        item: method, seed, cpu_s, free_gain.
    """
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # random designs hover at the edge of their rank
    task = WaypointTask(free_gain=item["free_gain"])
    objective = Counted(task, item["cpu_s"])
    lower, upper = task.bounds

    def starts(k: int) -> Array:
        return task.random_start(1000 * item["seed"] + k)

    if item["method"] == "controller only":
        fixed = task.start.numpy()[: task.num_design]
        lower[: task.num_design] = upper[: task.num_design] = fixed
        free = starts

        def starts(k: int) -> Array:
            return np.concatenate([fixed, free(k)[task.num_design :]])

    search = by_cma if item["method"] == "cma" else by_gradient
    with contextlib.suppress(Spent):
        search(objective, starts, (lower, upper))
    thin = np.unique(np.linspace(0, len(objective.curve) - 1, ON_FILE).round().astype(int))
    return {
        **item,
        "loss": objective.best,
        "unseen": replace(task, seed=1, num_episodes=48).value(objective.x),
        "calls": objective.calls,
        "gap_mm": 1e3 * task.smallest_gap(objective.x),
        "x": objective.x.tolist(),
        "curve": [objective.curve[i] for i in thin],
    }


def items(seeds: Sequence[int], cpu_s: float) -> dict[str, dict[str, Any]]:
    """All runs by name."""
    out = {}
    for free in (False, True):
        for method in METHODS[: 2 if free else 3]:  # a controller alone: of weights
            for seed in seeds:
                name = f"{method.replace(' ', '_')}_{'gain' if free else 'weights'}_{seed}"
                out[name] = {"method": method, "seed": seed, "cpu_s": cpu_s, "free_gain": free}
    return out


def table(results: Mapping[str, Mapping[str, Any]]) -> str:
    """Final losses in Markdown."""
    task = WaypointTask()
    lines = [
        f"Flat regular hexarotor, middle weights: {task.value(task.start.numpy()):.3f} m.\n",
        "| method | numbers | mean distance [m], by seed | median | on 48 unseen flights | calls "
        "| smallest gap [mm] | CPU s to the median of CMA-ES |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for free in (False, True):
        mine = [r for r in results.values() if r["free_gain"] == free]
        rivals = [r["loss"] for r in mine if r["method"] == "cma"]
        goal = float(np.median(rivals)) if rivals else np.nan
        for method in METHODS:
            rows = [r for r in mine if r["method"] == method]
            if not rows:
                continue
            losses = [r["loss"] for r in rows]
            number = len(rows[0]["x"]) - (task.num_design if method == "controller only" else 0)
            reached = [_reached(r["curve"], goal) for r in rows]
            lines.append(
                f"| {method} | {number} | {', '.join(f'{v:.3f}' for v in losses)} | "
                f"{np.median(losses):.3f} | {np.median([r['unseen'] for r in rows]):.3f} | "
                f"{np.median([r['calls'] for r in rows]):,.0f} | "
                f"{min(r['gap_mm'] for r in rows):.2f} | {_seconds(float(np.median(reached)))} |"
            )
    return "\n".join(lines)


def _reached(curve: Sequence[Sequence[float]], goal: float) -> float:
    return next((second for second, value in curve if value <= goal), np.inf)


def _seconds(value: float) -> str:
    return f"{value:.1f}" if np.isfinite(value) else "-"


def main(argv: Sequence[str] | None = None) -> str:
    """Run what is missing; write and print the table, draw the curves."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--seeds", type=int, nargs="+", default=[0, 1, 2], help="(0 1 2)")
    add("--cpu-s", type=float, default=15.0, help="CPU seconds of each run (15)")
    add("--out", type=Path, default=Path("runs/hexarotor"), help="(runs/hexarotor)")
    add("--images", type=Path, help="folder of the figure (that of results)")
    add("--quick", action="store_true", help="one seed of one second each")
    add_executor(parser, "runs")
    args = parser.parse_args(argv)
    ask_for(["cma", "matplotlib"], purpose="the comparison with CMA-ES and its figure")
    asked = items([0], 1.0) if args.quick else items(args.seeds, args.cpu_s)
    with open_executor(args.executor) as executor:
        results = run_kept(
            run, asked, args.out, executor, done=lambda n, r: print(f"{n}: {r['loss']:.3f}")
        )
    text = table(results)
    print(text)
    write_text_atomic(args.out / "hexarotor.md", text + "\n")
    write_json_atomic(args.out / "machine.json", machine())
    from benchmarks.hexarotor_plots import draw

    draw(results, (args.images or args.out) / "copter_hexarotor.png")
    return text


if __name__ == "__main__":
    with interruptible("the same command goes on"):
        main()
