"""Stokes flow: seconds per call of the six devices (thesis Table 4.5), and scaling with the grid.

From the repository's root, on a machine that does nothing else:

python -m benchmarks.stokes                    all stages, about 20 minutes on two cores
python -m benchmarks.stokes --quick            coarse grids, under a minute
python -m benchmarks.stokes --resume           go on after an interruption
python -m benchmarks.stokes --stages devices --devices amplifier twister --threads 2

Stages: ``devices`` (loss, and loss with gradient, on the thesis's grids; 1 and 2 threads),
``scaling`` (a bent pipe, direct solver, time and memory over unknowns), ``iterative`` (the same
with the iterative solver). Every call has a geometry of its own, as in a
search for designs: nothing is kept between calls but symbolic analyses of equal patterns. Each row
is measured in a process of its own. Accuracy: benchmarks.stokes_accuracy. Written to ``--out``:
report.md with tables and figure, results.json with every number, parts/ with the finished pieces.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from benchmarks import stokes_worker
from benchmarks.harness import Benchmark, Part
from benchmarks.processes import run_child
from benchmarks.stokes_tables import draw_figures, report
from diffsim.core import interruptible
from diffsim.core.executors import num_processors
from diffsim.stokes.devices import DEVICES
from labs.machine import available_memory

BYTES_PER_NODE = 40_000
"""Peak memory of the direct path per node at 64 x 64 x 32 cells, with a margin."""


@dataclass(frozen=True, kw_only=True)
class DevicePlan:
    """Stage ``devices``."""

    # devices; the twister is measured with both kinds of wall
    names: tuple[str, ...] = tuple(DEVICES)
    resolution: float = 1.0  # factor on the thesis's cells per axis
    threads: tuple[int, ...] = (1, 2)  # numbers of worker threads, each on as many cores
    repetitions: int = 3  # calls of either kind
    timeout: float = 3600.0  # for all calls of a row [s]


@dataclass(frozen=True, kw_only=True)
class ScalingPlan:
    """Stages ``scaling`` and ``iterative``: n x n x n/2 cells for every n of ``cells``."""

    cells: tuple[int, ...] = (16, 24, 32, 48, 64)
    threads: int = 2
    repetitions: int = 3
    timeout: float = 3600.0


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Settings of all stages."""

    devices: DevicePlan = field(default_factory=DevicePlan)
    scaling: ScalingPlan = field(default_factory=ScalingPlan)
    iterative: ScalingPlan = field(
        default_factory=lambda: ScalingPlan(cells=(16, 32, 64, 128), repetitions=1)
    )


FULL = Plan()
QUICK = Plan(
    devices=DevicePlan(resolution=0.25, repetitions=2, timeout=300.0),
    scaling=ScalingPlan(cells=(8, 12, 16, 24), timeout=300.0),
    iterative=ScalingPlan(cells=(8, 16), repetitions=1, timeout=300.0),
)


def device_parts(plan: DevicePlan) -> list[Part]:
    """One part per device, kind of wall and number of threads."""
    found = []
    for name in plan.names:
        walls = ("no_separation", "no_slip") if name == "twister" else (None,)
        for wall in walls:
            for threads in plan.threads:
                settings = {
                    **asdict(plan),
                    "name": name,
                    "options": {} if wall is None else {"wall": wall},
                    "threads": threads,
                    "seed": 0,
                }
                del settings["names"]
                label = f"devices/{name}{f', {wall}' if wall else ''}, {threads} threads"
                found.append(Part(label, settings, in_child(stokes_worker.device, settings)))
    return found


def scaling_parts(plan: ScalingPlan, stage: str, solver: str) -> list[Part]:
    """One part per grid."""
    found = []
    for cells in sorted(plan.cells):
        settings = {**asdict(plan), "cells": cells, "solver": solver}
        work = in_child(stokes_worker.scaling, settings)
        if solver == "direct" and 0.5 * cells**3 * BYTES_PER_NODE > available_memory():
            work = skip(settings, "not enough memory")
        found.append(Part(f"{stage}/{cells} cells", settings, work))
    return found


Work = Callable[[dict[str, Any], Callable[[str], None]], Any]


def skip(settings: dict[str, Any], reason: str) -> Work:
    return lambda _results, _say: {**settings, "failed": reason}


def in_child(task: Callable[[dict[str, Any]], Any], settings: dict[str, Any]) -> Work:
    """The part's work in a process of its own; its settings go into the row."""
    return lambda _results, _say: {
        **settings,
        **run_child(task, settings, timeout=settings["timeout"]),
    }


def collect(results: dict[str, Any], _plan: Plan) -> dict[str, Any]:
    """Rows by stage; what has not run is absent."""
    found: dict[str, Any] = {}
    for name, row in results.items():
        found.setdefault(name.split("/")[0], []).append(row)
    return found


BENCHMARK = Benchmark(
    name="stokes",
    about=__doc__,
    stages={
        "devices": lambda plan: device_parts(plan.devices),
        "scaling": lambda plan: scaling_parts(plan.scaling, "scaling", "direct"),
        "iterative": lambda plan: scaling_parts(plan.iterative, "iterative", "iterative"),
    },
    collect=collect,
    draw=draw_figures,
    report=report,
    rooms=("stokes",),
)


def parse(argv: Sequence[str] | None = None) -> tuple[Plan, argparse.Namespace]:
    """The plan that command-line arguments ask for."""
    parser = BENCHMARK.parser(quick="coarse grids, under a minute")
    parser.add_argument("--devices", nargs="+", choices=list(DEVICES), help="default all")
    parser.add_argument("--threads", type=int, nargs="+", help="scaling takes the largest")
    parser.add_argument("--repetitions", type=int, help="calls of either kind")
    parser.add_argument("--max-cells", type=int, help="largest n of stages scaling and iterative")
    args = parser.parse_args(argv)
    plan = QUICK if args.quick else FULL
    threads = tuple(args.threads or [t for t in plan.devices.threads if t <= num_processors()])
    if min(threads) < 1 or max(threads) > num_processors():
        parser.error(
            f"--threads must lie between 1 and {num_processors()}, the cores of this process"
        )
    if args.repetitions is not None and args.repetitions < 1:
        parser.error(f"--repetitions must be at least 1, got {args.repetitions}")

    def changed(stage: ScalingPlan) -> ScalingPlan:
        cells = tuple(n for n in stage.cells if n <= (args.max_cells or n))
        count = args.repetitions or stage.repetitions
        return replace(stage, cells=cells, threads=max(threads), repetitions=count)

    return replace(
        plan,
        devices=replace(
            plan.devices,
            names=tuple(args.devices or plan.devices.names),
            threads=threads,
            repetitions=args.repetitions or plan.devices.repetitions,
        ),
        scaling=changed(plan.scaling),
        iterative=changed(plan.iterative),
    ), args


def main(argv: Sequence[str] | None = None) -> int:
    return BENCHMARK.command(*parse(argv))


if __name__ == "__main__":
    with interruptible():
        sys.exit(main())
