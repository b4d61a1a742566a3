"""Time and check the Mosaic entry and the proposed domains, without containers.

    DIFFSIM_ISA=avx2 python -m benchmarks.mosaic
    python -m benchmarks.mosaic --repeats 3 --out runs/mosaic

Times are CPU seconds of one thread, medians. "cold" makes the solid anew at every call, as solvers
do that keep nothing; "warm" keeps it, as in a design loop. Mosaic's own records are wall seconds
of a call to a container, a few milliseconds of which are the call itself.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.mosaic import soft_dynamics, stokes_shape
from benchmarks.mosaic.structural_mesh import cantilever
from benchmarks.mosaic.structural_mesh.compliance import (
    cached,
    compliance,
    compliance_gradient,
    prepare,
    problem_of,
)
from labs.machine import machine

SIZES = (4, 6, 8, 12, 16)
RECORDS = {  # Mosaic's, N = 16: forward, gradient [wall s]
    "TopOpt.jl": (0.0127, 0.0342),
    "Firedrake": (0.103, 0.285),
}


def medians(calls: dict[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Median CPU seconds of calls, taken in turn after one unmeasured round."""
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for k in range(repeats + 1):
        for name, call in calls.items():
            began = time.process_time()
            call()
            if k:
                taken[name].append(time.process_time() - began)
    return {name: statistics.median(times) for name, times in taken.items()}


def structural(size: int, repeats: int) -> dict[str, float]:
    """Forward and gradient of the cantilever with N x 2 x N/2 cells, from float32 inputs."""
    given = cantilever.inputs((size, 2, size // 2))
    kept = cached()

    def forward(get: Callable) -> float:
        problem, rho = problem_of(given)
        return compliance(get(problem), rho)

    def gradient(get: Callable) -> np.ndarray:
        problem, rho = problem_of(given)
        return compliance_gradient(get(problem), rho)[1]

    calls = {
        "forward cold": lambda: forward(prepare),
        "gradient cold": lambda: gradient(prepare),
        "forward warm": lambda: forward(kept),
        "gradient warm": lambda: gradient(kept),
    }
    return medians(calls, repeats)


def deviations() -> dict[str, float]:
    """Largest relative deviation from the compliances that Mosaic keeps."""

    def off(cells: tuple[int, int, int], rho: float, expected: float) -> float:
        problem, densities = problem_of(cantilever.inputs(cells, rho, kind="traction"))
        return abs(compliance(prepare(problem), densities) / expected - 1.0)

    return {
        "over N": max(off((n, 2, 4), 0.5, c) for n, c in cantilever.KEPT_BY_SIZE.items()),
        "over density": max(off((8, 2, 4), r, c) for r, c in cantilever.KEPT_BY_DENSITY.items()),
    }


def proposed(repeats: int) -> dict[str, dict[str, float]]:
    """Forward and gradient of the proposed domains at their default resolution."""
    out = {}
    for module, wrt, of in (
        (soft_dynamics, "youngs_modulus", "tip_path"),
        (stokes_shape, "level_set", "outflow"),
    ):
        given = module.inputs()
        ones = {of: np.ones_like(module.apply(given)[of])}
        calls = {
            "forward": lambda m=module, g=given: m.apply(g),
            "gradient": lambda m=module, g=given, w=wrt, o=of, c=ones: m.vector_jacobian_product(
                g, {w}, {o}, c
            ),
        }
        out[module.__name__.rpartition(".")[2]] = medians(calls, repeats)
    return out


def report(results: dict[str, Any]) -> str:
    """The tables in Markdown."""
    lines = [
        "| N | cells | forward, cold | gradient, cold | forward, warm | gradient, warm |",
        "|---:|---:|---:|---:|---:|---:|",
    ]
    for size, row in results["structural_mesh"].items():
        times = " | ".join(f"{1e3 * t:.1f}" for t in row.values())
        lines.append(f"| {size} | {int(size) ** 2} | {times} |")
    lines += ["", "CPU milliseconds. Mosaic's records at N = 16, wall milliseconds:", ""]
    lines += [f"- {name}: {1e3 * f:.1f} and {1e3 * g:.1f}" for name, (f, g) in RECORDS.items()]
    lines += ["", "Largest deviation from the compliances that Mosaic keeps:", ""]
    lines += [f"- {name}: {value:.1e}" for name, value in results["deviation"].items()]
    lines += ["", "| proposed domain | forward | gradient |", "|---|---:|---:|"]
    for name, row in results["proposed"].items():
        lines.append(f"| {name} | {1e3 * row['forward']:.0f} | {1e3 * row['gradient']:.0f} |")
    facts = results["machine"]
    lines += ["", f"{facts['cpu']}, {facts['instruction_set']}, one thread."]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=15, help="measured calls (%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("runs/mosaic"), help="%(default)s")
    given = parser.parse_args()
    results = {
        "machine": machine(),
        "structural_mesh": {str(n): structural(n, given.repeats) for n in SIZES},
        "deviation": deviations(),
        "proposed": proposed(given.repeats),
    }
    given.out.mkdir(parents=True, exist_ok=True)
    text = report(results)
    (given.out / "report.md").write_text(text + "\n", encoding="utf-8")
    (given.out / "results.json").write_text(json.dumps(results, indent=1), encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
