"""Time and accuracy of every method over tolerance and threads (thesis fig. 4-4)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch

from benchmarks.harness import Part, cores, spread, timed
from benchmarks.soft_scenes import Pass, cantilever, one_pass
from diffsim import soft

METHODS = ("auto", "quasi_newton", "newton_pcg", "newton_jacobi", "newton_cholesky")
REFERENCE = "cantilever/reference"


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is measured."""

    cells: Sequence[int] = (32, 8, 8)  # cells along x, y, z
    num_steps: int = 25  # steps of 10 ms
    # tolerances of the step and its adjoint
    rtols: Sequence[float] = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
    threads: Sequence[int] = (1, 2)  # thread counts
    methods: Sequence[str] = METHODS  # solvers
    repetitions: int = 3  # passes of every method, taken in turn so that slow spells hit all alike
    reference_rtol: float = 1e-10  # tolerance of the Newton-Cholesky run that errors refer to


def parts(plan: Plan) -> list[Part]:
    """The reference, then one part per thread count and tolerance."""
    scene = {"cells": plan.cells, "num_steps": plan.num_steps}
    reference = {**scene, "rtol": plan.reference_rtol}
    found = [Part(REFERENCE, reference, lambda results, say: measure_reference(plan))]
    for threads in plan.threads:
        for rtol in plan.rtols:
            settings = {**asdict(plan), "rtols": rtol, "threads": threads}
            found.append(
                Part(
                    f"cantilever/{threads} threads, rtol {rtol:.0e}",
                    settings,
                    lambda results, say, threads=threads, rtol=rtol: measure_tolerance(
                        plan, threads, rtol, results[REFERENCE], say
                    ),
                )
            )
    return found


def options(method: str, rtol: float, threads: int = 1) -> soft.SolverOptions:
    """Solver options that let an unconverged solve pass; it is marked in the results."""
    return soft.SolverOptions(
        method=method, rtol=rtol, num_threads=threads, max_iters=2000, on_failure="warn"
    )


def measure_reference(plan: Plan) -> dict[str, Any]:
    """Loss and gradient to far below the tolerances compared, and what preparing costs."""
    one_pass(cantilever("hex", (1, 1, 1)), 1)  # torch loads parts of itself at the first call
    body, prepare = timed(lambda: cantilever("hex", plan.cells))
    body.solver = options("newton_cholesky", plan.reference_rtol)
    still = body.physics(gravity=(0.0, 0.0, 0.0))
    # A step that starts at its answer costs a factorization, where that is new, and little else.
    _, first = timed(lambda: body(body.rest_state(), physics=still))
    _, second = timed(lambda: body(body.rest_state(), physics=still))
    run = one_pass(body, plan.num_steps)
    return {
        "num_dof": 3 * body.mesh.num_nodes,
        "num_elements": body.mesh.num_elements,
        "rtol": plan.reference_rtol,
        "converged": run.converged,
        "loss": run.loss,
        "grad_norm": float(run.grad.norm()),
        "grad": run.grad.flatten().tolist(),
        "prepare_mesh_s": prepare.wall,
        "prepare_factor_s": first.wall - second.wall,
    }


def measure_tolerance(
    plan: Plan, threads: int, rtol: float, reference: dict[str, Any], say: Callable[[str], None]
) -> list[dict[str, Any]]:
    """One row per method."""
    body = cantilever("hex", plan.cells)
    passes: dict[str, list[Pass]] = {method: [] for method in plan.methods}
    with cores(threads):
        for method in plan.methods:  # warm up: constant factor, block pattern, memory
            body.solver = options(method, rtol, threads)
            one_pass(body, 1)
        for k in range(plan.repetitions):
            for method in plan.methods:
                say(f"{method} {k + 1}/{plan.repetitions}")
                body.solver = options(method, rtol, threads)
                passes[method].append(one_pass(body, plan.num_steps))
    return [
        {"method": method, "threads": threads, "rtol": rtol, **row(runs, reference)}
        for method, runs in passes.items()
    ]


def row(runs: list[Pass], reference: dict[str, Any]) -> dict[str, Any]:
    """Times with their spread; loss and gradient against the reference."""
    grad = torch.tensor(reference["grad"], dtype=torch.float64)
    last = runs[-1]
    return {
        **phase_times(runs),
        "loss": last.loss,
        "grad_norm": float(last.grad.norm()),
        "loss_error": abs(last.loss - reference["loss"]) / abs(reference["loss"]),
        "grad_error": float((last.grad.flatten() - grad).norm() / grad.norm()),
        "grad_norm_error": abs(float(last.grad.norm() / grad.norm()) - 1.0),
        "converged": last.converged,
        **last.counts(),
    }


def phase_times(runs: list[Pass], per: int = 1) -> dict[str, dict[str, float]]:
    """Spread of wall and CPU seconds of forward, backward and both, divided by ``per``."""
    found = {}
    for k, clock in enumerate(("wall", "cpu")):
        both = [(run.forward[k] / per, run.backward[k] / per) for run in runs]
        found[f"forward_{clock}_s"] = spread([forward for forward, _ in both])
        found[f"backward_{clock}_s"] = spread([backward for _, backward in both])
        found[f"net_{clock}_s"] = spread([sum(pair) for pair in both])
    return found
