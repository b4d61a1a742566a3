"""Co-optimisation of a multicopter's shape, rotor directions, spins and hover thrusts."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim.copter.codesign.alternating import alternating, judge
from diffsim.copter.codesign.bound import lower_bound
from diffsim.copter.codesign.cases import Demands
from diffsim.copter.codesign.joint import joint, random_point, refine
from diffsim.copter.codesign.limits import Limits
from diffsim.copter.codesign.metrics import ALTERNATING, CurrentModel, parse_objective
from diffsim.copter.codesign.options import AlternatingOptions
from diffsim.copter.codesign.program import Program
from diffsim.copter.codesign.report import design_metrics, largest_weight
from diffsim.copter.codesign.result import CoDesignResult, StartRecord, attitude_of
from diffsim.copter.codesign.space import DesignSpace
from diffsim.copter.codesign.task import Point, Task, hover_residual
from diffsim.core.check import require_choice, require_number

_FREE = ("shape", "directions", "attitude")
_HOVERS = 1e-8


def codesign(
    design: DesignSpace,
    objective: str | Mapping[str, float] = "payload",
    method: str = "joint",
    *,
    currents: CurrentModel | None = None,
    spins: str | Sequence[float] | Tensor = "search",
    free: Sequence[str] = _FREE,
    authority: Sequence[float] | None = None,
    load: float = 0.0,
    clearance: float | None = None,
    max_tilt: float = np.pi / 6,
    max_attitude: float = np.pi / 12,
    extent: float = 2.0,
    response_angle: float = 0.5,
    num_starts: int = 8,
    num_spins: int = 4,
    seed: int = 0,
    max_iters: int = 300,
    solver: str | None = None,
    options: AlternatingOptions | None = None,
) -> CoDesignResult:
    """Optimise a design for a metric, or a non-negative mix, subject to hover (thesis 3.4).

    ``joint`` solves one smooth program over all unknowns with hard hover, from many starts.
    ``alternating`` is the thesis's Alg. 1: soft hover (eq. 3.9), spins by the condition of the
    controllability matrix, then thrusts, shape and directions in turn.

    Args:
        design: The parametric design, at its present values.
        objective: A name from ``METRICS``, or {name: weight >= 0}; relative units.
        method: ``joint`` or ``alternating``.
        currents: Current against thrust of every rotor, for metrics of current.
        spins: ``search`` (all assignments), ``given`` (the design's), or (n_rotors,) of +1 and -1.
        free: Which of shape, directions, attitude may change.
        authority: Torques about x, y, z that must be left, in any combination of signs, at the
            largest weight; only with joint (3,) [N m].
        load: Extra mass that the metrics authority and response are to carry [kg].
        clearance: Least distance of propeller discs seen from above [m]; None: not asked.
        max_tilt: Largest angle of a rotor from up [rad].
        max_attitude: Largest roll or pitch in hover [rad].
        extent: Largest change of a shape parameter, in mean arm lengths.
        response_angle: Turned by in the response metric [rad].
        num_starts: Local solves, or starts of the alternation.
        num_spins: Best spin assignments that share the starts (joint).
        seed: Of the random starts; the first ones are the design itself.
        max_iters: Of each local solve.
        solver: ``uno``, ``uno-ipm``, ``slsqp`` or ``trust-constr``; None: uno if installed.
        options: Of the alternation.

    Returns:
        The best design found, with a bound on how much better any could be.

    Raises:
        ValueError, TypeError: bad arguments; unknown names with the closest ones.
        CoDesignError: the design space is empty, or nothing in it hovers.
    """
    began = time.perf_counter()
    require_choice("method", method, ("joint", "alternating"))
    for name in free:
        require_choice("free", name, _FREE)
    require_number("max_tilt", float(max_tilt), above=0.0, below=np.pi / 2)
    require_number("max_attitude", float(max_attitude), above=0.0, below=np.pi / 2)
    require_number("extent", float(extent), above=0.0, below=1e6)
    require_number("load", float(load), at_least=0.0)
    require_number("response_angle", float(response_angle), above=0.0, below=np.pi)
    require_number("num_starts", num_starts, at_least=1)
    require_number("num_spins", num_spins, at_least=1)
    if clearance is not None:
        require_number("clearance", float(clearance), at_least=0.0)
    limits = Limits(max_tilt, max_attitude, clearance, tuple(free), extent)
    demands = Demands(_torques(authority), load, response_angle=response_angle)
    task = Task.of(design, objective, demands, limits, currents)
    chosen = _spins(spins, task)
    rng = np.random.default_rng(seed)
    if method == "alternating":
        parse_objective(task.weights, known=ALTERNATING)
        if authority is not None or clearance is not None:
            raise ValueError("method 'alternating' knows no authority or clearance; use 'joint'")
        return _alternating(task, chosen, options or AlternatingOptions(), num_starts, rng, began)
    task, point, found, program, records, warnings = joint(
        task,
        chosen,
        num_starts=num_starts,
        num_spins=num_spins,
        rng=rng,
        solver=solver,
        max_iters=max_iters,
    )
    task, point, found, program = refine(task, point, found, program, solver=solver)
    best = next(r for r in sorted(records, key=lambda r: r.value))
    return assemble(
        task,
        point,
        program,
        found.x,
        method="joint",
        history=found.history,
        seconds_history=found.seconds,
        status=f"best of {len(records)} starts, {best.status}",
        began=began,
        records=records,
        warnings=warnings,
    )


def assemble(
    task: Task,
    point: Point,
    program: Program,
    x: NDArray[np.float64],
    *,
    method: str,
    history: list[float],
    seconds_history: list[float],
    status: str,
    began: float,
    records: list[StartRecord],
    warnings: list[str],
) -> CoDesignResult:
    """The result of a solved program, with what is measured on the whole model."""
    thrusts = torch.tensor(program.hover_thrusts(x))
    vehicle = task.vehicle(point)
    residual = hover_residual(vehicle, thrusts, point.gamma)
    value = program.metric(x)[0]
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
        bound=_bound(task, warnings),
        history=history,
        seconds_history=seconds_history,
        hover_residual=residual,
        feasible=residual <= _HOVERS,
        status=status,
        method=method,
        seconds=time.perf_counter() - began,
        starts=records,
        warnings=warnings,
    )


def _alternating(
    task: Task,
    spins,
    options: AlternatingOptions,
    num_starts: int,
    rng: np.random.Generator,
    began: float,
) -> CoDesignResult:
    starts = [task.start] + [random_point(task, task.start, rng) for _ in range(num_starts - 1)]
    point, found, records = alternating(task, spins, options, starts)
    _, _, solution, program = judge(task, found)
    s, d, gamma, _, _ = program.split(solution.x)
    return assemble(
        task,
        Point(s, d, point.spins, gamma),
        program,
        solution.x,
        method="alternating",
        history=found.energies,
        seconds_history=found.seconds,
        status=f"best of {len(records)} starts, {found.status}, {len(found.energies) - 1} rounds",
        began=began,
        records=records,
        warnings=[],
    )


def _bound(task: Task, warnings: list[str]) -> float:
    """The lower bound; without cvxpy none, and a warning."""
    try:
        return lower_bound(task)
    except ImportError as error:
        warnings.append(f"no bound: {error}")
        return -np.inf


def _torques(authority: Sequence[float] | None) -> tuple[float, float, float] | None:
    if authority is None:
        return None
    values = tuple(float(t) for t in authority)
    if len(values) != 3:
        raise ValueError(f"authority must be torques about x, y, z [N m], got {len(values)} values")
    for t in values:
        require_number("authority", t, at_least=0.0)
    return values[0], values[1], values[2]


def _spins(spins: str | Sequence[float] | Tensor, task: Task):
    if isinstance(spins, str):
        require_choice("spins", spins, ("search", "given"))
        return None if spins == "search" else task.model.vehicle.spins.numpy()
    values = np.asarray(spins, float)
    if values.shape != (task.model.num_rotors,) or (np.abs(values) != 1.0).any():
        raise ValueError(
            f"spins must be {task.model.num_rotors} values of +1 or -1, got {values.tolist()}"
        )
    return values
