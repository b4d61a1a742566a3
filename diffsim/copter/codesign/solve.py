"""One local solve of a co-design program on its free unknowns, by a solver of choice.

Uno's filterSQP (trust-region SQP with an active-set QP solver) and its interior point use the exact
second derivatives; scipy's SLSQP stands in where Uno is not installed.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from diffsim.copter.codesign.free_program import FreeProgram, Notes
from diffsim.copter.codesign.program import Program
from diffsim.copter.codesign.solver_scipy import by_scipy
from diffsim.copter.codesign.solver_uno import PRESETS, by_uno
from diffsim.core.arrays import Array
from diffsim.core.check import require_choice


@dataclass(frozen=True)
class LocalSolution:
    """Where a local solve ended.

    Attributes:
        x: All unknowns, (num_all,).
        value: Objective.
        violation: Largest of |equalities| and violated inequalities, relative.
        converged: The solver says so.
        message: Message of the solver.
        history: Objective after each iteration.
        violations: Violation after each iteration.
        seconds: Wall time since the start after each iteration.
        num_iters: Iterations.
    """

    x: Array
    value: float
    violation: float
    converged: bool
    message: str
    history: list[float] = field(default_factory=list)
    violations: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    num_iters: int = 0


# The filterSQP and interior-point presets of Uno, and scipy's.
SOLVERS = ("uno", "uno-ipm", "slsqp", "trust-constr")


def default_solver(program: Program) -> str:
    """``uno`` for one flight case, ``uno-ipm`` for several, ``slsqp`` where Uno is not installed.

    Where torques are kept in all combinations of signs, many sets of thrust limits can hold at the
    optimum. An active-set method passes from set to set, and where several are as good the last bit
    of a number says which is next: the same start ended at 56.4 to 56.7 N. An interior point's path
    bends smoothly with its start, and ends at the same optimum whatever the rounding.
    """
    if not importlib.util.find_spec("unopy") or "response" in program.aux:
        return "slsqp"  # the response metric has no second derivatives
    return "uno-ipm" if len(program.cases) > 1 else "uno"


def second_solver(program: Program) -> str | None:
    """What is tried where the default solver stopped at an infeasible point; None: nothing."""
    if "response" in program.aux:
        return None
    return {"uno": "uno-ipm", "uno-ipm": "uno", "slsqp": "trust-constr"}[default_solver(program)]


def solve_local(
    program: Program,
    start: Array,
    *,
    solver: str | None = None,
    max_iters: int = 300,
    tolerance: float = 1e-9,
) -> LocalSolution:
    """A local minimum from ``start`` (num_all,), constraints kept within ``tolerance``.

    Raises:
        ValueError: unknown solver.
        ModuleNotFoundError: Uno is asked for and not installed.
    """
    solver = require_choice("solver", solver or default_solver(program), SOLVERS)
    if solver in PRESETS and "response" in program.aux:
        solver = "slsqp"
    free = FreeProgram(program, start)
    notes = Notes(free)
    run: Callable[..., Any] = by_uno if solver in PRESETS else by_scipy
    y, converged, message, num_iters = run(free, notes, solver, max_iters, tolerance)
    y = np.clip(y, program.lower, program.upper)
    return LocalSolution(
        x=free.fill(y),
        value=free.metric(y),
        violation=free.violation(y),
        converged=converged,
        message=f"{solver}: {message}",
        history=notes.values,
        violations=notes.violations,
        seconds=notes.seconds,
        num_iters=num_iters,
    )
