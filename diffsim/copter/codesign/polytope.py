"""Feasible sets A s <= b of shape parameters: closest and random points, extremes."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linprog

from diffsim.copter.codesign.result import CoDesignError
from diffsim.core.arrays import Array

_TOLERANCE = 1e-9  # of A s - b [unit of b], above the rounding of LP solvers


def closest_feasible(A: Array, b: Array, s: Array) -> Array:
    """s itself if A s <= b, else the feasible point with the smallest largest change.

    Raises:
        CoDesignError: there is no feasible point; names the violation that remains.
    """
    if not len(b) or (A @ s - b).max() <= _TOLERANCE:
        return s.copy()
    p = len(s)
    spread = np.vstack([np.eye(p), -np.eye(p)])
    rows = np.vstack(
        [np.hstack([A, np.zeros((len(b), 1))]), np.hstack([spread, -np.ones((2 * p, 1))])]
    )
    limits = np.concatenate([b, s, -s])
    cost = np.append(np.zeros(p), 1.0)
    solution = linprog(cost, A_ub=rows, b_ub=limits, bounds=[(None, None)] * p + [(0.0, None)])
    if solution.status == 0:
        return solution.x[:p]
    row, violation = least_violation(A, b)
    raise CoDesignError(
        f"the design space is empty: whatever the shape, constraint {row} of A s <= b is violated "
        f"by {violation:.3g} or more; loosen the limits of the parts or connections it stands for",
        residual=violation,
    )


def least_violation(A: Array, b: Array) -> tuple[int, float]:
    """A constraint that is in conflict, and the smallest violation that some s can keep to."""
    p = A.shape[1]
    rows = np.hstack([A, -np.ones((len(b), 1))])
    cost = np.append(np.zeros(p), 1.0)
    solution = linprog(cost, A_ub=rows, b_ub=b, bounds=[(None, None)] * p + [(0.0, None)])
    # others may be violated as much at the solution found, but without a price nobody needs it
    return int(solution.ineqlin.marginals.argmin()), float(solution.x[-1])


def random_feasible(
    A: Array, b: Array, s: Array, radius: float, rng: np.random.Generator, *, num_steps: int = 20
) -> Array:
    """A random feasible point within ``radius`` of the feasible s in every parameter.

    Hit and run: from s in random directions to random points of the feasible chord.
    """
    point = s.copy()
    for _ in range(num_steps):
        way = rng.standard_normal(len(s))
        way /= np.linalg.norm(way)
        rows = np.vstack([A, np.eye(len(s)), -np.eye(len(s))])
        room = np.concatenate([b, s + radius, radius - s]) - rows @ point
        rate = rows @ way
        ahead, behind = rate > 1e-12, rate < -1e-12
        high = float(np.min(room[ahead] / rate[ahead], initial=np.inf))
        low = float(np.max(room[behind] / rate[behind], initial=-np.inf))
        if high > low:
            point = point + way * rng.uniform(max(low, -2 * radius), min(high, 2 * radius))
    return point if not len(b) or (A @ point - b).max() <= _TOLERANCE else s.copy()
