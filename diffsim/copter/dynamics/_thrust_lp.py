"""The most that thrusts within their limits can do, and its derivative in the design.

max t  s.t.  C u_k = b_k + a_k t,  0 <= u_k <= u_max  for every case k,

a linear program in t and the thrusts of all cases (HiGHS). By the envelope theorem the optimum
moves with the Lagrangian at fixed thrusts, t and multipliers: piecewise smooth in the design.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.optimize
import torch
from torch import Tensor

from diffsim.core.errors import DiffsimError
from diffsim.core.numbers import to_numpy


class ThrustLimitError(DiffsimError):
    """No thrusts within the limits do what is asked, at any scale."""


class _Optimum(NamedTuple):
    scale: float  # t
    thrusts: np.ndarray  # (num_cases, n)
    equality: np.ndarray  # d t / d (b_k + a_k t - C u_k), (num_cases, m)
    upper: np.ndarray  # d t / d u_max, (n,)


def max_scale(C: Tensor, a: Tensor, b: Tensor, max_thrusts: Tensor, *, what: str) -> Tensor:
    """The largest t, with gradients to every argument.

    Args:
        C: (m, n_rotors).
        a: What they must do in addition for each unit of t, (num_cases, m).
        b: What the thrusts must do whatever t, (num_cases, m).
        max_thrusts: (n_rotors,) [N], > 0 where a rotor runs.
        what: What is asked, for the message.

    Raises:
        ThrustLimitError: infeasible.
    """
    C_now, a_now, b_now, limit = (to_numpy("copter", t) for t in (C, a, b, max_thrusts))
    optimum = _linear_program(C_now, a_now, b_now, limit, what=what)
    thrusts, equality, upper = (
        torch.from_numpy(v) for v in (optimum.thrusts, optimum.equality, optimum.upper)
    )
    # Zero in value (the constraints hold), but not in derivative.
    slack = b + a * optimum.scale - thrusts @ C.mT
    limits = upper * (max_thrusts - max_thrusts.detach())
    lagrangian = (equality * (slack - slack.detach())).sum() + limits.sum()
    return optimum.scale + lagrangian


def _linear_program(
    C: np.ndarray, a: np.ndarray, b: np.ndarray, limit: np.ndarray, *, what: str
) -> _Optimum:
    num_cases, n = len(a), C.shape[1]
    rows = np.hstack([np.kron(np.eye(num_cases), C), -a.reshape(-1, 1)])
    cost = np.zeros(num_cases * n + 1)
    cost[-1] = -1.0
    bounds = [(0.0, float(m)) for m in np.tile(limit, num_cases)] + [(0.0, None)]
    tight = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    solution = scipy.optimize.linprog(
        cost, A_eq=rows, b_eq=b.ravel(), bounds=bounds, method="highs", options=tight
    )
    if solution.status == 2:
        raise ThrustLimitError(
            f"no thrusts within the limits {what}; lighten the load, raise max_thrusts or move "
            "rotors (hover(copter).residual has the gradient)"
        )
    if solution.status != 0:
        raise ThrustLimitError(f"the linear program to {what} failed: {solution.message}")
    thrusts = solution.x[:-1].reshape(num_cases, n)
    equality = -solution.eqlin.marginals.reshape(num_cases, -1)
    upper = -solution.upper.marginals[:-1].reshape(num_cases, n).sum(0)
    return _Optimum(float(solution.x[-1]), thrusts, equality, upper)
