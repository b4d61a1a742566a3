"""A napkin on a ball: every solver over mesh size and share of nodes in contact (Table 4.1)."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch

from benchmarks.contact_scenes import (
    VARIANTS,
    about,
    ball_obstacle,
    contact_counts,
    falling,
    napkin,
    solver,
)
from benchmarks.harness import Part, cores, spread
from benchmarks.soft_scenes import mean
from diffsim import contact, soft
from diffsim.core.errors import ConvergenceWarning

MAX_CANDIDATES = 3000
"""Beyond it the columns of A^-1 and the dense Schur complement take minutes and gigabytes."""
CONSTANT = ("newton_pcg", "uncached")


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is measured."""

    cells: Sequence[int] = (25, 50, 75, 100)  # cells along an edge
    # radii of the nodes that may touch, in half widths
    reaches: Sequence[float] = (0.4, 0.8, 1.0, 1.6)
    span: int = 6  # steps of 2 ms from the first in contact
    samples: int = 3  # steps timed among these, evenly spread; all solvers take the same steps
    limit: float = 6.0  # a solver is stopped after the sample that passes this time [s]
    rtol: float = 1e-4  # tolerance of the step
    friction_cells: int = 50  # cells along an edge where mu = 0.3 is measured as well


def parts(plan: Plan) -> list[Part]:
    """One part per mesh and reach; then friction."""
    settings = asdict(plan)
    cases = [(cells, reach, math.inf) for cells in plan.cells for reach in plan.reaches]
    cases += [(plan.friction_cells, reach, 0.3) for reach in plan.reaches[::2]]
    return [
        Part(
            f"{'napkin' if math.isinf(friction) else 'sliding'}/{cells} cells, reach {reach:g}",
            settings,
            lambda results, say, cells=cells, reach=reach, friction=friction: measure(
                plan, cells, reach, friction, say
            ),
        )
        for cells, reach, friction in cases
    ]


@torch.no_grad()
def measure(
    plan: Plan, cells: int, reach: float, friction: float, say: Callable[[str], None]
) -> dict[str, Any]:
    """Mean CPU time per step of every solver on the same steps."""
    body = napkin(cells, reach, solver("auto", plan.rtol))
    obstacle = ball_obstacle(friction)
    with warnings.catch_warnings(), cores(1):
        warnings.simplefilter("ignore", ConvergenceWarning)
        say("trajectory")
        states, share = first_contacts(body, obstacle, plan)
        rows = []
        for name in VARIANTS:
            say(name)
            if name in CONSTANT and len(body.contact_nodes) > MAX_CANDIDATES:
                continue
            rows.append({"method": name, **time_steps(body, obstacle, states, name, plan)})
    return {
        **about(body),
        "cells": cells,
        "reach": reach,
        "friction": friction if math.isfinite(friction) else None,
        "candidates": len(body.contact_nodes) / body.mesh.num_nodes,
        "share": share,
        "rows": rows,
    }


def first_contacts(
    body: soft.SoftBody, obstacle: contact.Obstacle, plan: Plan
) -> tuple[list[soft.State], float]:
    """States from which steps in contact start, and the mean share of nodes in contact there."""
    states: list[soft.State] = []
    shares: list[float] = []
    state = falling(body)
    while len(states) < plan.span:
        before, state = state, body(state, obstacles=obstacle)
        assert state.contact_force is not None
        touching = int((state.contact_force != 0).any(-1).sum())
        if touching or states:
            states.append(before)
            shares.append(touching / body.mesh.num_nodes)
    every = max(1, plan.span // plan.samples)
    return states[::every], mean(shares[::every])


def time_steps(
    body: soft.SoftBody,
    obstacle: contact.Obstacle,
    states: Sequence[soft.State],
    variant: str,
    plan: Plan,
) -> dict[str, Any]:
    """The steps, after one that is not counted: it makes columns, patterns and memory."""
    body.solver = solver(variant, plan.rtol)
    seconds: list[float] = []
    begin = time.process_time()
    body(states[0], obstacles=obstacle)
    first = time.process_time() - begin
    with soft.record_stats() as solves:
        for state in states:
            start = time.process_time()
            body(state, obstacles=obstacle)
            seconds.append(time.process_time() - start)
            if sum(seconds) > plan.limit:
                break
    names = ("num_iters", "num_solves", "num_factorizations")
    return {
        "step_cpu_s": mean(seconds),
        "spread_cpu_s": spread(seconds),
        "samples": len(seconds),
        "first_cpu_s": first,
        "converged": all(bool((s.converged == 1).all()) for s in solves),
        **{name: mean([float(getattr(s, name)) for s in solves]) for name in names},
        **contact_counts(solves),
    }
