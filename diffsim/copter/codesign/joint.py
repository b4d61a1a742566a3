"""All unknowns at once: many local solves of one smooth program, spins enumerated outside.

Starts keep away from shapes that no thrusts can control, such as rotors in a line.
"""

from __future__ import annotations

import time
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import LinearConstraint, minimize

from diffsim.copter.codesign.hover import LEVEL, rank_spins
from diffsim.copter.codesign.options import SearchOptions
from diffsim.copter.codesign.polytope import random_feasible
from diffsim.copter.codesign.program import Program
from diffsim.copter.codesign.result import CoDesignError, StartRecord
from diffsim.copter.codesign.solve import LocalSolution, second_solver
from diffsim.copter.codesign.space import ShapeModel
from diffsim.copter.codesign.task import Point, Task, hover_residual
from diffsim.core.arrays import Array
from diffsim.core.runs import run_each

FEASIBLE = 1e-7  # relative violation of constraints that a solution may have
_HOVER = 1e-8  # relative imbalance of the whole model
_START_TILT = 0.2  # [rad], of random starts
_START_STEP = 0.3  # of the mean arm, change of shape parameters of random starts


class Solution(NamedTuple):
    """A solved program and how it came about."""

    # the task that was solved; its start is moved where the given one cannot be controlled
    task: Task
    point: Point  # the best candidate
    program: Program  # the program with hard hover
    x: Array  # unknowns of the program at the optimum
    history: list[float]  # objective or energy over the iterations
    seconds_history: list[float]  # wall time of each [s]
    status: str  # why the search stopped
    records: list[StartRecord]  # one per start
    warnings: list[str]  # what its user must know


def joint(
    task: Task,
    spins: Array | None,
    options: SearchOptions,
    rng: np.random.Generator,
    executor: Executor | None = None,
) -> Solution:
    """The best of ``options.num_starts`` local solves, which ``executor`` may do side by side.

    Raises:
        CoDesignError: no start came to hover; the message has the best residual.
    """
    warnings: list[str] = []
    task, candidates = spin_candidates(task, spins, options.num_spins, rng, warnings)
    origin = task.start
    points = [
        replace(
            origin if k < len(candidates) else random_point(task, origin, rng),
            spins=candidates[k % len(candidates)],
        )
        for k in range(options.num_starts)
    ]
    solved = run_each(partial(_solve_start, task, options), points, executor)
    records: list[StartRecord] = []
    best: tuple[LocalSolution, Array] | None = None
    least = np.inf
    for point, (solution, seconds) in zip(points, solved, strict=True):
        chosen = point.spins
        feasible = solution.violation <= FEASIBLE and np.isfinite(solution.value)
        least = min(least, solution.violation)
        records.append(
            StartRecord(
                spins=tuple(chosen.tolist()),
                value=solution.value if feasible else np.inf,
                violation=solution.violation,
                status=solution.message,
                num_iters=solution.num_iters,
                seconds=seconds,
            )
        )
        if feasible and (best is None or solution.value < best[0].value - 1e-12):
            best = solution, chosen
    if best is None:
        raise CoDesignError(
            f"no hover within the thrust bounds was found for {len(candidates)} spin assignments "
            f"from {options.num_starts} starts: the best leaves {least:.3g} of m g (or m g L) "
            f"unbalanced; take stronger rotors, a lighter design, wider limits, or raise "
            f"num_starts and num_spins",
            residual=float(least),
        )
    solution, chosen = best
    program = task.program(chosen)
    point = Point.of(program, solution.x, chosen)
    if control_margin(task, point, chosen) < CONTROLLABLE:
        warnings.append("the best design cannot be controlled: its thrusts miss a torque or lift")
    first = min(records, key=lambda record: record.value)
    return Solution(
        task,
        point,
        program,
        solution.x,
        history=solution.history,
        seconds_history=solution.seconds,
        status=f"best of {len(records)} starts, {first.status}",
        records=records,
        warnings=warnings,
    )


def _solve_start(task: Task, options: SearchOptions, point: Point) -> tuple[LocalSolution, float]:
    """A local solve, and the wall time that it took [s]."""
    began = time.perf_counter()
    solution, program = task.solve(point, solver=options.solver, max_iters=options.max_iters)
    # A solver may stop at a stationary point of the violation.
    if solution.violation > FEASIBLE and options.solver is None:
        other = second_solver(program)
        if other is not None:
            solution, _ = task.solve(point, solver=other, max_iters=options.max_iters)
    return solution, time.perf_counter() - began


def refine(best: Solution, solver: str | None) -> Solution:
    """Solve again with the fast copy made at the new directions until the whole model hovers.

    Only designs whose mass properties depend on the directions need it.
    """
    for _ in range(5):
        task, point = best.task, best.point
        thrusts = torch.tensor(best.program.hover_thrusts(best.x))
        if hover_residual(task.vehicle(point), thrusts, point.gamma) <= _HOVER:
            break
        task = replace(task, model=ShapeModel(task.design, torch.tensor(point.d), point.s))
        solution, program = task.solve(point, solver=solver)
        best = best._replace(
            task=task,
            point=Point.of(program, solution.x, point.spins),
            program=program,
            x=solution.x,
            history=solution.history,
            seconds_history=solution.seconds,
        )
    return best


