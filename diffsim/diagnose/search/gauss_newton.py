"""Gauss-Newton with as few simulations as it can.

Steps are Gauss-Newton within a trust region, in scaled coordinates (``Problem.scaled``). Each costs
one simulation of every run: the slopes are kept by Broyden updates (Broyden 1965, "A class of
methods for solving nonlinear simultaneous equations"; of many coordinates run by run, where each
acts: Schubert 1970, "Modification of a quasi-Newton method for nonlinear equations with a sparse
Jacobian") and simulated again only where the linear prediction was too far off.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from diffsim.core.errors import DiffsimError
from diffsim.core.record import Ended
from diffsim.diagnose.search.evidence import ALONE_NATS
from diffsim.diagnose.search.optimum import optimum
from diffsim.identify import Fit, Problem
from diffsim.identify.effort import FIT_NATS, FIT_RTOL
from diffsim.identify.fitting import summary
from diffsim.identify.linearization import Linearization, linearization_at
from diffsim.identify.model import slopes_are_simulated
from diffsim.identify.whitening import MIN_SPARSE, gram_of

Array = NDArray[np.float64]
# relative error up to which the linear prediction counts as exact, and so does the distance in
# nats from the best set
SLOPE_RTOL = 0.05
# of what a set is far behind, that slopes of its shapes promise: 0.6 to 1.4 of a warming sensor and
# an elastic coupling that then lead, 0.5 and less of three others
MOST_OF_WAY = 0.55
SLOPE_ATOL = 0.5  # the same in noise standard deviations of the misfit
REFRESH_RTOL = 0.3  # relative error from which slopes are simulated again
# where each slope takes simulations of its own: of a step that kept its promise
KEPT_PROMISE = 0.75  # share of the promised nats
KEPT_RTOL = 1.0  # relative error from which slopes are simulated again
LOST_RTOL = 10.0  # relative error of a step from whose end no slopes lead back
MAX_RADIUS, MIN_RADIUS = 4.0, 1e-3  # of the trust region, in scaled coordinates
LEAST_RECORDS = 60.0  # simulations of all runs, by their weight, that any fit may take
LEAST_SLOPES = 2.0  # times all slopes, that a fit of a set may take where they are simulations
OVERSPENT = "its share of the budget was spent"
MAX_STEPS = 200  # valleys are curved: after 30 the fish tail's fit was not at its end


@dataclass(frozen=True, eq=False)
class _Iterate:
    """An iterate of the minimization."""

    problem: Problem  # fitting problem that is minimized
    at: Linearization  # linearization with the slopes of all coordinates
    residual: Array  # whitened residual, (num_valid,)
    jacobian: Array  # whitened slopes d(W S)/du by the scaled coordinates, (num_valid, n)
    radius: float = MAX_RADIUS  # radius of the trust region, in scaled coordinates
    with_shapes: bool = False  # whether shapes that were never fitted move, too

    @property
    def misfit(self) -> float:
        """chi2 above what noise alone leaves."""
        return max(float(self.residual @ self.residual) - len(self.residual), 0.0)

    @property
    def cost(self) -> float:
        """Sum of chi2 and prior, |r|^2 + |x|^2."""
        return float(self.residual @ self.residual + self.at.x @ self.at.x)

    def refreshed(self) -> _Iterate:
        """The iterate with slopes simulated here."""
        x, problem = self.at.x, self.problem
        # far from the sizes, shapes that were never fitted lead elsewhere, and cost
        held = unfitted_shapes(problem, x) & (not self.with_shapes)
        free = np.flatnonzero(~held)
        at = linearization_at(problem, x, free.tolist())
        columns = np.zeros((len(at.record), len(x)))
        columns[:, free] = at.columns
        at = replace(at, idx=tuple(range(len(x))), columns=columns)
        return replace(self, at=at, jacobian=self.problem.whiten_all(at.columns))

    def promised(self, step: Array) -> float:
        """Nats that a step gains by the slopes."""
        linear = self.residual - self.jacobian @ step
        x = self.problem.standardized(self.problem.scaled(self.at.x) + step)
        return 0.5 * (self.cost - float(linear @ linear + x @ x))

    def tried(self, step: Array) -> tuple[_Iterate, float]:
        """Take a step if it lowers the cost; the radius follows the error of the linear prediction.

        Along a curved valley records bend while the cost falls as it should: where slopes are dear,
        steps get no shorter there, and Broyden's updates serve for longer. A step that leaves the
        valley is followed by the one that leads back to it, before slopes are simulated again.

        Args:
            step: In scaled coordinates, (n,).

        Returns:
            The next iterate, and the error above which slopes are simulated again; 0: the cost is
            not lower.
        """
        longest = float((np.abs(step) / self.problem.step_factors).max())
        shorter = replace(self, radius=0.25 * longest)
        after, enough = self._advance(step), self.cost - 2.0 * KEPT_PROMISE * self.promised(step)
        if after is None:
            return shorter, 0.0
        is_dear = slopes_are_simulated(self.problem.model)
        is_lost = after.at.slope_error - self.at.slope_error > LOST_RTOL
        if is_dear and after.cost > enough and not is_lost:
            way = _step(replace(after, radius=longest), *self.problem.bounds)
            back = after._advance(way) if way.any() else None
            if back is not None and back.cost < after.cost:
                after = back
        if not after.cost < self.cost:
            return shorter, 0.0
        is_kept = is_dear and after.cost < enough
        if after.at.slope_error - self.at.slope_error > REFRESH_RTOL and not is_kept:
            return replace(after, radius=max(0.5 * longest, 0.5 * self.radius)), REFRESH_RTOL
        limit = KEPT_RTOL if is_kept else REFRESH_RTOL
        if longest > 0.9 * self.radius:
            return replace(after, radius=2.0 * longest), limit
        return after, limit

    def _advance(self, step: Array) -> _Iterate | None:
        """A step further, with Broyden's update of the slopes; None: too far to be simulated."""
        here, x = self.at, self.problem.standardized(self.problem.scaled(self.at.x) + step)
        try:
            record = self.problem.record(x)
        except DiffsimError:
            return None
        residual = self.problem.residual_of(record)
        with np.errstate(over="ignore"):  # of an unstable simulation: too far as well
            if not np.isfinite(residual @ residual):
                return None
        off = record - here.record - here.columns @ step
        white_off = self.problem.whiten_all(off)
        moved = float(linalg.norm(self.jacobian @ step))
        error = here.slope_error + float(linalg.norm(white_off)) / max(moved, 1.0)
        if len(step) < MIN_SPARSE:
            along = step / float(step @ step)
            columns = here.columns + np.outer(off, along)
            jacobian = self.jacobian + np.outer(white_off, along)
        else:  # what does not act in a run goes on not acting there
            columns, first = here.columns.copy(), 0
            for run in self.problem.runs:
                rows = slice(first, first := first + run.measured.size)
                along = np.where(columns[rows].any(0), step, 0.0)
                columns[rows] += np.outer(
                    off[rows], along / max(float(along @ along), np.finfo(float).tiny)
                )
            jacobian = self.problem.whiten_all(columns)
        at = Linearization(x, record, here.idx, columns, error)
        return replace(self, at=at, residual=residual, jacobian=jacobian)


