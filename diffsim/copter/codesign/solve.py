"""One local solve of a co-design program on its free unknowns, by a solver of choice.

Uno's filterSQP (trust-region SQP with an active-set QP solver) uses the exact second derivatives;
scipy's SLSQP stands in where Uno is not installed.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import Bounds, NonlinearConstraint, minimize

from diffsim._check import require_choice
from diffsim.copter.codesign.hessian import lagrangian_hessian
from diffsim.copter.codesign.program import Program

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LocalSolution:
    """Where a local solve ended.

    Attributes:
        x: All unknowns, (num_all,).
        value: Objective.
        violation: Largest of |equalities| and violated inequalities, relative.
        converged: The solver says so.
        message: Of the solver.
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


class FreeProgram:
    """A program in its free unknowns only; the fixed ones stay where the start has them."""

    def __init__(self, program: Program, start: Array):
        self.program = program
        thrusts = np.arange(program.num_all) >= program.at["v"].start
        self.whole = np.where(thrusts & ~program.free, program.fixed_value, start)
        self.start = np.clip(self.whole[program.free], program.lower, program.upper)
        self._kept: dict[str, tuple[bytes, tuple]] = {}

    def fill(self, y: Array) -> Array:
        """All unknowns of the free ones."""
        x = self.whole.copy()
        x[self.program.free] = y
        return x

    def _evaluate(self, name: str, y: Array) -> tuple:
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
        """Of ``equalities`` or ``inequalities``."""
        return self._evaluate(name, y)[0]

    def jacobian(self, name: str, y: Array) -> Array:
        """Of ``equalities`` or ``inequalities``."""
        return self._evaluate(name, y)[1]

    def hessian(
        self,
        y: Array,
        of_objective: float,
        equalities: Array | None = None,
        inequalities: Array | None = None,
    ) -> Array:
        """Of the Lagrangian with these multipliers (None: zeros)."""
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


# The filterSQP and interior-point presets of Uno, and scipy's.
SOLVERS = ("uno", "uno-ipm", "slsqp", "trust-constr")
_PRESETS = {"uno": "filtersqp", "uno-ipm": "ipopt"}


def default_solver() -> str:
    """``uno`` where it is installed, else ``slsqp``."""
    return "uno" if importlib.util.find_spec("unopy") else "slsqp"


def second_solver() -> str:
    """What is tried where the first one stops at an infeasible point."""
    return "uno-ipm" if importlib.util.find_spec("unopy") else "trust-constr"


class _Notes:
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
    notes = _Notes(free)
    run: Callable = _by_uno if solver in _PRESETS else _by_scipy
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


def _by_scipy(
    free: FreeProgram, notes: _Notes, solver: str, max_iters: int, tolerance: float
) -> tuple[Array, bool, str, int]:
    p = free.program
    kinds = [("eq", "equalities"), ("ineq", "inequalities")]
    kinds = [(kind, name) for kind, name in kinds if len(free.values(name, free.start))]
    shared = {"fun": free.objective, "x0": free.start, "jac": True, "callback": notes}
    if solver == "slsqp":
        constraints: list = [
            {
                "type": kind,
                "fun": lambda y, name=name: free.values(name, y),
                "jac": lambda y, name=name: free.jacobian(name, y),
            }
            for kind, name in kinds
        ]
        bounds = list(zip(p.lower, p.upper, strict=True))
        options: dict = {"ftol": tolerance, "maxiter": max_iters}
        found = minimize(
            **shared, method="SLSQP", bounds=bounds, constraints=constraints, options=options
        )
        return found.x, bool(found.success), str(found.message), int(found.nit)
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
    found = minimize(
        **shared,
        method="trust-constr",
        hess=lambda y: free.hessian(y, 1.0),
        bounds=Bounds(p.lower, p.upper),
        constraints=constraints,
        options={"gtol": tolerance, "xtol": tolerance, "maxiter": max_iters},
    )
    return found.x, found.status in (1, 2), str(found.message), int(found.nit)


def _by_uno(
    free: FreeProgram, notes: _Notes, solver: str, max_iters: int, tolerance: float
) -> tuple[Array, bool, str, int]:
    import unopy

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
    uno.set_preset(_PRESETS[solver])
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
    found = uno.optimize(model)
    status = found.solution_status
    converged = status == unopy.SolutionStatus.FEASIBLE_KKT_POINT
    message = f"{status.name} ({found.optimization_status.name})"
    return np.array(found.primal_solution), converged, message, int(found.number_iterations)
