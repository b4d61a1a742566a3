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

from diffsim.diagnose.local import Local, local_at, measured_of, record_at, whitened
from diffsim.errors import DiffsimError
from diffsim.identify import Fit, Problem
from diffsim.identify.fitting import summary

Array = NDArray[np.float64]
ENOUGH_NATS = 0.02  # what a further step may promise, far below the 3 nats that part two names
TRUSTED = 0.05  # share of its movement by which the record may stray from its slopes
STRAYED = 0.3
MISLED = 0.5  # noise standard deviations of the misfit that slopes may mistake
FAR_BEHIND, BEATEN_NATS = 0.05, 100.0
LONGEST = 2.0  # prior standard deviations in one step
MAX_STEPS = 25
HALVINGS = 6


@dataclass(frozen=True, eq=False)
class Descended:
    """Where it ended: ``fit`` for the outside, ``local`` to go on from."""

    fit: Fit
    local: Local


class _State:
    """A point with what is known there, whitened too."""

    def __init__(self, problem: Problem, local: Local):
        self.problem, self.measured = problem, measured_of(problem)
        self.coordinates = tuple(range(len(local.x)))
        slopes = local.slopes(self.coordinates)
        self._put(replace(local, idx=self.coordinates, columns=slopes))
        self.jacobian = whitened(problem, slopes)

    def _put(self, local: Local) -> None:
        self.local = local
        self.residual = whitened(self.problem, self.measured - local.record)

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
        misfit = np.sqrt(max(float(self.residual @ self.residual) - len(self.residual), 0.0))
        return self.local.stray < TRUSTED and self.local.stray * misfit < MISLED

    def advance(self, step: Array, record: Array) -> None:
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
        step = _step(s.jacobian, s.residual, s.local.x, low, high)
        linear, there = s.residual - s.jacobian @ step, s.local.x + step
        promised = 0.5 * (s.cost - float(linear @ linear + there @ there))
        if promised < max(ENOUGH_NATS, FAR_BEHIND * behind):
            if s.local.stray == 0.0 or s.is_trusted() or behind > BEATEN_NATS:
                converged, message = True, f"a further step promises {promised:.1g} nats"
                break
            s.refresh()
            continue
        found, tried = _try(s, step)
        evaluations += tried
        if found is None and s.local.stray == 0.0:
            message = "no step along the slopes lowers the cost"
            break
        if found is not None:
            s.advance(*found)
        if found is None or s.local.stray > STRAYED:
            s.refresh()
    fit = summary(problem, s.local.x, s.residual, s.jacobian, converged, message, evaluations)
    return Descended(fit, s.local)


def _try(s: _State, step: Array) -> tuple[tuple[Array, Array] | None, int]:
    """The step or a part of it that lowers the cost, with its record, and how many were tried."""
    halvings = HALVINGS if s.local.stray == 0.0 else 1
    for k in range(halvings):
        part = 0.5**k * step
        x = s.local.x + part
        try:
            record = record_at(s.problem, x)
        except DiffsimError:  # cannot be simulated: a shorter step
            continue
        r = whitened(s.problem, s.measured - record)
        if float(r @ r + x @ x) < s.cost:
            return (part, record), k + 1
    return None, halvings


def _step(jacobian: Array, residual: Array, x: Array, low: Array, high: Array) -> Array:
    """argmin |r - J d|^2 + |x + d|^2 within the bounds, no coordinate moving further than
    ``LONGEST``."""
    if not len(x):
        return np.zeros(0)
    root = linalg.cholesky(jacobian.T @ jacobian + np.eye(len(x)))
    right = linalg.solve_triangular(root, jacobian.T @ residual - x, trans="T")
    step = linalg.solve_triangular(root, right)
    least, most = np.maximum(low - x, -LONGEST), np.minimum(high - x, LONGEST)
    if (step < least).any() or (step > most).any():
        step = optimize.lsq_linear(root, right, (least, most), method="bvls").x
    return np.asarray(step)