def has_exact_slopes(at: Linearization, misfit: float) -> bool:
    """Whether the error of slopes is below tolerance, relative and for a misfit.

    Args:
        at: Where a fit ended.
        misfit: chi2 above what noise alone leaves.
    """
    return at.slope_error < SLOPE_RTOL and at.slope_error * np.sqrt(misfit) < SLOPE_ATOL


def gauss_newton(
    problem: Problem,
    start: Linearization,
    *,
    best_cost: float | None = None,
    until: float = np.inf,
) -> tuple[Fit, Linearization]:
    """The minimum of |W (y - S(x))|^2 + |x|^2 within the bounds.

    Shapes of effects that were never fitted keep their values until the sizes are known. They are
    fitted then, if their slopes promise more than a small share of the misfit, and, far
    behind the best set, more than half of the way to it.

    Args:
        problem: Model, runs, noise and effects that are fitted.
        start: Start point, with the slopes of all coordinates.
        best_cost: Half the cost of the best set so far [nats]: the further behind it, the larger
            the tolerance; None: nothing to compare with.
        until: Count of weighted steps of the model after which no further step is taken.

    Returns:
        The fit, and the linearization where it ended.

    Raises:
        DiffsimError: the slopes cannot be simulated.
    """
    s, ended, message, evaluations = iterated(problem, start, best_cost, until)
    jacobian = s.jacobian
    held = np.flatnonzero(unfitted_shapes(problem, s.at.x))
    behind = 0.0 if best_cost is None else max(0.5 * s.cost - best_cost, 0.0)
    is_outranked = SLOPE_RTOL * behind > ALONE_NATS
    is_late = problem.model.simulations.steps > until
    if len(held) and is_late and ended == "converged" and not is_outranked:  # in the sizes alone
        ended, message = "budget", OVERSPENT
    elif len(held) and not is_late:
        columns = s.at.columns.copy()
        columns[:, held] = linearization_at(problem, s.at.x, held.tolist()).columns
        sloped = _first(problem, replace(s.at, columns=columns), with_shapes=True)
        gained = sloped.promised(_step(sloped, *problem.bounds))
        jacobian = sloped.jacobian  # the sd of a shape is told by its slopes, fitted or not
        # less of a large misfit is of something else, and shapes would be bent to stand in for it;
        # far behind another set they must lead near to where that one is: a spring between masses
        # of another share than half is nowhere near at first
        enough = MOST_OF_WAY * behind if is_outranked else 0.0
        if gained > max(FIT_NATS, 0.5 * SLOPE_RTOL * s.misfit, enough):
            at = linearization_at(problem, s.at.x)
            s, ended, message, more = iterated(problem, at, best_cost, until, with_shapes=True)
            evaluations, jacobian = evaluations + more, s.jacobian
    slopes = jacobian * problem.stretch(s.at.x)
    return summary(problem, s.at.x, s.residual, slopes, ended, message, evaluations), s.at


