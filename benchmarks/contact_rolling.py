"""The rolling sphere: every solver over tolerance (thesis fig. 4-5), and what sliding costs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks.contact_scenes import (
    VARIANTS,
    about,
    contact_counts,
    rolling_pass,
    rolling_sphere,
    solver,
    voxel_sphere,
)
from benchmarks.harness import Part, cores
from benchmarks.soft_cantilever import phase_times, row
from benchmarks.soft_scenes import Pass
from diffsim import soft

REFERENCE = "rolling/reference"
# (name, friction, whether the ball starts sliding without turning)
FRICTION_CASES = (
    ("infinite friction, rolling", math.inf, False),
    ("mu = 0.3, rolling", 0.3, False),
    ("mu = 0.3, starts sliding", 0.3, True),
    ("mu = 0, slides", 0.0, True),
)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is measured."""

    spacing: float = 0.011  # edge length of the ball's hexahedra at the surface [m]
    voxels: int = 10  # cells across the ball of cubes; 10 are the thesis's 552 hexahedra
    num_steps: int = 100  # steps of 5 ms
    # tolerances of the step and its adjoint
    rtols: Sequence[float] = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
    rtol: float = 1e-4  # the one at which the ball of cubes and friction are measured
    repetitions: int = 1  # passes of every solver, taken in turn so that slow spells hit all alike
    reference_rtol: float = 1e-10  # tolerance of the Newton-Cholesky run that errors refer to


def parts(plan: Plan) -> list[Part]:
    """The reference, one part per tolerance, the ball of cubes, friction."""
    settings = asdict(plan)
    found = [Part(REFERENCE, settings, lambda results, say: measure_reference(plan))]
    for rtol in plan.rtols:
        found.append(
            Part(
                f"rolling/rtol {rtol:.0e}",
                settings,
                lambda results, say, rtol=rtol: measure(
                    rolling_sphere(plan.spacing), plan, rtol, say, results[REFERENCE]
                ),
            )
        )
    found.append(Part("voxels/methods", settings, lambda results, say: measure_voxels(plan, say)))
    found.append(Part("friction/cases", settings, lambda results, say: measure_friction(plan, say)))
    return found


def measure_reference(plan: Plan) -> dict[str, Any]:
    """Loss and gradient to far below the tolerances compared."""
    body = rolling_sphere(plan.spacing)
    body.solver = solver("newton_cholesky", plan.reference_rtol)
    run = rolling_pass(body, plan.num_steps)
    return {
        **about(body),
        "rtol": plan.reference_rtol,
        "converged": run.converged,
        "loss": run.loss,
        "grad_norm": float(run.grad.norm()),
        "grad": run.grad.flatten().tolist(),
    }


def measure(
    body: soft.SoftBody,
    plan: Plan,
    rtol: float,
    say: Callable[[str], None],
    reference: dict[str, Any],
) -> list[dict[str, Any]]:
    """One row per solver."""
    passes: dict[str, list[Pass]] = {name: [] for name in VARIANTS}
    with cores(1):
        for name in VARIANTS:  # warm up: constant factor, block pattern, memory
            body.solver = solver(name, rtol)
            rolling_pass(body, 1)
        for k in range(plan.repetitions):
            for name in VARIANTS:
                say(f"{name} {k + 1}/{plan.repetitions}")
                body.solver = solver(name, rtol)
                passes[name].append(rolling_pass(body, plan.num_steps))
    return [
        {"method": name, "rtol": rtol, **row(runs, reference), **contact_counts(runs[-1].steps)}
        for name, runs in passes.items()
    ]


def measure_voxels(plan: Plan, say: Callable[[str], None]) -> dict[str, Any]:
    """The thesis's own mesh at one tolerance."""
    body = voxel_sphere(plan.voxels)
    body.solver = solver("newton_cholesky", plan.reference_rtol)
    run = rolling_pass(body, plan.num_steps)
    reference = {"loss": run.loss, "grad": run.grad.flatten().tolist()}
    return {**about(body), "rows": measure(body, plan, plan.rtol, say, reference)}


def measure_friction(plan: Plan, say: Callable[[str], None]) -> list[dict[str, Any]]:
    """One row per case, solved by ``auto``."""
    body = rolling_sphere(plan.spacing)
    body.solver = solver("auto", plan.rtol)
    runs: dict[str, list[Pass]] = {name: [] for name, _, _ in FRICTION_CASES}
    with cores(1):
        rolling_pass(body, 1)
        for _ in range(plan.repetitions):
            for name, friction, slide in FRICTION_CASES:
                say(name)
                runs[name].append(rolling_pass(body, plan.num_steps, friction, slide=slide))
    return [
        {
            "case": name,
            **phase_times(passes),
            **passes[-1].counts(),
            **contact_counts(passes[-1].steps),
            "converged": passes[-1].converged,
        }
        for name, passes in runs.items()
    ]
