"""Uno's filterSQP and interior point on a co-design program, with exact second derivatives."""

from __future__ import annotations

from typing import Any

import numpy as np

from diffsim.copter.codesign.free_program import FreeProgram, Notes
from diffsim.core.arrays import Array
from diffsim.core.optional import optional

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
