"""scipy's SLSQP and interior point on a co-design program."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import Bounds, NonlinearConstraint, minimize

from diffsim.copter.codesign.free_program import FreeProgram, Notes
from diffsim.core.arrays import Array


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
