"""The thesis's Alg. 1: soft hover, then thrusts, shape and directions in turn.

In relative units the energy (eq. 3.9) is
E(u, s) + eta |M_f u + m g gamma|^2 / (m g)^2 + mu |M_t u|^2 / (m g L)^2, gamma level, m fixed at
the start's unless mass is a metric.

Spins are chosen by the condition of the controllability matrix (eq. 3.8).
"""

from __future__ import annotations

import itertools
import time
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch

from diffsim.copter.codesign.hover import LEVEL
from diffsim.copter.codesign.options import AlternatingOptions
from diffsim.copter.codesign.program import Program
from diffsim.copter.codesign.result import CoDesignError, StartRecord
from diffsim.copter.codesign.solve import LocalSolution
from diffsim.copter.codesign.steps import direction_step, shape_step, soft_energy, thrust_step
from diffsim.copter.codesign.task import Point, Task
from diffsim.copter.dynamics.control_metrics import controllability
from diffsim.copter.dynamics.linearize import linearize
from diffsim.core.arrays import Array
from diffsim.core.runs import run_each


@dataclass(frozen=True)
class Alternation:
    """Where one start of Alg. 1 ended."""

    point: Point  # shape, directions, spins; level
    u: Array  # thrusts, (n_rotors,) [N]
    energies: list[float]  # after each round, the first before any
    seconds: list[float]  # wall time of each [s]
    status: str  # why it stopped


def alternate(task: Task, point: Point, options: AlternatingOptions) -> Alternation:
    """Alg. 1's main loop from a point with its spins.

    Raises:
        CoDesignError: the start is not controllable.
    """
    began = time.perf_counter()
    options = options.relative(task.rotors)
    u = thrust_step(task, point, options)
    if not np.isfinite(condition_number(task, point, u)):
        raise CoDesignError(
            "the start is not controllable with any spins tried, and Alg. 1 has no way on from "
            "there; use method 'joint', which moves it, or another start",
            residual=float("inf"),
        )
    energies, seconds = [soft_energy(task, point, u, options)], [time.perf_counter() - began]
    status = f"max_rounds {options.max_rounds} reached"
    for _ in range(options.max_rounds):
        before = point, u
        u = thrust_step(task, point, options)
        if "shape" in task.limits.free:
            point = shape_step(task, point, u, options)
        if "directions" in task.limits.free:
            point = direction_step(task, point, u, options)
        if not np.isfinite(condition_number(task, point, u)):
            point, u = before
            status = "controllability lost: back to the round before"
            break
        energies.append(soft_energy(task, point, u, options))
        seconds.append(time.perf_counter() - began)
        if abs(energies[-2] - energies[-1]) < options.tolerance:
            status = "converged"
            break
    return Alternation(point, u, energies, seconds, status)


def alternating(
    task: Task,
    spins: Array | None,
    options: AlternatingOptions,
    starts: list[Point],
    executor: Executor | None = None,
) -> tuple[Point, Alternation, list[StartRecord]]:
    """The best of several starts, judged by the hard-hover objective of where they end.

    Spins are chosen at the first start and kept (thesis 3.4.1).

    Raises:
        CoDesignError: no start is controllable, or no end hovers.
    """
    chosen = most_controllable(task, starts[0]) if spins is None else np.asarray(spins, float)
    records: list[StartRecord] = []
    best: tuple[float, Alternation] | None = None
    points = [replace(start, spins=chosen, gamma=LEVEL) for start in starts]
    for end, value, violation in run_each(partial(_rate_start, task, options), points, executor):
        records.append(
            StartRecord(
                spins=tuple(chosen.tolist()),
                value=value,
                violation=violation,
                status=end.status,
                num_iters=len(end.energies) - 1,
                seconds=end.seconds[-1],
            )
        )
        if best is None or value < best[0]:
            best = value, end
    assert best is not None
    if not np.isfinite(best[0]):
        raise CoDesignError(
            f"none of {len(starts)} starts of the alternation came to a design that hovers within "
            f"its thrust bounds; raise eta and mu, or use method 'joint'",
            residual=min(record.violation for record in records),
        )
    return best[1].point, best[1], records


def _rate_start(
    task: Task, options: AlternatingOptions, start: Point
) -> tuple[Alternation, float, float]:
    """Where a start ends, its objective and its violation."""
    end = alternate(task, start, options)
    value, violation, *_ = judge(task, end)
    return end, value, violation


def judge(task: Task, alternation: Alternation) -> tuple[float, float, LocalSolution, Program]:
    """Hard-hover objective (infinite: none) of an end with its shape and directions fixed.

    Thrusts and attitude are optimized; where a tilted attitude cannot be had, level flight.

    Returns:
        Objective, violation of the constraints, solution and program.
    """
    tried = [task.solve(alternation.point, free=free) for free in (("attitude",), ())]
    ends = [(s.value if s.violation < 1e-7 else np.inf, s.violation, s, p) for s, p in tried]
    return min(ends, key=lambda end: (end[0], end[1]))


def condition_number(task: Task, point: Point, u: Array) -> float:
    """Condition number of [B, A B, ..., A^11 B] in level hover with u; inf: uncontrollable."""
    attitude = torch.zeros(2, dtype=torch.float64)
    A, B = linearize(task.vehicle(point), torch.tensor(u), attitude)
    return float(controllability(A, B).condition)


def least_norm_thrusts(task: Task, point: Point) -> Array:
    """Level hover of least norm, no bounds, (n_rotors,) [N]: the thesis's fixed point."""
    vehicle = task.vehicle(point)
    rows = torch.cat([vehicle.force_matrix, vehicle.torque_matrix]).numpy()
    weight = float(vehicle.weight)
    return np.linalg.lstsq(rows, np.array([0.0, 0.0, -weight, 0.0, 0.0, 0.0]), rcond=None)[0]


def spin_conditions(task: Task, point: Point) -> list[tuple[Array, float]]:
    """Condition number of all 2^n assignments, best first (ties: in binary order)."""
    conditions = []
    for signs in itertools.product((1.0, -1.0), repeat=task.model.num_rotors):
        trial = replace(point, spins=np.array(signs))
        u = least_norm_thrusts(task, trial)
        conditions.append((trial.spins, condition_number(task, trial, u)))
    return sorted(conditions, key=lambda pair: pair[1])


def most_controllable(task: Task, point: Point) -> Array:
    """The assignment of the smallest condition number.

    Raises:
        CoDesignError: none is controllable.
    """
    spins, condition = spin_conditions(task, point)[0]
    if not np.isfinite(condition):
        raise CoDesignError(
            f"none of {2 ** len(spins)} spin assignments makes the start controllable, and the "
            "alternation has no way on from there; use method 'joint', which moves the start",
            residual=float("inf"),
        )
    return spins
