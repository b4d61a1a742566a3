"""Soft bodies: time, accuracy, scaling, memory and smoothness (thesis 4.1.5, figs. 4-3 and 4-4).

From the repository's root, on a machine that does nothing else:

python -m benchmarks.soft                     all four stages, about 15 minutes on two cores
python -m benchmarks.soft --quick             small sizes, under two minutes
python -m benchmarks.soft --resume            go on after an interruption
python -m benchmarks.soft --stages scaling --million --threads 2

Stages: ``cantilever`` (methods over tolerance and threads), ``scaling`` (over mesh size),
``explicit`` (against explicit steps), ``accuracy`` (weights of the constant matrix). Written to
``--out``: report.md with tables and figures, results.json with every number, parts/ with the
finished pieces.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from benchmarks import soft_accuracy, soft_cantilever, soft_explicit, soft_scaling
from benchmarks.harness import Benchmark
from benchmarks.soft_plots import draw_figures
from benchmarks.soft_tables import report
from diffsim.core import interruptible
from diffsim.core.executors import num_processors

MILLION_WIDTH = 43  # 4 w x w x w cells: 1,004,784 DoF


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Settings of all stages."""

    cantilever: soft_cantilever.Plan = field(default_factory=soft_cantilever.Plan)
    scaling: soft_scaling.Plan = field(default_factory=soft_scaling.Plan)
    explicit: soft_explicit.Plan = field(default_factory=soft_explicit.Plan)
    accuracy: soft_accuracy.Plan = field(default_factory=soft_accuracy.Plan)


FULL = Plan()
QUICK = Plan(
    cantilever=soft_cantilever.Plan(
        cells=(16, 4, 4), num_steps=10, rtols=(1e-2, 1e-4, 1e-6), repetitions=2
    ),
    scaling=soft_scaling.Plan(widths=(4, 8), seconds=0.3, pass_limit=5.0),
    explicit=soft_explicit.Plan(directions=4, samples=9, seconds=0.5),
    accuracy=soft_accuracy.Plan(
        cells=(8, 2, 2),
        num_steps=3,
        poissons_ratios=(0.3, 0.45),
        volume_weights=("thesis",),
        shares=(0.0, 0.1, 0.5, 1.0),
    ),
)


def collect(results: dict[str, Any], plan: Plan) -> dict[str, Any]:
    """Results of parts, sorted by stage; stages that have not run are absent."""

    def of(prefix: str) -> list[Any]:
        return [r for name, r in results.items() if name.startswith(prefix)]

    found: dict[str, Any] = {}
    if soft_cantilever.REFERENCE in results:
        reference = dict(results[soft_cantilever.REFERENCE])
        reference.pop("grad")
        rows = [row for part in of("cantilever/") if isinstance(part, list) for row in part]
        found["cantilever"] = {"reference": reference, "rows": rows}
    if scaling := of("scaling/"):
        operations = [r for r in scaling if r.get("task") == "operations"]
        found["scaling"] = {
            "operations": operations,
            "rows": [r for r in scaling if "method" in r],
            "exponents": soft_scaling.exponents(results, plan.scaling),
        }
    if soft_explicit.STABILITY in results:
        found["explicit"] = {
            "stable_step": results[soft_explicit.STABILITY],
            "landscapes": of("explicit/landscape"),
            "costs": of("explicit/memory"),
        }
    if accuracy := of("accuracy/"):
        found["accuracy"] = {"rows": [row for part in accuracy for row in part]}
    return found


BENCHMARK = Benchmark(
    name="soft",
    about=__doc__,
    stages={
        "cantilever": lambda plan: soft_cantilever.parts(plan.cantilever),
        "scaling": lambda plan: soft_scaling.parts(plan.scaling),
        "explicit": lambda plan: soft_explicit.parts(plan.explicit),
        "accuracy": lambda plan: soft_accuracy.parts(plan.accuracy),
    },
    collect=collect,
    draw=draw_figures,
    report=report,
    rooms=("soft", "contact", "mesh"),
)


def parse(argv: Sequence[str] | None = None) -> tuple[Plan, argparse.Namespace]:
    """The plan that command-line arguments ask for."""
    parser = BENCHMARK.parser(quick="small sizes, under two minutes")
    parser.add_argument(
        "--threads", type=int, nargs="+", help="thread counts; scaling takes the first"
    )
    parser.add_argument("--repetitions", type=int, help="passes per method of stage cantilever")
    parser.add_argument("--max-dof", type=int, help="largest mesh of stage scaling")
    parser.add_argument("--million", action="store_true", help="scaling up to a million DoF")
    args = parser.parse_args(argv)
    plan = QUICK if args.quick else FULL
    threads = args.threads or [t for t in plan.cantilever.threads if t <= num_processors()]
    if min(threads) < 1 or max(threads) > num_processors():
        parser.error(
            f"--threads must lie between 1 and {num_processors()}, the cores of this process"
        )
    widths = [*plan.scaling.widths, *([MILLION_WIDTH] if args.million else [])]
    if args.max_dof:
        widths = [w for w in widths if soft_scaling.num_dof(w) <= args.max_dof]
    return replace(
        plan,
        cantilever=replace(
            plan.cantilever,
            threads=tuple(threads),
            repetitions=args.repetitions or plan.cantilever.repetitions,
        ),
        scaling=replace(plan.scaling, widths=tuple(widths), threads=threads[0]),
    ), args


def main(argv: Sequence[str] | None = None) -> int:
    return BENCHMARK.command(*parse(argv))


if __name__ == "__main__":
    with interruptible():
        sys.exit(main())
