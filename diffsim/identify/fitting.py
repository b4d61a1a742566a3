"""Fit parameters, and sizes of effects, to recorded runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy import linalg, optimize
from torch import Tensor

from diffsim import optim
from diffsim.core.arrays import Array
from diffsim.core.check import require_choice
from diffsim.core.checked import checked
from diffsim.core.errors import DiffsimError
from diffsim.core.memo import Aside
from diffsim.core.record import Ended, Solve, announce, is_recording
from diffsim.identify.gaussian import Gaussian
from diffsim.identify.jacobian import Jacobian
from diffsim.identify.model import Parameter
from diffsim.identify.problem import Problem
from diffsim.identify.whitening import MIN_SPARSE, SPARSE_ROWS, Whitener, WhiteNoise

if TYPE_CHECKING:
    from diffsim.data.study import Channel, Run
    from diffsim.identify.effect import Effect
    from diffsim.identify.model import SimModel
    from diffsim.identify.numerics import Numerics

METHODS = ("gauss_newton", "lbfgs")
QR_ROWS = 2048  # rows factored at a time: of a hundred columns, what an L2 cache holds


@checked(kinds_only=True)
@dataclass(frozen=True, eq=False)
class Fit:
    """The most probable parameters and what is known of them.

    Attributes:
        problem: Runs, model and noise that were fitted.
        x: Most probable standardized coordinates, (n,).
        values: Most probable values by name, each in its unit.
        sd: Posterior standard deviation by name, [unit], from (A'A + 1)^-1 with prior.
        correlation: (n, n) posterior, in the order of ``values``.
        chi2: Whitened misfit |W (y - S)|^2 at the most probable parameters.
        prior: Distance from the prior's center, |x|^2.
        num_samples: Number of measured samples that were fitted.
        at_bound: Names on a bound; their sd says nothing.
        undetermined: Names whose posterior sd is above 0.9 of the prior's: the data hardly
            determine them.
        ended: Why the search ended, in the words of ``diffsim.Solve``.
        message: The solver's reason to stop.
        num_evaluations: Residual evaluations of all runs, those for derivatives not counted.
        residual: (num_samples,) whitened, at x.
        jacobian: (num_samples, n) d(W S)/dx at x.
    """

    problem: Problem
    x: Array
    values: Mapping[str, float]
    sd: Mapping[str, float]
    correlation: Array
    chi2: float
    prior: float
    num_samples: int
    at_bound: tuple[str, ...]
    undetermined: tuple[str, ...]
    ended: Ended
    message: str
    num_evaluations: int
    residual: Array
    jacobian: Aside = Aside()

    @property
    def converged(self) -> bool:
        """Whether the solver's tolerance was met."""
        return self.ended == "converged"

    @property
    def solve(self) -> Solve:
        """Why the search ended; the residual is the norm of the gradient of half the objective.

        Components of the gradient that push against a bound do not count.
        """
        low, high = self.problem.bounds
        slope = self.x - self.jacobian.T @ self.residual
        held = ((self.x <= low) & (slope > 0.0)) | ((self.x >= high) & (slope < 0.0))
        return Solve(
            solver="fit",
            ended=(self.ended,),
            residual=(float(np.linalg.norm(np.where(held, 0.0, slope))),),
            tolerance=(math.nan,),
            num_iters=(self.num_evaluations,),
            unit="nats",
            details=self.message,
        )

    @cached_property
    def nats(self) -> float:
        """Laplace evidence of all that was fitted, by the slopes at x."""
        return Gaussian.of(self.jacobian, self.residual, self.x).nats

    @cached_property
    def covariance(self) -> Array:
        """(n, n) posterior covariance of the standardized coordinates; not to be written to."""
        return posterior_covariance(self.jacobian)


@checked
def fit(
    model: SimModel,
    runs: Sequence[Run],
    channels: Sequence[Channel],
    *,
    effects: Sequence[Effect] = (),
    method: str = "gauss_newton",
    start: Array | None = None,
    whitener: Whitener | None = None,
    jacobian: Jacobian | None = None,
    gradient: str = "differences",
    workers: int = 1,
    max_evaluations: int = 40,
    numerics: Numerics | None = None,
) -> Fit:
    """Most probable parameters: the minimum of |W (y - S(x))|^2 + |x|^2 within the bounds.

    Args:
        model: Simulator with base parameters; nuisances of one run are called "name@run".
        runs: Recorded runs, all used at once; repeats stay separate.
        channels: Channels of the runs; their ``sd`` is the noise unless ``whitener`` is given.
        effects: Effects whose sizes are fitted too.
        method: "gauss_newton" (scipy's dogleg within bounds) or "lbfgs".
        start: (n,) standardized coordinates; the prior's center if None.
        whitener: Whitening of colored noise; None: white noise with the channels' ``sd``.
        jacobian: Method and step of the derivatives; None: the defaults of ``Jacobian``.
        gradient: Source of the gradient for "lbfgs": "differences", or "autograd" where the scene
            is differentiable.
        workers: Number of threads over runs.
        max_evaluations: Largest number of evaluations of the residual.
        numerics: Factors on time step, mesh and tolerance; None: the model's own.

    Returns:
        ``Fit``; look at ``converged``.
    """
    require_choice("method", method, METHODS)
    require_choice("gradient", gradient, ("differences", "autograd"))
    if not runs:
        raise ValueError("runs is empty; a fit needs at least one recorded run")
    problem = Problem(
        model,
        tuple(runs),
        whitener or WhiteNoise(channels),
        tuple(effects),
        jacobian or Jacobian(),
        numerics,
        workers,
    )
    n = len(problem.names)
    x0 = np.zeros(n) if start is None else np.array(start, dtype=np.float64)
    if x0.shape != (n,):
        raise ValueError(f"start must have shape ({n},), got {x0.shape}")
    solve = _gauss_newton if method == "gauss_newton" else _lbfgs
    latest = _Latest(problem)
    minimum = solve(latest, x0, max_evaluations, gradient)
    residual, slopes = latest.linearize(minimum.x)
    message = minimum.message
    if latest.num_failed:
        message += f"; {latest.num_failed} trial points could not be simulated"
    return summary(
        problem, minimum.x, residual, slopes, minimum.ended, message, minimum.num_evaluations
    )


@dataclass(frozen=True, eq=False)
class _Minimum:
    """End of a solver; fields as of ``Fit``."""

    x: Array
    ended: Ended
    message: str
    num_evaluations: int


def summary(
    problem: Problem,
    x: Array,
    residual: Array,
    jacobian: Array,
    ended: Ended,
    message: str,
    num_evaluations: int,
) -> Fit:
    """``Fit`` at coordinates x: uncertainties from the Gauss-Newton matrix there."""
    covariance = posterior_covariance(jacobian)
    sd_x = np.sqrt(np.diag(covariance))
    low, high = problem.bounds
    names = problem.names
    fit = Fit(
        problem=problem,
        x=x,
        values=_values(problem, x),
        sd=dict(zip(names, _scales(problem, x) * sd_x, strict=True)),
        correlation=covariance / np.outer(sd_x, sd_x),
        chi2=float(residual @ residual),
        prior=float(x @ x),
        num_samples=len(residual),
        at_bound=tuple(
            n for n, v, a, b in zip(names, x, low, high, strict=True) if v <= a or v >= b
        ),
        undetermined=tuple(n for n, s in zip(names, sd_x, strict=True) if s > 0.9),
        ended=ended,
        message=message,
        num_evaluations=num_evaluations,
        residual=residual,
        jacobian=jacobian,
    )
    if is_recording():
        announce(fit.solve)
    return fit


def posterior_covariance(jacobian: Array) -> Array:
    """Posterior covariance (A'A + 1)^-1 of the standardized coordinates.

    From the triangular factor of [A; 1], large rows first, so that slopes of many decades leave no
    negative variance (Cox and Higham, BIT 38 (1998) 34); by blocks that a cache holds, then of
    their triangles (Demmel et al., SIAM J. Sci. Comput. 34 (2012) A206).
    """
    n = jacobian.shape[1]
    if not n:
        return np.zeros((0, 0))
    largest, few = np.abs(jacobian).max(axis=1), n < MIN_SPARSE
    # of many coordinates rows that stand together have zeros together
    order = np.argsort(-largest, kind="stable") if few else np.arange(len(jacobian))
    count, triangles = QR_ROWS if few else SPARSE_ROWS, list[Array]()
    for k in range(0, len(order), count):
        block = order[k : k + count]
        block = block[np.argsort(-largest[block], kind="stable")]
        used = jacobian[block].any(0) | few
        factor = np.linalg.qr(jacobian[np.ix_(block, used)], mode="r")
        triangles.append(np.zeros((len(factor), n)))
        triangles[-1][:, used] = factor
    rows = np.vstack([*triangles, np.eye(n)])
    order = np.argsort(-np.abs(rows).max(axis=1), kind="stable")
    root = np.linalg.qr(rows[order], mode="r")[:n]
    inverse = linalg.solve_triangular(root, np.eye(n))
    return np.asarray(inverse @ inverse.T)


class _Latest:
    """Linearizations of a problem, the latest kept: solvers ask for the same point twice."""

    def __init__(self, problem: Problem):
        self.problem, self.at = problem, np.zeros(0)
        self.kept: tuple[Array, Array] | None = None
        self.num_failed = 0

    def linearize(self, x: Array) -> tuple[Array, Array]:
        if self.kept is None or not np.array_equal(x, self.at):
            self.at, self.kept = x.copy(), self.problem.linearize(x)
        return self.kept

    def residual(self, x: Array) -> Array:
        """Where the simulation of a trial point fails: so large that the solver turns back."""
        if self.kept is None:
            return self.linearize(x)[0]  # the start must be possible
        try:
            return self._residual(x)
        except DiffsimError:
            self.num_failed += 1
            # noise sd per sample: farther off than any model
            return np.full(len(self.kept[0]), 1e8)

    def _residual(self, x: Array) -> Array:
        # a batched model makes the whole stencil at about the price of one point
        if self.problem.model.batched or (self.kept is not None and np.array_equal(x, self.at)):
            return self.linearize(x)[0]
        return self.problem.residual(x)


def _gauss_newton(latest: _Latest, x0: Array, max_evaluations: int, _: str) -> _Minimum:
    low, high = latest.problem.bounds
    if not len(x0):
        return _Minimum(x0, "converged", "nothing to fit", 0)
    n = len(x0)
    minimum = optimize.least_squares(
        lambda x: np.concatenate([latest.residual(x), x]),
        np.clip(x0, low, high),
        jac=lambda x: np.vstack([-latest.linearize(x)[1], np.eye(n)]),
        bounds=(low, high),
        method="dogbox",  # may rest on a bound, where trf only creeps towards it
        ftol=1e-7,  # of a cost of about N / 2 nats: far below the 0.1 nat that would matter
        xtol=1e-6,
        gtol=1e-6,
        max_nfev=max_evaluations,
    )
    ended: Ended = "converged" if minimum.success else "failed"
    if minimum.status == 0:
        ended = "budget"
    return _Minimum(minimum.x, ended, str(minimum.message), int(minimum.nfev))


def _lbfgs(latest: _Latest, x0: Array, max_evaluations: int, gradient: str) -> _Minimum:
    problem = latest.problem
    if not len(x0):
        return _Minimum(x0, "converged", "nothing to fit", 0)

    def cost(x: Array) -> tuple[float, Array]:
        if gradient == "autograd":
            value, slope = problem.gradient(x)
        else:
            r, a = problem.linearize(x)
            value, slope = 0.5 * float(r @ r), -a.T @ r
        return value + 0.5 * float(x @ x), slope + x

    minimum = optim.minimize(
        cost,
        x0,
        problem.bounds,
        optim.Options(
            budget=optim.Budget(max_evaluations, finish_line_search=True),
            tolerances=optim.Tolerances(ftol=1e-10, gtol=1e-6),
        ),
    )
    latest.num_failed = minimum.num_failed
    return _Minimum(minimum.final.x, minimum.ended, minimum.message, minimum.num_evaluations)


def _values(problem: Problem, x: Array) -> dict[str, float]:
    base = [float(p.value_at(torch.tensor(q, dtype=torch.float64))) for p, q in _base(problem, x)]
    sizes = problem.size_units * problem.scaled(x)[problem.num_base :]
    return dict(zip(problem.names, [*base, *sizes.tolist()], strict=True))


def _scales(problem: Problem, x: Array) -> Array:
    """Derivative of each value by its standardized coordinate."""
    base = [p.value * np.exp(p.sd * q) * p.sd if p.log else p.sd for p, q in _base(problem, x)]
    return np.array([*base, *(problem.size_units * problem.stretch(x)[problem.num_base :])])


def _base(problem: Problem, x: Array) -> list[tuple[Parameter, float]]:
    return list(zip(problem.model.base, x[: problem.num_base].tolist(), strict=True))


def correlated(
    unit: Tensor, names: Sequence[str], correlation_of: Callable[[str, str], float]
) -> Tensor:
    """Standard normals with the correlations of some numbers, (count, num_names).

    Args:
        unit: Independent standard normals, (count, num_names).
        correlation_of: Function of two names.
    """
    rows = [[correlation_of(a, b) for b in names] for a in names]
    correlation = torch.tensor(rows, dtype=torch.float64).reshape(len(names), len(names))
    spread, turns = torch.linalg.eigh(correlation)
    return (unit * spread.clamp(min=0.0).sqrt()) @ turns.mT
