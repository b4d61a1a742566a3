"""One local solve of a co-design program on its free unknowns, by a solver of choice.

Uno's filterSQP (trust-region SQP with an active-set QP solver) and its interior point use the exact
second derivatives; scipy's SLSQP stands in where Uno is not installed.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import Bounds, NonlinearConstraint, minimize

from diffsim.copter.codesign.hessian import lagrangian_hessian
from diffsim.copter.codesign.program import Program
from diffsim.core.arrays import Array
from diffsim.core.check import require_choice
from diffsim.core.optional import optional


@dataclass(frozen=True)
class LocalSolution:
    """Where a local solve ended."""

    x: Array  # all unknowns, (num_all,)
    value: float  # objective
    violation: float  # largest of |equalities| and violated inequalities, relative
    converged: bool  # the solver says so
    message: str  # message of the solver
    history: list[float] = field(default_factory=list)  # objective after each iteration
    violations: list[float] = field(default_factory=list)  # violation after each iteration
    # wall time since the start after each iteration
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


class FreeProgram:
    """A program in its free unknowns only; the fixed ones stay where the start has them."""

    def __init__(self, program: Program, start: Array):
        self.program = program
        thrusts = np.arange(program.num_all) >= program.at["v"].start
        self.whole = np.where(thrusts & ~program.free, program.fixed_value, start)
        self.start = np.clip(self.whole[program.free], program.lower, program.upper)
        self._kept: dict[str, tuple[bytes, tuple[Any, ...]]] = {}

    def fill(self, y: Array) -> Array:
        """All unknowns of the free ones."""
        x = self.whole.copy()
        x[self.program.free] = y
        return x

    def _evaluate(self, name: str, y: Array) -> tuple[Any, ...]:
        key = y.tobytes()
        kept = self._kept.get(name)
        if kept is None or kept[0] != key:
            value, jacobian = getattr(self.program, name)(self.fill(y))
            kept = (key, (value, jacobian[..., self.program.free]))
            self._kept[name] = kept
        return kept[1]

    def objective(self, y: Array) -> tuple[float, Array]:
        """Value and gradient."""
        return self._evaluate("objective", y)

    def metric(self, y: Array) -> float:
        """Weighted relative metrics, without nearness."""
        return float(self.program.metric(self.fill(y))[0])

    def values(self, name: str, y: Array) -> Array:
        """Values of ``equalities`` or ``inequalities``."""
        return self._evaluate(name, y)[0]

    def jacobian(self, name: str, y: Array) -> Array:
        """Jacobian of ``equalities`` or ``inequalities``."""
        return self._evaluate(name, y)[1]

    def hessian(
        self,
        y: Array,
        of_objective: float,
        equalities: Array | None = None,
        inequalities: Array | None = None,
    ) -> Array:
        """Hessian of the Lagrangian with these multipliers (None: zeros)."""
        x, keep = self.fill(y), self.program.free
        if equalities is None:
            equalities = np.zeros(len(self.values("equalities", y)))
        if inequalities is None:
            inequalities = np.zeros(len(self.values("inequalities", y)))
        full = lagrangian_hessian(self.program, x, equalities, inequalities, of_objective)
        return full[np.ix_(keep, keep)]

    def violation(self, y: Array) -> float:
        """Largest violation of any constraint, relative."""
        equal = np.abs(self.values("equalities", y)).max(initial=0.0)
        unequal = (-self.values("inequalities", y)).max(initial=0.0)
        p = self.program
        bounds = max((p.lower - y).max(initial=0.0), (y - p.upper).max(initial=0.0))
        return float(max(equal, unequal, bounds))


class Notes:
    """Objective, violation and wall time after each iteration."""

    def __init__(self, free: FreeProgram):
        self.free, self.began = free, time.perf_counter()
        self.values: list[float] = []
        self.violations: list[float] = []
        self.seconds: list[float] = []
        self(free.start)

    def __call__(self, y: Array, *_: object) -> None:
        self.values.append(self.free.metric(y))
        self.violations.append(self.free.violation(y))
        self.seconds.append(time.perf_counter() - self.began)


def by_scipy(
    free: FreeProgram, notes: Notes, solver: str, max_iters: int, tolerance: float
) -> tuple[Array, bool, str, int]:
    """Free unknowns, whether converged, message and iterations of ``slsqp`` or ``trust-constr``."""
    p = free.program
    kinds = [("eq", "equalities"), ("ineq", "inequalities")]
    kinds = [(kind, name) for kind, name in kinds if len(free.values(name, free.start))]
    shared = {"fun": free.objective, "x0": free.start, "jac": True, "callback": notes}
    if solver == "slsqp":
        constraints: list[Any] = [
            {
                "type": kind,
                "fun": lambda y, name=name: free.values(name, y),
                "jac": lambda y, name=name: free.jacobian(name, y),
            }
            for kind, name in kinds
        ]
        bounds = list(zip(p.lower, p.upper, strict=True))
        options: dict[str, Any] = {"ftol": tolerance, "maxiter": max_iters}
        solution = minimize(
            **shared, method="SLSQP", bounds=bounds, constraints=constraints, options=options
        )
        return solution.x, bool(solution.success), str(solution.message), int(solution.nit)
    constraints = [
        NonlinearConstraint(
            lambda y, name=name: free.values(name, y),
            0.0,
            0.0 if kind == "eq" else np.inf,
            jac=lambda y, name=name: free.jacobian(name, y),
            hess=lambda y, w, name=name: free.hessian(y, 0.0, **{name: w}),
        )
        for kind, name in kinds
    ]
    solution = minimize(
        **shared,
        method="trust-constr",
        hess=lambda y: free.hessian(y, 1.0),
        bounds=Bounds(p.lower, p.upper),
        constraints=constraints,
        options={"gtol": tolerance, "xtol": tolerance, "maxiter": max_iters},
    )
    return solution.x, solution.status in (1, 2), str(solution.message), int(solution.nit)


# Uno's names of what diffsim calls uno and uno-ipm.
PRESETS = {"uno": "filtersqp", "uno-ipm": "ipopt"}


def by_uno(
    free: FreeProgram, notes: Notes, solver: str, max_iters: int, tolerance: float
) -> tuple[Array, bool, str, int]:
    """Free unknowns, whether converged, message and iterations.

    Raises:
        ImportError: Uno is not installed.
    """
    unopy: Any = optional("unopy", purpose=f"solver {solver!r}", otherwise="use solver 'slsqp'")

    p, n = free.program, len(free.start)
    num_equal = len(free.values("equalities", free.start))
    m = num_equal + len(free.values("inequalities", free.start))
    row, column = np.divmod(np.arange(m * n), n)
    lower = np.tril_indices(n)

    # Uno lends its buffers, and the kept evaluations would change under our feet
    def gradient(y: Array, out: Array) -> None:
        out[:] = free.objective(np.array(y))[1]

    def constraints(y: Array, out: Array) -> None:
        y = np.array(y)
        out[:num_equal] = free.values("equalities", y)
        out[num_equal:] = free.values("inequalities", y)

    def jacobian(y: Array, out: Array) -> None:
        y = np.array(y)
        out[: num_equal * n] = free.jacobian("equalities", y).ravel()
        out[num_equal * n :] = free.jacobian("inequalities", y).ravel()

    def hessian(y: Array, of_objective: float, w: Array, out: Array) -> None:
        w = np.array(w)
        full = free.hessian(np.array(y), of_objective, w[:num_equal], w[num_equal:])
        out[:] = full[lower]

    model = unopy.Model(
        unopy.PROBLEM_NONLINEAR, n, p.lower.tolist(), p.upper.tolist(), unopy.ZERO_BASED_INDEXING
    )
    model.set_objective(unopy.MINIMIZE, lambda y: free.objective(np.array(y))[0], gradient)
    high = [0.0] * num_equal + [np.inf] * (m - num_equal)
    model.set_constraints(
        m, constraints, [0.0] * m, high, m * n, row.tolist(), column.tolist(), jacobian
    )
    model.set_lagrangian_hessian(
        len(lower[0]), unopy.LOWER_TRIANGLE, lower[0].tolist(), lower[1].tolist(), hessian
    )
    model.set_lagrangian_sign_convention(unopy.MULTIPLIER_POSITIVE)
    model.set_initial_primal_iterate(free.start.tolist())
    uno = unopy.UnoSolver()
    uno.set_preset(PRESETS[solver])
    options = {
        "logger": "SILENT",
        "max_iterations": max_iters,
        "primal_tolerance": tolerance,
        "dual_tolerance": 100.0 * tolerance,
    }
    for name, value in options.items():
        uno.set_option(name, value)
    # restoration and slacks append unknowns of their own
    uno.set_notify_acceptable_iterate_callback(lambda y, *_: notes(np.array(y)[:n]))
    solution = uno.optimize(model)
    status = solution.solution_status
    converged = status == unopy.SolutionStatus.FEASIBLE_KKT_POINT
    message = f"{status.name} ({solution.optimization_status.name})"
    return np.array(solution.primal_solution), converged, message, int(solution.number_iterations)
