"""Co-optimization of a multicopter's shape, rotor directions, spins and hover thrusts."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from diffsim.copter.codesign.alternating import alternating, judge
from diffsim.copter.codesign.bound import lower_bound
from diffsim.copter.codesign.cases import Demands
from diffsim.copter.codesign.joint import Solution, joint, random_point, refine
from diffsim.copter.codesign.limits import Limits
from diffsim.copter.codesign.metrics import ALTERNATING, METRICS, CurrentModel, parse_objective
from diffsim.copter.codesign.options import AlternatingOptions, SearchOptions
from diffsim.copter.codesign.program import Program
from diffsim.copter.codesign.result import CoDesignResult, attitude_of
from diffsim.copter.codesign.space import DesignSpace
from diffsim.copter.codesign.task import Point, Task, hover_residual
from diffsim.core.arrays import Array
from diffsim.core.check import require_choice
from diffsim.core.checked import checked

_HOVERS = 1e-8


@checked
def codesign(
    design: DesignSpace,
    objective: str | Mapping[str, float] = "payload",
    method: str = "joint",
    *,
    currents: CurrentModel | None = None,
    spins: str | Sequence[float] | Tensor = "search",
    demands: Demands | None = None,
    limits: Limits | None = None,
    search: SearchOptions | None = None,
    options: AlternatingOptions | None = None,
    executor: Executor | None = None,
) -> CoDesignResult:
    """Optimize a design for a metric, or a non-negative mix, subject to hover (thesis 3.4).

    ``joint`` solves one smooth program over all unknowns with hard hover, from many starts.
    ``alternating`` is the thesis's Alg. 1: soft hover (eq. 3.9), spins by the condition of the
    controllability matrix, then thrusts, shape and directions in turn.

    Args:
        design: The parametric design, at its present values.
        objective: A name from ``METRICS``, or {name: weight >= 0}; relative units.
        method: ``joint`` or ``alternating``.
        currents: Current against thrust of every rotor, for metrics of current.
        spins: ``search`` (all assignments), ``given`` (the design's), or (n_rotors,) of +1 and -1.
        demands: Torques, loads and turns that the design must manage; none by default.
        limits: Bounds of shape, tilt, attitude and clearance, and what may change; ``Limits()`` by
            default.
        search: Number of starts, seed and solver; ``SearchOptions()`` by default.
        options: Weights and stopping rule of the alternation; ``AlternatingOptions()`` by default.
        executor: Executor of the starts (``core.open_executor``); None: one after another. The
            result is the same.

    Returns:
        The best design, with a bound on how much better any could be.

    Raises:
        ValueError, TypeError: bad arguments; unknown names with the closest ones.
        CoDesignError: the design space is empty, or nothing in it hovers.

    Example:
        >>> best = codesign(load_design("pentacopter"), "payload", limits=Limits(clearance=0.01))
    """
    began = time.perf_counter()
    require_choice("method", method, ("joint", "alternating"))
    demands = Demands() if demands is None else demands
    limits = Limits() if limits is None else limits
    search = SearchOptions() if search is None else search
    task = Task.of(design, objective, demands, limits, currents)
    chosen = _spins(spins, task)
    rng = np.random.default_rng(search.seed)
    if method == "alternating":
        parse_objective(task.weights, known=ALTERNATING)
        if demands.authority is not None or limits.clearance is not None:
            raise ValueError("method 'alternating' knows no authority or clearance; use 'joint'")
        options = AlternatingOptions() if options is None else options
        solved = _by_alternation(task, chosen, options, search.num_starts, rng, executor)
    else:
        solved = refine(joint(task, chosen, search, rng, executor), search.solver)
    return _result(solved, method, began)


def _by_alternation(
    task: Task,
    spins: Array | None,
    options: AlternatingOptions,
    num_starts: int,
    rng: np.random.Generator,
    executor: Executor | None,
) -> Solution:
    starts = [task.start] + [random_point(task, task.start, rng) for _ in range(num_starts - 1)]
    point, best, records = alternating(task, spins, options, starts, executor)
    _, _, solution, program = judge(task, best)
    return Solution(
        task,
        Point.of(program, solution.x, point.spins),
        program,
        solution.x,
        history=best.energies,
        seconds_history=best.seconds,
        status=f"best of {len(records)} starts, {best.status}, {len(best.energies) - 1} rounds",
        records=records,
        warnings=[],
    )


def _result(solved: Solution, method: str, began: float) -> CoDesignResult:
    """The result of a solved program, with what is measured on the whole model."""
    task, point, program, x = solved.task, solved.point, solved.program, solved.x
    thrusts = torch.tensor(program.hover_thrusts(x))
    vehicle = task.vehicle(point)
    residual = hover_residual(vehicle, thrusts, point.gamma)
    value = program.metric(x)[0]
    warnings = list(solved.warnings)
    return CoDesignResult(
        s=torch.tensor(point.s),
        directions=torch.tensor(point.d),
        spins=torch.tensor(point.spins),
        thrusts=thrusts,
        attitude=torch.tensor(attitude_of(point.gamma)),
        vehicle=vehicle,
        objective=value,
        metrics=design_metrics(task, program, x),
        max_weight=largest_weight(task, point),
        bound=_find_bound(task, warnings),
        history=solved.history,
        seconds_history=solved.seconds_history,
        hover_residual=residual,
        feasible=residual <= _HOVERS,
        status=solved.status,
        method=method,
        seconds=time.perf_counter() - began,
        starts=solved.records,
        warnings=warnings,
    )


def _find_bound(task: Task, warnings: list[str]) -> float:
    """The lower bound; without cvxpy none, and a warning."""
    try:
        return lower_bound(task)
    except ImportError as error:
        warnings.append(f"no bound: {error}")
        return -np.inf


def _spins(spins: str | Sequence[float] | Tensor, task: Task) -> Array | None:
    if isinstance(spins, str):
        require_choice("spins", spins, ("search", "given"))
        return None if spins == "search" else task.model.vehicle.spins.numpy()
    values = np.asarray(spins, float)
    if values.shape != (task.model.num_rotors,) or (np.abs(values) != 1.0).any():
        raise ValueError(
            f"spins must be {task.model.num_rotors} values of +1 or -1, got {values.tolist()}"
        )
    return values


def design_metrics(task: Task, program: Program, x: Array) -> dict[str, float]:
    """Relative metrics of a program's unknowns: those asked for, and those of shape and thrusts."""
    s, _, _, aux, _ = program.split(x)
    thrusts = program.hover_thrusts(x)
    shape, scales = program.shape(s), task.scales
    values = {
        "payload": float((thrusts / program.rotors.max_thrusts).max()) * scales.mass / shape.mass,
        "size": shape.size / scales.size,
        "flight_time": -shape.size / scales.size,
        "cost": shape.cost / scales.cost,
        "mass": shape.mass / scales.mass,
    }
    if task.currents is not None:
        current = task.currents.current(thrusts)
        values["current"] = float(current.sum() / scales.current)
        values["max_current"] = float(current.max() / scales.max_current)
    for name, value in aux.items():
        if name in task.weights:
            sign = -1.0 if name == "authority" else 1.0
            values[name] = sign * value
    if "response" in task.weights:
        values["response"] = float(np.sqrt(scales.response / max(aux["response"], 1e-12)))
    return {name: values[name] for name in METRICS if name in values}


def largest_weight(task: Task, point: Point) -> float:
    """Overall weight that shape, directions and spins of a point lift [N]; nan if they cannot.

    Thrusts and attitude are optimized; a demanded authority is kept.
    """
    lifting = replace(task.lifting(), scales=task.scales)
    best = np.nan
    for free in ((), ("attitude",)):
        solution, program = lifting.solve(point, free=free)
        if solution.violation < 1e-7 and solution.value > 0.0:
            best = float(np.nanmax([best, program.rotors.weight / solution.value]))
    return best
