"""Convex quadratic programs by osqp, an optional package."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse

from diffsim.core.arrays import Array
from diffsim.core.errors import ConvergenceError
from diffsim.core.optional import optional


def solve_qp(hessian: Array, gradient: Array, rows: Array, lower: Array, upper: Array) -> Array:
    """min 1/2 s' H s + g' s, lower <= rows s <= upper, polished.

    Args:
        hessian: H, symmetric positive semidefinite, (n, n).
        gradient: g, (n,).
        rows: (k, n).
        lower, upper: (k,); infinite where there is none.

    Returns:
        s, (n,).

    Raises:
        ImportError: osqp is not installed.
        ConvergenceError: it stopped early.
    """
    osqp: Any = optional("osqp", purpose="the closest feasible design")
    solver = osqp.OSQP()
    solver.setup(
        scipy.sparse.csc_matrix(np.triu(hessian)),
        gradient,
        scipy.sparse.csc_matrix(rows),
        lower,
        upper,
        verbose=False,
        eps_abs=1e-10,
        eps_rel=1e-10,
        max_iter=200_000,
        polishing=True,
    )
    result = solver.solve(raise_error=False)
    if not result.info.status.startswith("solved"):
        raise ConvergenceError(
            f"osqp stopped with '{result.info.status}' after {result.info.iter} iterations",
            residual_norm=float(result.info.prim_res),
            tolerance=1e-10,
            num_iters=int(result.info.iter),
        )
    return np.asarray(result.x, dtype=np.float64)