def iterated(
    problem: Problem,
    start: Linearization,
    best_cost: float | None = None,
    until: float = np.inf,
    *,
    with_shapes: bool = False,
) -> tuple[_Iterate, Ended, str, int]:
    """The last iterate of ``gauss_newton``, how and why it ended, and the number of trial points:
    all of it but the uncertainties. Shapes that were never fitted stay, unless ``with_shapes``."""
    low, high = problem.bounds
    s, model = _first(problem, start, with_shapes=with_shapes), problem.model
    ended: Ended = "budget"
    evaluations, message = 0, f"no end after {MAX_STEPS} steps"
    # steps by the slopes that are there are cheap where slopes are not: as many as new ones cost
    last = until + (problem.cost_of_table(each=2.0) if slopes_are_simulated(model) else 0.0)
    for _ in range(MAX_STEPS):
        is_spent = model.simulations.steps > until
        if model.simulations.steps > last:
            message = OVERSPENT
            break
        behind = 0.0 if best_cost is None else max(0.5 * s.cost - best_cost, 0.0)
        step = _step(s, low, high)
        promised = s.promised(step)
        if promised < max(FIT_NATS, 0.5 * FIT_RTOL * s.misfit, SLOPE_RTOL * behind):
            # so far behind that nothing hangs on what separates two names
            is_outranked = SLOPE_RTOL * behind > ALONE_NATS
            if s.at.slope_error == 0.0 or has_exact_slopes(s.at, s.misfit) or is_outranked:
                ended, message = "converged", f"a further step promises {promised:.1g} nats"
                break
            if is_spent:
                message = OVERSPENT
                break
            s = s.refreshed()
            continue
        evaluations += 1
        s, limit = s.tried(step)
        if limit == 0.0 and s.radius < MIN_RADIUS:
            ended, message = "stalled", "no step along the slopes lowers the cost"
            break
        if s.at.slope_error > limit:
            if not is_spent:
                s = s.refreshed()
            elif limit == 0.0:
                message = OVERSPENT
                break
    return s, ended, message, evaluations


def unfitted_shapes(problem: Problem, x: Array) -> NDArray[np.bool_]:
    """Which coordinates are shapes of a problem's effects at their values beforehand.

    Args:
        problem: Problem of a set.
        x: Standardized coordinates, (n,).

    Returns:
        (n,) bool.
    """
    # those of a found law begin where it was found
    held = (effect for effect in problem.effects if effect.family != "law")
    shapes = {name for effect in held for name in effect.shapes}
    return np.array([name in shapes for name in problem.names], dtype=bool) & (x == 0.0)


def _first(problem: Problem, start: Linearization, *, with_shapes: bool = False) -> _Iterate:
    """The first iterate; slopes along shapes that were never fitted are zero, or as they are."""
    coordinates = tuple(range(len(start.x)))
    slopes = start.slopes(coordinates)
    held = unfitted_shapes(problem, start.x)
    if held.any() and not with_shapes:
        slopes = np.where(held, 0.0, slopes)
    at = replace(start, idx=coordinates, columns=slopes)
    residual = problem.residual_of(at.record)
    white = problem.whiten_all(slopes)
    return _Iterate(problem, at, residual, white, with_shapes=with_shapes)


def _step(s: _Iterate, low: Array, high: Array) -> Array:
    """argmin |r - J d|^2 + |x(u + d)|^2 within the bounds and the trust region |d_i| <= radius f_i,
    f_i below 1 for parameters that move edges."""
    u = s.problem.scaled(s.at.x)
    gram = gram_of(s.jacobian)
    is_size = np.arange(len(u)) >= s.problem.num_base
    reach = s.radius * s.problem.step_factors
    least, most = np.maximum(low, u - reach), np.minimum(high, u + reach)
    end = optimum(gram, s.jacobian.T @ s.residual + gram @ u, least, most, is_size, u)
    return np.asarray(end - u)
