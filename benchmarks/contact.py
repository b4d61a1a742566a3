"""Contact: solvers over tolerance (thesis fig. 4-5) and contact share (Table 4.1), and friction.

From the repository's root, on a machine that does nothing else:

python -m benchmarks.contact                   both stages, about 6 minutes
python -m benchmarks.contact --quick           small sizes, under a minute
python -m benchmarks.contact --resume          go on after an interruption

Stages: ``rolling`` (a sphere that rolls on a plane: solvers over tolerance, friction), ``napkin``
(a sheet on a ball: solvers over mesh size and share of nodes in contact). One thread, CPU time.
Written to ``--out``: report.md with tables and figures, results.json with every number, parts/
with the finished pieces.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from benchmarks import contact_napkin, contact_rolling
from benchmarks.contact_plots import draw_figures
from benchmarks.contact_tables import report
from benchmarks.harness import Benchmark
from diffsim.core import interruptible


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Settings of both stages."""

    rolling: contact_rolling.Plan = field(default_factory=contact_rolling.Plan)
    napkin: contact_napkin.Plan = field(default_factory=contact_napkin.Plan)


FULL = Plan()
QUICK = Plan(
    rolling=contact_rolling.Plan(
        spacing=0.02, voxels=6, num_steps=10, rtols=(1e-2, 1e-4, 1e-6), reference_rtol=1e-9
    ),
    napkin=contact_napkin.Plan(cells=(10, 20), samples=2, span=4, friction_cells=10),
)


def collect(results: dict[str, Any], plan: Plan) -> dict[str, Any]:
    """Results of parts, sorted by stage; what has not run is absent."""

    def of(prefix: str) -> list[Any]:
        return [r for name, r in results.items() if name.startswith(prefix)]

    found: dict[str, Any] = {}
    if contact_rolling.REFERENCE in results:
        reference = dict(results[contact_rolling.REFERENCE])
        reference.pop("grad")
        rows = [row for part in of("rolling/rtol") for row in part]
        found["rolling"] = {"reference": reference, "rows": rows}
        found["rolling"]["voxels"] = results.get("voxels/methods")
        found["rolling"]["friction"] = results.get("friction/cases", [])
    if cases := [*of("napkin/"), *of("sliding/")]:
        found["napkin"] = {"cases": cases}
    return found


BENCHMARK = Benchmark(
    name="contact",
    about=__doc__,
    stages={
        "rolling": lambda plan: contact_rolling.parts(plan.rolling),
        "napkin": lambda plan: contact_napkin.parts(plan.napkin),
    },
    collect=collect,
    draw=draw_figures,
    report=report,
    rooms=("soft", "contact", "mesh"),
)


def parse(argv: Sequence[str] | None = None) -> tuple[Plan, argparse.Namespace]:
    """The plan that command-line arguments ask for."""
    parser = BENCHMARK.parser(quick="small sizes, under a minute")
    parser.add_argument("--repetitions", type=int, help="passes per solver of stage rolling")
    args = parser.parse_args(argv)
    plan = QUICK if args.quick else FULL
    if args.repetitions is not None:
        if args.repetitions < 1:
            parser.error(f"--repetitions must be at least 1, got {args.repetitions}")
        plan = replace(plan, rolling=replace(plan.rolling, repetitions=args.repetitions))
    return plan, args


def main(argv: Sequence[str] | None = None) -> int:
    return BENCHMARK.command(*parse(argv))


if __name__ == "__main__":
    with interruptible():
        sys.exit(main())