def spin_candidates(
    task: Task,
    spins: Array | None,
    num_spins: int,
    rng: np.random.Generator,
    warnings: list[str],
) -> tuple[Task, list[Array]]:
    """The task (its start moved if that cannot be controlled) and the spins worth a try."""
    if spins is not None:
        return task, [np.asarray(spins, float)]
    ratios = task.model.vehicle.torque_ratios.numpy()
    choices = rank_spins(task.model.at(task.start.s), task.start.d, task.rotors, ratios)
    margin = max(control_margin(task, task.start, np.array(c.spins)) for c in choices)
    if margin < CONTROLLABLE and "shape" in task.limits.free:
        moved, margin = move_to_controllable(task, task.start, rng)
        warnings.append(
            "the start cannot be controlled whatever the spins; it was moved to a controllable "
            f"shape (least singular value of thrusts to lift and torques {margin:.2g} of the "
            "largest) before the search"
        )
        task = replace(task, model=ShapeModel(task.design, None, moved.s))
        choices = rank_spins(task.model.at(moved.s), task.start.d, task.rotors, ratios)
    useful = [choice for choice in choices if choice.reach > 0.0] or choices
    return task, [np.array(choice.spins) for choice in useful[:num_spins]]


def random_point(task: Task, origin: Point, rng: np.random.Generator) -> Point:
    """A feasible shape near the origin, with tilted rotors."""
    s, d = origin.s, origin.d
    if "shape" in task.limits.free:
        radius = _START_STEP * task.model.length
        s = random_feasible(task.model.A, task.model.b, s, radius, rng)
    if "directions" in task.limits.free:
        d = d + min(_START_TILT, 0.5 * task.limits.max_tilt) * rng.standard_normal(d.shape)
        d = d / np.linalg.norm(d, axis=1, keepdims=True)
    return Point(s, d, origin.spins, LEVEL)


CONTROLLABLE = 1e-4  # margin below which a design counts as lost
_FLOOR = 1e-8  # keeps the barrier finite where control is lost
_PULL = 1.0  # of the start, against growing the barrier's gain without end


def effectiveness(task: Task, s: Array, d: Array, spins: Array) -> tuple[Array, Array]:
    """Thrusts to lift and torque (4, n_rotors), relative, and its derivative by z (4, n, p)."""
    shape, rotors = task.model.at(s), task.rotors
    reaction = spins * task.model.vehicle.torque_ratios.numpy()
    torque = np.cross(shape.positions, d) + reaction[:, None] * d
    unit = rotors.max_thrusts / rotors.weight
    matrix = np.vstack([-d[:, 2] * unit, torque.T * unit / rotors.length])
    moved = np.cross(shape.d_positions, d[..., None], axisa=1, axisb=1, axisc=1)  # (n, 3, p)
    slope = np.zeros((4, len(d), task.model.num_params))
    slope[1:] = moved.transpose(1, 0, 2) * unit[None, :, None]
    return matrix, slope


def control_margin(task: Task, point: Point, spins: Array) -> float:
    """Least singular value of thrusts to lift and torques over the largest; 0: not controllable."""
    matrix, _ = effectiveness(task, point.s, point.d, spins)
    if min(matrix.shape) < 4:
        return 0.0
    singular = np.linalg.svd(matrix, compute_uv=False)
    return float(singular[-1] / singular[0])


def barrier(
    task: Task, point: Point, spins: Array, step: Array, origin: Array
) -> tuple[float, Array]:
    """-log det(M M' + floor) + pull |step - origin|^2 / 2 and its gradient by the step z."""
    s = task.model.start + task.model.length * step
    matrix, slope = effectiveness(task, s, point.d, spins)
    gram = matrix @ matrix.T + _FLOOR * np.eye(4)
    inverse = np.linalg.inv(gram)
    gradient = -2.0 * np.einsum("ai,aip->p", inverse @ matrix, slope) + _PULL * (step - origin)
    value = -np.linalg.slogdet(gram)[1] + 0.5 * _PULL * ((step - origin) ** 2).sum()
    return float(value), gradient


def move_to_controllable(task: Task, point: Point, rng: np.random.Generator) -> tuple[Point, float]:
    """Move the shape until thrusts span lift and all three torques.

    The barrier is flat at a symmetric start, so the search begins beside it.

    Returns:
        The point with its new shape, and the least singular value of M there over the largest.
    """
    model, spins = task.model, np.array([(-1.0) ** i for i in range(task.model.num_rotors)])
    s = random_feasible(model.A, model.b, point.s, 0.3 * model.length, rng)
    origin = (s - model.start) / model.length
    solution = minimize(
        lambda step: barrier(task, point, spins, step, origin),
        origin,
        jac=True,
        method="SLSQP",
        constraints=[LinearConstraint(model.A * model.length, ub=model.b - model.A @ model.start)]
        if len(model.b)
        else [],
        options={"maxiter": 200},
    )
    moved = replace(point, s=model.start + model.length * solution.x)
    return moved, control_margin(task, moved, spins)
