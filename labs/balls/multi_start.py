"""Many random starts, and a descent by adjoint gradients from the best (thesis 4.1.6)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from diffsim import optim
from diffsim.core.check import require_number
from diffsim.core.errors import DiffsimError
from diffsim.identify.problem import Problem

Array = NDArray[np.float64]
TURN_BACK = 1e3  # cost of a point that cannot be simulated, over that of the start


@dataclass(frozen=True, eq=False)
class RandomStarts:
    """Random start points, best first."""

    x: Array  # (count, n) standardized coordinates
    cost: Array  # (count,) ½ |r|² + ½ |x|²; infinite where the simulation failed


def random_starts(
    problem: Problem,
    count: int,
    *,
    seed: int = 0,
    spread: float = 1.0,
    fixed: tuple[str, ...] = (),
    report: Callable[[float], object] = lambda cost: None,
) -> RandomStarts:
    """Simulate points drawn from the prior, the prior's center first.

    Args:
        problem: Fitting problem without effects, or with effects of size zero at the center.
        count: Number of points, the prior's center included.
        seed: Seed of the draws.
        spread: Width of the draws, in prior standard deviations.
        fixed: Names of coordinates that stay at the prior's center.
        report: Called with each cost as it is known.
    """
    require_number("count", count, at_least=1)
    require_number("spread", spread, at_least=0.0)
    rng = np.random.default_rng(seed)
    x = spread * rng.standard_normal((count, len(problem.names)))
    x[0] = 0.0
    x[:, [name in fixed for name in problem.names]] = 0.0
    x = np.clip(x, *problem.bounds)

    def value(point: Array) -> float:
        r = problem.residual(point)
        return 0.5 * float(r @ r + point @ point)

    def tell(progress: optim.Progress) -> None:
        report(progress.evaluation.value)

    cost = np.array([e.value for e in optim.screen(value, x, callback=tell)])
    if not np.isfinite(cost).any():
        raise DiffsimError(f"none of {count} random starts could be simulated; narrow the priors")
    order = np.argsort(cost)
    return RandomStarts(x[order], cost[order])


@dataclass(frozen=True, eq=False)
class Descent:
    """Result of a descent from one start."""

    x: Array  # best point visited, (n,) standardized
    # ½ |r|² + ½ |x|² of every evaluation; infinite where the simulation failed
    cost: tuple[float, ...]
    message: str  # reason for the end, in words


def descend(
    problem: Problem,
    start: Array,
    *,
    max_evaluations: int = 30,
    first_step: float = 0.5,
    report: Callable[[float], object] = lambda cost: None,
) -> Descent:
    """L-BFGS by the adjoint gradient, in coordinates where the cost is nearly round.

    The Gauss-Newton matrix at the start, by differences, is the metric: without it the badly scaled
    valley between camera and motion takes hundreds of iterations.

    Args:
        problem: Fitting problem with a differentiable scene.
        start: Start point, (n,) standardized coordinates.
        max_evaluations: Largest number of evaluations of cost and gradient.
        first_step: Share of the metric's Newton step that is tried first.
        report: Called with each cost as it is known.
    """
    require_number("max_evaluations", max_evaluations, at_least=1)
    _, a = problem.linearize(start)
    root = linalg.inv(linalg.cholesky(a.T @ a + np.eye(len(start)), lower=True)).T
    low, high = problem.bounds

    def cost_at(z: Array) -> optim.Sample:
        x = np.clip(start + root @ z, low, high)
        value, slope = problem.gradient(x)
        cost = value + 0.5 * float(x @ x)
        return optim.Sample(cost, root.T @ (slope + x), {"x": x, "cost": cost})

    first = cost_at(np.zeros(len(start)))
    slope = np.asarray(first.gradient)
    scale = first_step * float(np.linalg.norm(slope)) or 1.0  # L-BFGS first steps by 1

    def scaled(z: Array) -> optim.Sample:
        cost, slope, notes = cost_at(scale * z) if z.any() else first
        return optim.Sample(cost / scale**2, np.asarray(slope) / scale, notes)

    def tell(progress: optim.Progress) -> None:
        if not progress.evaluation.failure:
            report(progress.evaluation.notes["cost"])

    result = optim.minimize(
        scaled,
        np.zeros(len(start)),
        options=optim.Options(
            budget=optim.Budget(max_evaluations),
            tolerances=optim.Tolerances(ftol=1e-8, gtol=1e-8),
            wall=optim.Wall(height=TURN_BACK * first.value / scale**2, over_first=0.0),
        ),
        callback=tell,
    )
    costs = tuple(np.inf if e.failure else e.notes["cost"] for e in result.history)
    best = min(range(len(costs)), key=lambda k: (costs[k], -k))  # the last of the least
    return Descent(result.history[best].notes["x"], costs, result.message)
