"""How the weights of the constant matrix were chosen: iterations over VOLUME_SHARE and FIBER_SHARE.

The constant matrix takes the volume and fiber terms with a share of their weight
(diffsim/_context.py, ``preconditioner_stiffness``); 1 is thesis eq. 4.15.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import torch

from benchmarks.harness import Part
from benchmarks.soft_cantilever import options
from benchmarks.soft_scenes import cantilever, one_pass
from diffsim import soft
from diffsim.soft import _context

MUSCLE_STIFFNESS = 2e6  # [Pa], twice the body's Young's modulus


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is measured."""

    cells: Sequence[int] = (16, 4, 4)  # cells along x, y, z
    num_steps: int = 5  # steps of 10 ms
    kinds: Sequence[str] = ("hex", "tet")  # element kinds
    poissons_ratios: Sequence[float] = (0.3, 0.45, 0.49)  # of the body
    volume_weights: Sequence[str] = ("thesis", "small_strain")  # conventions of the volume energy
    # values of VOLUME_SHARE and of FIBER_SHARE
    shares: Sequence[float] = (0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 1.0)
    rtol: float = 1e-4  # tolerance of step and adjoint
    methods: Sequence[str] = ("newton_pcg", "quasi_newton")  # solvers that use the constant matrix


def parts(plan: Plan) -> list[Part]:
    """One part per material and element kind, and one per kind for a muscle's fibers."""
    found = []
    for kind in plan.kinds:
        for ratio in plan.poissons_ratios:
            for weight in plan.volume_weights:
                label = f"accuracy/VOLUME_SHARE, {kind}, nu {ratio}, {weight}"
                case = {"poissons_ratio": ratio, "volume_weight": weight}
                found.append(
                    Part(
                        label,
                        {**asdict(plan), "kind": kind, **case},
                        lambda results, say, kind=kind, case=case: sweep(
                            plan, "VOLUME_SHARE", kind, case, say
                        ),
                    )
                )
        found.append(
            Part(
                f"accuracy/FIBER_SHARE, {kind}",
                {**asdict(plan), "kind": kind, "muscle": MUSCLE_STIFFNESS},
                lambda results, say, kind=kind: sweep(plan, "FIBER_SHARE", kind, {}, say),
            )
        )
    return found


def sweep(
    plan: Plan, name: str, kind: str, case: dict[str, Any], say: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Iterations per step and adjoint for every share; one row per share and method."""
    make = muscular if name == "FIBER_SHARE" else cantilever
    rows = []
    for share in plan.shares:
        body = make(kind, plan.cells, **case)  # anew: a body keeps its constant matrix
        for method in plan.methods:
            say(f"{share:g}, {method}")
            body.solver = options(method, plan.rtol)
            with preconditioner_share(name, share):
                run = one_pass(body, plan.num_steps)
            counts = run.counts()
            rows.append(
                {
                    "name": name,
                    "share": share,
                    "chosen": share == getattr(_context, name),
                    "kind": kind,
                    "method": method,
                    **case,
                    "step_solves": counts["step_solves"],
                    "step_iters": counts["step_iters"],
                    "adjoint_solves": counts["adjoint_solves"],
                    "converged": run.converged,
                    "loss": run.loss,
                }
            )
    return rows


def muscular(kind: str, cells: Sequence[int]) -> soft.SoftBody:
    """The beam with a muscle along its lower half, at its rest length."""
    body = cantilever(kind, cells)
    centers = body.x_rest[body.mesh.elements].mean(1)
    lower = torch.nonzero(centers[:, 2] < centers[:, 2].mean()).flatten()
    muscle = soft.Muscle(elements=lower, direction=(1.0, 0.0, 0.0), stiffness=MUSCLE_STIFFNESS)
    return cantilever(kind, cells, muscles=[muscle])


@contextmanager
def preconditioner_share(name: str, value: float) -> Iterator[None]:
    """Set a weight of the constant matrix, for bodies that have not made theirs yet."""
    before = getattr(_context, name)  # AttributeError: the solver no longer has this constant
    setattr(_context, name, value)
    try:
        yield
    finally:
        setattr(_context, name, before)
