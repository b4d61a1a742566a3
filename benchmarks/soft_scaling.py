"""Step time, memory and where the time goes over mesh size.

Every measurement is a process of its own (benchmarks/soft_worker.py): its peak memory is its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks import soft_worker
from benchmarks.harness import Part
from benchmarks.processes import run_child
from benchmarks.soft_operations import operations
from labs.machine import available_memory

# How time grows with size where no two smaller sizes say better: a sparse factor of a 3D mesh
# costs n^2, its triangular solves n^(4/3), everything else is linear.
DEFAULT_EXPONENT = {"newton_cholesky": 2.0, "newton_jacobi": 1.4}
MEMORY_EXPONENT = 4.0 / 3.0
METHODS = ("auto", "newton_pcg", "quasi_newton", "newton_jacobi", "newton_cholesky")


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is measured."""

    # cells across the beam; the mesh has 4 w x w x w cells
    widths: Sequence[int] = (4, 6, 8, 12, 16, 22, 29)
    kinds: Sequence[str] = ("hex", "tet")  # ``hex``, ``tet``
    methods: Sequence[str] = METHODS  # solvers
    rtol: float = 1e-4  # tolerance of step and adjoint
    num_steps: int = 2  # steps of one pass
    # twist of the initial shape; 10 degrees make steps that cost as much as those of the cantilever
    # stage do on average, 90 degrees two to three times as much
    degrees: float = 10.0
    threads: int = 1  # threads
    seconds: float = 1.0  # passes are repeated for this long [s]
    pass_limit: float = 20.0  # a pass that is expected to take longer is skipped [s]


def num_dof(width: int) -> int:
    """Degrees of freedom of a mesh of 4 w x w x w cells."""
    return 3 * (4 * width + 1) * (width + 1) ** 2


def parts(plan: Plan) -> list[Part]:
    """For every mesh: the single operations, then every method."""
    found = []
    for width in plan.widths:
        for kind in plan.kinds:
            common = {
                "kind": kind,
                "cells": (4 * width, width, width),
                "rtol": plan.rtol,
                "num_steps": plan.num_steps,
                "degrees": plan.degrees,
                "threads": plan.threads,
                "seconds": plan.seconds,
            }
            label = f"{kind}, {num_dof(width)} DoF"
            single = {"task": "operations", **common}
            found.append(
                Part(
                    f"scaling/{label}, operations",
                    single,
                    lambda results, say, s=single: run_child(operations, s, timeout=600.0),
                )
            )
            for method in plan.methods:
                settings = {"task": "scaling", "method": method, **common}
                found.append(
                    Part(
                        f"scaling/{label}, {method}",
                        {**settings, "pass_limit": plan.pass_limit},
                        lambda results, say, s=settings: measure(plan, s, results, say),
                    )
                )
    return found


def measure(
    plan: Plan, settings: dict[str, Any], results: dict[str, Any], say: Callable[[str], None]
) -> dict[str, Any]:
    """Run the child, unless smaller sizes say that it would take too long or too much memory."""
    width = settings["cells"][1]
    key = {"kind": settings["kind"], "method": settings["method"], "num_dof": num_dof(width)}
    smaller = rows(results, key["kind"], key["method"])
    if any("skipped" in r for r in smaller):
        return {**key, "skipped": "a smaller mesh was skipped"}
    smaller = measured(smaller)
    expected = expected_pass(smaller, key["num_dof"], settings["method"])
    if expected is not None and expected > plan.pass_limit:
        reason = f"a pass would take about {expected:.0f} s, the limit is {plan.pass_limit:.0f} s"
        return {**key, "skipped": reason}
    if smaller:
        growth = (key["num_dof"] / smaller[-1]["num_dof"]) ** MEMORY_EXPONENT
        need, have = smaller[-1]["memory_peak_B"] * growth, available_memory()
        if need > 0.8 * have:
            reason = f"needs about {need / 2**30:.1f} GiB, {have / 2**30:.1f} GiB are available"
            return {**key, "skipped": reason}
    say(f"about {expected:.1f} s a pass" if expected else "")
    found = run_child(soft_worker.scaling, settings, timeout=20.0 * plan.pass_limit)
    if "failed" in found:
        return {**key, "skipped": found["failed"]}
    return {**key, **found}


def rows(results: dict[str, Any], kind: str, method: str) -> list[dict[str, Any]]:
    """Results of one method, smallest mesh first."""
    found = [
        r
        for name, r in results.items()
        if name.startswith("scaling/") and (r.get("kind"), r.get("method")) == (kind, method)
    ]
    return sorted(found, key=lambda r: r["num_dof"])


def measured(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with times: neither skipped nor the same as another method's."""
    return [r for r in rows if "forward_cpu_s" in r]


def expected_pass(smaller: list[dict[str, Any]], dof: int, method: str) -> float | None:
    """Seconds of a forward and backward pass, extrapolated from smaller sizes."""
    if not smaller:
        return None
    last = smaller[-1]
    power = DEFAULT_EXPONENT.get(method, 1.2)
    if len(smaller) > 1 and last["num_dof"] > 5000:
        power = max(
            power,
            exponent([r["num_dof"] for r in smaller[-2:]], [r["pass_s"] for r in smaller[-2:]]),
        )
    return float(last["pass_s"] * (dof / last["num_dof"]) ** power)


def exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """Slope of log(value) over log(size)."""
    return float(np.polyfit(np.log(sizes), np.log(values), 1)[0])


def exponents(results: dict[str, Any], plan: Plan, *, above: int = 3000) -> list[dict[str, Any]]:
    """Measured exponents of time and memory over the sizes above ``above`` DoF."""
    found = []
    for kind in plan.kinds:
        for method in plan.methods:
            done = measured(rows(results, kind, method))
            large = [r for r in done if r["num_dof"] > above]
            if len(large) < 2:
                continue
            sizes = [r["num_dof"] for r in large]
            row: dict[str, Any] = {
                "kind": kind,
                "method": method,
                "from": sizes[0],
                "to": sizes[-1],
            }
            for name in ("forward_cpu_s", "backward_cpu_s"):
                row[name] = exponent(sizes, [r[name]["median"] for r in large])
            row["memory_B"] = exponent(sizes, [r["memory_peak_B"] for r in large])
            found.append(row)
    return found
