"""One local solve of a co-design program on its free unknowns, by a solver of choice.

Uno's filterSQP (trust-region SQP with an active-set QP solver) uses the exact second derivatives;
scipy's SLSQP stands in where Uno is not installed.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.copter.codesign.free_program import FreeProgram, Notes
from diffsim.copter.codesign.program import Program
from diffsim.copter.codesign.solver_scipy import by_scipy
from diffsim.copter.codesign.solver_uno import PRESETS, by_uno
from diffsim.core.check import require_choice

Array = NDArray[np.float64]


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


def default_solver() -> str:
    """``uno`` where it is installed, else ``slsqp``."""
    return "uno" if importlib.util.find_spec("unopy") else "slsqp"


def second_solver() -> str:
    """What is tried where the first one stops at an infeasible point."""
    return "uno-ipm" if importlib.util.find_spec("unopy") else "trust-constr"


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
    solver = require_choice("solver", solver or default_solver(), SOLVERS)
    if solver == "uno" and "response" in program.aux:
        solver = "slsqp"  # has no second derivatives
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
