"""The most that thrusts within their limits can do, and its derivative in the design.

max t  s.t.  C u_k = b_k + a_k t,  0 <= u_k <= u_max  for every case k,

a linear program in t and the thrusts of all cases (HiGHS), or with a logarithmic barrier. By the
envelope theorem the optimum moves with the Lagrangian at fixed thrusts, t and multipliers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize
import torch
from torch import Tensor

from diffsim.core.errors import ConvergenceError, DiffsimError
from diffsim.core.numbers import to_numpy


class ThrustLimitError(DiffsimError):
    """No thrusts within the limits do what is asked, at any scale."""


class _Optimum(NamedTuple):
    value: float
    scale: float  # t
    thrusts: np.ndarray  # (num_cases, n)
    equality: np.ndarray  # d value / d (b_k + a_k t - C u_k), (num_cases, m)
    upper: np.ndarray  # d value / d u_max, (n,)


def max_scale(
    C: Tensor, a: Tensor, b: Tensor, max_thrusts: Tensor, *, what: str, smoothing: float = 0.0
) -> Tensor:
    """The largest t, with gradients to every argument.

    Args:
        C: (m, n_rotors).
        a: What they must do in addition for each unit of t, (num_cases, m).
        b: What the thrusts must do whatever t, (num_cases, m).
        max_thrusts: (n_rotors,) [N], > 0 where a rotor runs.
        what: What is asked, for the message.
        smoothing: mu of t + mu sum log(4 u (u_max - u) / u_max^2), whose maximum lies below the
            largest t and is smooth in the design; 0: the linear program itself, piecewise smooth.

    Raises:
        ThrustLimitError: infeasible.
    """
    C_now, a_now, b_now, limit = (to_numpy("copter", t) for t in (C, a, b, max_thrusts))
    optimum = _linear_program(C_now, a_now, b_now, limit, what=what)
    if smoothing:
        optimum = _barrier(C_now, a_now, b_now, limit, smoothing)
    thrusts, equality, upper = (
        torch.from_numpy(v) for v in (optimum.thrusts, optimum.equality, optimum.upper)
    )
    # Zero in value (the constraints hold), but not in derivative.
    slack = b + a * optimum.scale - thrusts @ C.mT
    limits = upper * (max_thrusts - max_thrusts.detach())
    lagrangian = (equality * (slack - slack.detach())).sum() + limits.sum()
    return optimum.value + lagrangian


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
    return _Optimum(float(solution.x[-1]), float(solution.x[-1]), thrusts, equality, upper)


def _barrier(
    C: np.ndarray, a: np.ndarray, b: np.ndarray, limit: np.ndarray, smoothing: float
) -> _Optimum:
    """Newton from the middle of the box, the barrier weakened step by step (Boyd, 10.3)."""
    num_cases, n = len(a), C.shape[1]
    limits = np.tile(limit, num_cases)
    rows = np.hstack([np.kron(np.eye(num_cases), C), -a.reshape(-1, 1)])
    x = np.append(0.5 * limits, 0.0)
    y = np.zeros(len(rows))
    mu = max(1.0, smoothing)
    while True:
        x, y = _center(rows, b.ravel(), limits, mu, x, y)
        if mu == smoothing:
            break
        mu = max(0.2 * mu, smoothing)
    u, t = x[:-1], x[-1]
    value = t + smoothing * np.log(4.0 * u * (limits - u) / limits**2).sum()
    # d/dm log(u (m - u) / m^2) = 1 / (m - u) - 2 / m
    upper = smoothing * (1.0 / (limits - u) - 2.0 / limits)
    thrusts, upper = u.reshape(num_cases, n), upper.reshape(num_cases, n).sum(0)
    return _Optimum(float(value), float(t), thrusts, y.reshape(num_cases, -1), upper)


def _center(
    rows: np.ndarray,
    rhs: np.ndarray,
    limits: np.ndarray,
    mu: float,
    x: np.ndarray,
    y: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Maximum of t + mu sum log(u (m - u)) on the rows; y = d optimum / d rhs."""

    def residual(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        u = x[:-1]
        slope = np.append(mu * (1.0 / u - 1.0 / (limits - u)), 1.0)
        return np.concatenate([slope - rows.T @ y, rhs - rows @ x])

    num = len(x)
    for _ in range(200):
        r = residual(x, y)
        if np.linalg.norm(r) < 1e-11 * (1.0 + np.linalg.norm(y)):
            return x, y
        u = x[:-1]
        curvature = np.append(mu * (1.0 / u**2 + 1.0 / (limits - u) ** 2), 0.0)
        kkt = np.block([[-np.diag(curvature), -rows.T], [-rows, np.zeros((len(rows),) * 2)]])
        step = scipy.linalg.lstsq(kkt, -r, lapack_driver="gelsy")[0]
        du = step[: num - 1]
        room = np.where(du < 0.0, u, limits - u)
        length = min(1.0, 0.99 / np.max(np.abs(du) / room))
        norm = np.linalg.norm(r)
        while length > 1e-10:
            moved = residual(x + length * step[:num], y + length * step[num:])
            if np.linalg.norm(moved) <= (1.0 - 0.01 * length) * norm:
                break
            length *= 0.5
        else:  # the residual has reached its rounding
            if norm < 1e-8 * (1.0 + np.linalg.norm(y)):
                return x, y
            break
        x, y = x + length * step[:num], y + length * step[num:]
    size = float(np.linalg.norm(residual(x, y)))
    raise ConvergenceError(
        f"the smoothed linear program stopped at residual {size:.1e}; raise smoothing",
        residual_norm=size,
        tolerance=1e-11,
        num_iters=200,
    )
