"""Gauss-Newton that simulates as little as it can: slopes are kept until they mislead.

Each step costs one simulation of every run. The slopes are corrected by what the step has shown
(Broyden 1965, "A class of methods for solving nonlinear simultaneous equations") and computed
afresh only where the record moved otherwise than they said.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize

from diffsim.core.errors import DiffsimError
from diffsim.identify import Fit, Problem
from diffsim.identify.fitting import summary
from diffsim.identify.local import Local, local_at, measured_of, record_at, whitened

Array = NDArray[np.float64]
ENOUGH_NATS = 0.02  # what a further step may promise, far below the 3 nats that part two names
HOPELESS = 3e-4  # ... as a share of the misfit, which no name explains then
FAR_BEHIND = 0.05  # ... as a share of what it is behind the best
BEATEN_NATS = 100.0  # behind the best: its slopes need not be exact
TRUSTED = 0.05  # share of its movement by which the record may stray from its slopes
MISLED = 0.5  # noise standard deviations of the misfit that slopes may mistake
STRAYED = 0.3
LONGEST, SHORTEST = 4.0, 1e-3  # prior standard deviations in one step
MAX_STEPS = 200  # valleys are curved: after 30 the fish tail's fit was not at its end


@dataclass(frozen=True, eq=False)
class Descended:
    """Where it ended: ``fit`` for the outside, ``local`` to go on from."""

    fit: Fit
    local: Local


class _State:
    """A point with what is known there, whitened too."""

    def __init__(self, problem: Problem, local: Local):
        self.problem, self.measured, self.radius = problem, measured_of(problem), LONGEST
        self.coordinates = tuple(range(len(local.x)))
        slopes = local.slopes(self.coordinates)
        self._put(replace(local, idx=self.coordinates, columns=slopes))
        self.jacobian = whitened(problem, slopes)

    def _put(self, local: Local) -> None:
        self.local = local
        self.residual = whitened(self.problem, self.measured - local.record)

    @property
    def misfit(self) -> float:
        """chi2 above what noise alone leaves."""
        return max(float(self.residual @ self.residual) - len(self.residual), 0.0)

    @property
    def cost(self) -> float:
        return float(self.residual @ self.residual + self.local.x @ self.local.x)

    def refresh(self) -> None:
        """Slopes of this point."""
        self.local = local_at(self.problem, self.local.x)
        self.jacobian = whitened(self.problem, self.local.columns)

    def is_trusted(self) -> bool:
        """Whether the slopes serve here: the record strayed little from them, and what is misfitted
        is too small for their error to matter."""
        return self.local.stray < TRUSTED and self.local.stray * np.sqrt(self.misfit) < MISLED

    def tried(self, step: Array) -> bool:
        """Take a step if it lowers the cost; the radius follows what the slopes were worth."""
        x, longest = self.local.x + step, float(np.abs(step).max())
        try:
            record = record_at(self.problem, x)
        except DiffsimError:  # too far to be simulated
            self.radius = 0.25 * longest
            return False
        r = whitened(self.problem, self.measured - record)
        if float(r @ r + x @ x) >= self.cost:
            self.radius = 0.25 * longest
            return False
        before = self.local.stray
        self._advance(step, record)
        strayed = self.local.stray - before
        if strayed > STRAYED:
            self.radius = max(0.5 * longest, 0.5 * self.radius)
        elif longest > 0.9 * self.radius:
            self.radius = 2.0 * longest
        return True

    def _advance(self, step: Array, record: Array) -> None:
        """Go there; correct the slopes by what the record did beside what they said."""
        here = self.local
        off = record - here.record - here.columns @ step
        white_off = whitened(self.problem, off)
        moved = float(linalg.norm(self.jacobian @ step))
        along = step / float(step @ step)
        self.jacobian = self.jacobian + np.outer(white_off, along)
        self._put(
            Local(
                here.x + step,
                record,
                self.coordinates,
                here.columns + np.outer(off, along),
                here.stray + float(linalg.norm(white_off)) / max(moved, 1.0),
            )
        )


def descend(
    problem: Problem, start: Local, *, ahead: Callable[[], float] | None = None
) -> Descended:
    """The minimum of |W (y - S(x))|^2 + |x|^2 within the bounds.

    Args:
        problem: What is fitted.
        start: Point, record and slopes of all coordinates to begin with.
        ahead: Half the cost of the best rival so far [nats]: the further behind, the less exact.

    Raises:
        DiffsimError: the slopes cannot be simulated.
    """
    low, high = problem.bounds
    s = _State(problem, start)
    evaluations, converged, message = 0, False, f"no end after {MAX_STEPS} steps"
    for _ in range(MAX_STEPS):
        behind = max(0.5 * s.cost - ahead(), 0.0) if ahead is not None else 0.0
        step = _step(s.jacobian, s.residual, s.local.x, low, high, s.radius)
        linear, there = s.residual - s.jacobian @ step, s.local.x + step
        promised = 0.5 * (s.cost - float(linear @ linear + there @ there))
        if promised < max(ENOUGH_NATS, HOPELESS * 0.5 * s.misfit, FAR_BEHIND * behind):
            if s.local.stray == 0.0 or s.is_trusted() or behind > BEATEN_NATS:
                converged, message = True, f"a further step promises {promised:.1g} nats"
                break
            s.refresh()
            continue
        evaluations += 1
        is_lower = s.tried(step)
        if not is_lower and s.radius < SHORTEST:
            message = "no step along the slopes lowers the cost"
            break
        if s.local.stray > (STRAYED if is_lower else 0.0):
            s.refresh()
    fit = summary(problem, s.local.x, s.residual, s.jacobian, converged, message, evaluations)
    return Descended(fit, s.local)


def _step(
    jacobian: Array, residual: Array, x: Array, low: Array, high: Array, radius: float
) -> Array:
    """argmin |r - J d|^2 + |x + d|^2 within the bounds, no coordinate moving further than
    the radius."""
    if not len(x):
        return np.zeros(0)
    root = linalg.cholesky(jacobian.T @ jacobian + np.eye(len(x)))
    right = linalg.solve_triangular(root, jacobian.T @ residual - x, trans="T")
    step = linalg.solve_triangular(root, right)
    least, most = np.maximum(low - x, -radius), np.minimum(high - x, radius)
    if (step < least).any() or (step > most).any():
        step = optimize.lsq_linear(root, right, (least, most), method="bvls").x
    return np.asarray(step)
