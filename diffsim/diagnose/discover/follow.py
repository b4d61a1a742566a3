"""A simulation that follows the recordings, driven by whatever is missing.

What a law depends on must be told along the way that was really gone: a torque that repeats with
the angle is not seen along an angle that has run away. So a free course enters wherever something
can push, run by run, until the simulation lies on the record. All slopes are taken there. Taking
the course's own part out again gives the record as the model without it would miss it, and that is
what laws are weighed by. The course is a detour: its size and its smoothness tell nothing.

Where what is missing is no push at all, such as friction that no state feels, a course would bend
the way to make up for it: the best law then keeps little of what its slopes promise, and laws are
weighed along the simulation as fitted, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from diffsim.core.arrays import Array, IntArray
from diffsim.core.errors import DiffsimError
from diffsim.core.memo import Aside
from diffsim.data.study import Run
from diffsim.identify import Fit, Problem
from diffsim.identify.effect import PRIOR_WIDTH, Effect
from diffsim.identify.gaussian import Gaussian
from diffsim.identify.law import Entry, Gains, Variable
from diffsim.identify.linearization import linearization_at
from diffsim.identify.setup import LawPort

MOST_KNOTS = 300  # of a run's course, over all its entries
COURSE = "course"  # family of what drives a simulation along a recording
LAST_STEP_SHARE = 0.01  # of the misfit, that a last step takes away


@dataclass(frozen=True, eq=False)
class Blocks:
    """A matrix of dense blocks; no two share a row or a column."""

    parts: tuple[tuple[IntArray, IntArray, Array], ...]  # rows, columns and entries of each
    shape: tuple[int, int]  # of the matrix

    @property
    def T(self) -> Blocks:
        """The transposed matrix."""
        return Blocks(tuple((c, r, b.T) for r, c, b in self.parts), self.shape[::-1])

    def __matmul__(self, other: Array) -> Array:
        out = np.zeros((self.shape[0], *other.shape[1:]))
        for rows, columns, block in self.parts:
            out[rows] = block @ other[columns]
        return out


@dataclass(frozen=True, eq=False)
class ReachInRun:
    """What terms at an entry do in one run: ``basis @ mixed @ spread @ terms``."""

    mixed: Array | sparse.csr_array | Blocks  # their coordinates of what is spread, (k, m)
    # from samples to knots, or to the readings that an entry changes at once, (m, num_samples)
    spread: sparse.csr_array
    # orthonormal columns that span it, (num_valid, k): few knots move many readings
    basis: Aside = Aside()


@dataclass(frozen=True)
class Reach:
    """What terms at an entry do to the whitened record; nothing is simulated."""

    runs: tuple[ReachInRun, ...]

    def columns(self, terms: Sequence[Array]) -> Array:
        """Whitened response, (num_valid, num_terms).

        Args:
            terms: Terms at the samples of each run, (num_samples, num_terms).
        """
        each = zip(self.runs, terms, strict=True)
        return np.concatenate([run.basis @ (run.mixed @ (run.spread @ t)) for run, t in each])

    def coordinates(self, terms: Sequence[Array]) -> Array:
        """The same by coordinates of the bases, (num_coordinates, num_terms)."""
        each = zip(self.runs, terms, strict=True)
        return np.concatenate([run.mixed @ (run.spread @ t) for run, t in each])

    def seen(self, rows: Array) -> Array:
        """Coordinates of what the bases see of whitened rows, (num_coordinates, ...)."""
        parts = np.split(rows, np.cumsum([run.basis.shape[0] for run in self.runs])[:-1])
        each = zip(self.runs, parts, strict=True)
        return np.concatenate([run.basis.T @ part for run, part in each])


@dataclass(frozen=True)
class JointReach:
    """What one law at several alike entries does; a variable may be another one at each.

    Attributes:
        parts: What terms at each entry do.
    """

    parts: tuple[Reach, ...]

    @property
    def runs(self) -> tuple[ReachInRun, ...]:
        """Those of the first entry."""
        return self.parts[0].runs

    def columns(self, terms: Sequence[Array]) -> Array:
        """Whitened response, (num_valid, num_terms).

        Args:
            terms: Terms at the samples of each run, the same at all entries or those of one entry
                below those of the other.
        """
        out = []
        for k, reach in enumerate(self.parts):
            own = []
            for run, every in zip(reach.runs, terms, strict=True):
                count = run.spread.shape[1]
                own.append(every if len(every) == count else every[k * count : (k + 1) * count])
            out.append(reach.columns(own))
        return np.asarray(sum(out[1:], out[0]))


def _reach_of(
    problem: Problem, gains: Gains, responses: Array, to_knots: sparse.csr_array
) -> ReachInRun:
    """What terms at an entry do in a run.

    Args:
        problem: Of that run, with the course that drives it.
        gains: What a unit at the entry does there.
        responses: Whitened response to each knot of each course, (num_valid, num_courses * K).
        to_knots: What makes of values at samples a course, (K, num_samples).
    """
    num_samples, num_channels = gains.readings.shape
    rows = np.arange(num_samples * num_channels)
    at_once = sparse.csr_array(
        (gains.readings.ravel(), (rows, rows // num_channels)), shape=(len(rows), num_samples)
    )
    at_once.eliminate_zeros()
    if gains.left is not None:
        at_once = gains.left(at_once)
    read = sparse.csr_array(problem.whitener.matrix(problem.runs[0]) @ at_once)
    driven = [k for k, rate in enumerate(gains.rates.T) if rate.any()]
    num_knots = to_knots.shape[0]
    led = [np.arange(k * num_knots, (k + 1) * num_knots) for k in driven]
    knots = [to_knots @ sparse.diags_array(gains.rates[:, k]) for k in driven]
    if not driven:
        return _read_at_once(read)
    spread = sparse.csr_array(sparse.vstack(knots))
    course = responses[:, np.concatenate(led)]
    if not read.nnz:
        basis, mixed = np.linalg.qr(course)
        return ReachInRun(mixed, spread, basis)
    # both at once: the readings themselves are the coordinates
    every = sparse.eye_array(read.shape[0], format="csr")
    both = sparse.csr_array(sparse.vstack([spread, read]))
    return ReachInRun(sparse.csr_array(sparse.hstack([course, every])), both, every)


def _read_at_once(read: sparse.csr_array) -> ReachInRun:
    """What terms do that only readings feel, (num_valid, num_samples)."""
    gram = sparse.coo_array(read.T @ read)
    if (gram.row == gram.col).all():  # noise is white: samples do not mix
        size = np.sqrt(gram.diagonal())
        felt = np.flatnonzero(size)
        scale = sparse.diags_array(size[felt], format="csr")
        basis = sparse.csr_array(read[:, felt] @ sparse.diags_array(1.0 / size[felt]))
        return ReachInRun(scale, sparse.eye_array(len(size), format="csr")[felt], basis)
    if (windows := _read_in_windows(read)) is not None:
        return windows
    moved = np.flatnonzero(np.diff(read.indptr))
    count, shape = len(moved), (read.shape[0], len(moved))
    basis = sparse.csr_array((np.ones(count), (moved, np.arange(count))), shape=shape)
    return ReachInRun(sparse.eye_array(count, format="csr"), read[moved], basis)


def _read_in_windows(read: sparse.csr_array) -> ReachInRun | None:
    """The same where samples mix within short windows, whose start states are fitted to the record:
    a window has fewer samples than readings that they move; None where they mix farther."""
    moves = abs(read)
    moves.eliminate_zeros()
    _, label = sparse.csgraph.connected_components(moves.T @ moves, directed=False)
    if np.bincount(label).max(initial=0) > MOST_KNOTS:
        return None
    by_sample, count = sparse.csc_array(moves), 0
    parts: list[tuple[IntArray, IntArray, Array]] = []
    mixed: list[tuple[IntArray, IntArray, Array]] = []
    for samples in np.split(np.argsort(label, kind="stable"), np.cumsum(np.bincount(label))[:-1]):
        rows = np.unique(by_sample[:, samples].indices)
        if len(rows):
            basis, of_samples = np.linalg.qr(read[rows][:, samples].toarray())
            at = np.arange(count, count := count + len(of_samples))
            parts.append((rows, at, basis))
            mixed.append((at, samples, of_samples))
    every = sparse.eye_array(read.shape[1], format="csr")
    basis_of_all = Blocks(tuple(parts), (read.shape[0], count))
    return ReachInRun(Blocks(tuple(mixed), (count, read.shape[1])), every, basis_of_all)


@dataclass(frozen=True, eq=False)
class FollowedRecord:
    """Simulations that lie on the recordings, and what the model without a course misses there."""

    fit: Fit  # fit that they start from
    problems: tuple[Problem, ...]  # one for each run, with the course that drives it
    points: tuple[Array, ...]  # standardized coordinates of each, the course's own included
    missing: Array  # whitened record less what the model without a course would show, (num_valid,)
    # whitened response to each knot of each run's courses [per unit], (num_valid of the run,
    # num_courses * num_knots)
    responses: tuple[Array, ...]
    # what makes of values at samples a course, for each run, (num_knots, num_samples)
    to_knots: tuple[sparse.csr_array, ...]
    jacobian: Array  # whitened slopes by the coordinates of the fit, (num_valid, n)
    chi2: float  # misfit with the course

    def reach(self, port: LawPort, entry: Entry) -> Reach | JointReach | None:
        """What terms at an entry do; None where they must be simulated."""
        parts = [self.reach(port, part) for part in entry.parts]
        if parts:
            known = tuple(part for part in parts if isinstance(part, Reach))
            return JointReach(known) if len(known) == len(parts) else None
        out = []
        for k, (problem, x) in enumerate(zip(self.problems, self.points, strict=True)):
            found = port.gains(problem, x, entry)
            if found is None:
                return None
            out.append(_reach_of(problem, found, self.responses[k], self.to_knots[k]))
        return Reach(tuple(out))

    def simulated(self, effect: Effect) -> Array:
        """Whitened response to the components of an effect, (num_valid, num_components) [per
        unit]: a tangent for each, a chord where it has a kink."""
        unit, parts = PRIOR_WIDTH * effect.typical, []
        for problem, x in zip(self.problems, self.points, strict=True):
            wide = replace(problem, effects=(*problem.effects, effect))
            own = list(range(len(x), len(x) + len(effect.components)))
            start = np.concatenate([x, np.zeros(len(own))])
            at = linearization_at(wide, start, own, screen=True)
            parts.append(problem.whiten_all(at.columns) / unit)
        return np.concatenate(parts)

    def courses(self, port: LawPort, variables: Sequence[Variable]) -> list[Array]:
        """Variables along the recordings, (num_samples, num_variables) for each run."""
        out = []
        for problem, x in zip(self.problems, self.points, strict=True):
            out += port.courses(problem, x, variables)
        return out


def _to_knots(problem: Problem) -> sparse.csr_array:
    """Matrix that makes of values at samples a course of the same impulse, (K, num_samples).

    Each sample's impulse goes to the knots beside it: of what changes faster than the knots, its
    mean is left, as of what it drives.
    """
    courses, (run,) = _courses_of(problem), problem.runs
    if not courses:
        return sparse.csr_array((0, len(run.time_s)))
    seconds = run.time_s - run.time_s[0]
    knots = np.linspace(0.0, float(seconds[-1]), len(courses[0].components))
    right = np.clip(np.searchsorted(knots, seconds), 1, len(knots) - 1)
    share = np.clip((seconds - knots[right - 1]) / (knots[right] - knots[right - 1]), 0.0, 1.0)
    lasts = np.gradient(seconds)
    lasts[[0, -1]] *= 0.5
    rows, columns = np.concatenate([right - 1, right]), np.tile(np.arange(len(seconds)), 2)
    parts = np.concatenate([(1.0 - share) * lasts, share * lasts])
    made = sparse.csr_array((parts, (rows, columns)), shape=(len(knots), len(seconds)))
    return sparse.csr_array(sparse.diags_array(1.0 / np.asarray(made.sum(1)).ravel()) @ made)


def follow(fit: Fit, port: LawPort, max_steps: int = 8) -> FollowedRecord:
    """Simulations of a fit's runs that lie on the recordings.

    Args:
        fit: Fit of a set of causes.
        max_steps: Steps towards the recordings; 0: the simulations as fitted.
    """
    problems, points, missing, slopes, chi2 = [], [], [], [], 0.0
    responses = []
    for run in fit.problem.runs:
        problem, x = _drive(fit, run, port, max_steps)
        count = len(fit.x)
        at = linearization_at(problem, x)
        columns = problem.whiten_all(at.columns)
        r = problem.residual_of(at.record)
        moved = problem.scaled(x)[count:]
        problems.append(problem)
        points.append(x)
        missing.append(r + columns[:, count:] @ moved)
        # what a scaled coordinate of each knot is in units of its course
        units = [np.full(len(e.components), PRIOR_WIDTH * e.typical) for e in _courses_of(problem)]
        responses.append(columns[:, count:] / np.concatenate([*units, np.zeros(0)]))
        # by standardized coordinates, as a fit's own slopes
        slopes.append(columns[:, :count] * problem.stretch(x)[:count])
        chi2 += float(r @ r)
    return FollowedRecord(
        fit,
        tuple(problems),
        tuple(points),
        np.concatenate(missing),
        tuple(responses),
        tuple(_to_knots(problem) for problem in problems),
        np.concatenate(slopes),
        chi2,
    )


def _courses_of(problem: Problem) -> list[Effect]:
    return [e for e in problem.effects if e.family == COURSE]


def _drive(fit: Fit, run: Run, port: LawPort, max_steps: int) -> tuple[Problem, Array]:
    """A run with its course, and the coordinates at which it lies on the record."""
    plain = replace(fit.problem, runs=(run,))
    courses = tuple(port.drives(run, MOST_KNOTS))
    if not courses:
        return plain, fit.x
    problem = replace(plain, effects=(*plain.effects, *courses))
    own = [i for effect in courses for i in problem.columns_of(effect)]
    x = np.concatenate([fit.x, np.zeros(len(own))])
    cost = _cost(problem, x, own)
    for _ in range(max_steps):
        at = linearization_at(problem, x, own)
        slopes = problem.whiten_all(at.columns)
        r = problem.residual_of(at.record)
        step = Gaussian.of(slopes, r, problem.scaled(x)[own]).mean
        x, now = _shorten(problem, x, own, step, cost)
        if cost - now < LAST_STEP_SHARE * now:
            break
        cost = now
    return problem, x


def _shorten(
    problem: Problem, x: Array, own: Sequence[int], step: Array, cost: float
) -> tuple[Array, float]:
    """The farthest of a step's halves that lowers the cost; the start where none does."""
    u = problem.scaled(x)
    for k in range(6):
        tried = u.copy()
        tried[list(own)] += step * 0.5**k
        at = problem.standardized(tried)
        now = _cost(problem, at, own)
        if now < cost:
            return at, now
    return x, cost


def _cost(problem: Problem, x: Array, own: Sequence[int]) -> float:
    try:
        r = problem.residual_of(problem.record(x))
    except DiffsimError:
        return np.inf
    with np.errstate(over="ignore"):
        return float(r @ r + np.sum(problem.scaled(x)[list(own)] ** 2))
