"""A benchmark whose parts are slow and always the same, to be killed by tests."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.harness import Benchmark, Part


@dataclass(frozen=True)
class Plan:
    """Number of parts."""

    sums: int = 12


def _parts(plan: Plan) -> list[Part]:
    def part(k: int) -> Part:
        def compute(results: dict[str, Any], say: Any) -> Any:
            time.sleep(0.1)  # the moments at which it may be killed
            before = results.get(f"sums/{k - 1}", 0.0)
            return before + float(np.random.default_rng(k).normal(size=100).sum())

        return Part(f"sums/{k}", {"k": k}, compute)

    return [part(k) for k in range(plan.sums)]


BENCHMARK = Benchmark(
    name="interrupted",
    about=__doc__,
    stages={"sums": _parts},
    collect=lambda results, plan: {"sums": results},
    report=lambda results, figures: f"{len(results['sums'])} parts\n",
    rooms=("core",),
)


def main(argv: Sequence[str]) -> int:
    """As a benchmark's command line."""
    return BENCHMARK.command(Plan(), BENCHMARK.parser("nothing").parse_args(argv))
