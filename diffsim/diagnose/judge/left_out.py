"""Fits without a part of their runs, by linear refits around the optimum.

Leaving out a part of the rows of a fit with residual r, slopes A and scaled coordinates u leads to

    v = argmin |r_k - A_k (v - u)|^2 + |x(v)|^2     over the rows k that are kept, within bounds.

What is left out is then simulated at v, with the values that are its own fitted to it, as for
any run that no fit has seen. Only where this simulation is far from the linear prediction is the
fit repeated in full, a limited number of times.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from diffsim.core.arrays import Array, IntArray, Mask
from diffsim.core.errors import DiffsimError
from diffsim.core.figures import figure
from diffsim.data.study import TIMELESS, Run
from diffsim.diagnose.checks.gates import leaves_more
from diffsim.diagnose.checks.noise import ArWhitener
from diffsim.diagnose.judge.own_values import own_point, unmet_by
from diffsim.diagnose.search.evidence import ALONE_NATS
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.diagnose.search.optimum import optimum
from diffsim.identify import Fit, Problem
from diffsim.identify.fitting import posterior_covariance
from diffsim.identify.linearization import linearization_at
from diffsim.identify.whitening import gram_of

MAX_FOLDS = 8
MEMORY = 10.0  # a block over the time in which the noise forgets
MIN_FOLDS = 3  # runs, or blocks of one: of fewer none can be unlike the others
DETERMINED = 0.9  # posterior sd over the prior's; above, the data hardly determine a parameter


@dataclass(frozen=True, eq=False)
class Fold:
    """A part of the fitted runs that is left out together."""

    name: str  # groups or seconds that are left out
    runs: tuple[int, ...]  # indices of the runs with samples in it
    rows: Mask  # whitened rows that are left out, (num_valid,)
    is_whole: bool  # whether whole runs are left out; else blocks of time


@dataclass(frozen=True, eq=False)
class Folds:
    """Parts of the fitted runs that are left out one after the other.

    Attributes:
        parts: A row is in one part at most; in none if it alone measures a channel.
        words: How they were made, as the report says it.
    """

    parts: tuple[Fold, ...]
    words: str


def folds_of(fit: Fit) -> Folds | None:
    """Parts of the runs for cross-validation: groups, at most 8 parts; else blocks of time.

    Blocks, where all runs repeat one command, or where half of the parameters or more are known
    from one group each, such as a stiffness per material: what leaves with a group is not told by
    the others.

    Returns:
        None where there are neither two groups nor three blocks.
    """
    groups = groups_of(fit.problem)
    if groups is not None:
        alone = known_alone(fit, groups)
        if not len(alone) or np.mean(alone) < 0.5:
            return groups
    return blocks_of(fit.problem) or groups


def known_alone(fit: Fit, folds: Folds) -> Mask:
    """Whether a parameter that the data determine is not determined any more without one part."""
    own = determined(fit)
    lost = np.zeros(len(own), dtype=bool)
    for fold in folds.parts:
        left = posterior_covariance(fit.jacobian[~fold.rows])
        lost |= np.sqrt(np.diag(left))[own] >= DETERMINED
    return lost


def determined(fit: Fit) -> list[int]:
    """Coordinates that all runs share and that the data determine."""
    sd = np.sqrt(np.diag(fit.covariance))
    return [i for i, n in enumerate(fit.problem.names) if "@" not in n and sd[i] < DETERMINED]


def groups_of(problem: Problem) -> Folds | None:
    """Groups of runs, at most 8 parts; None where there is only one that can be left out."""
    groups: dict[str, list[int]] = {}
    for i, run in enumerate(problem.runs):
        groups.setdefault(run.group, []).append(i)
    names = [name for name in groups if not _has_channel_alone(problem, groups, name)]
    if len(names) < 2:
        return None
    row_run = _run_of_rows(problem)
    count = min(len(names), MAX_FOLDS)
    parts = [names[k::count] for k in range(count)]
    made = [(p, tuple(i for name in p for i in groups[name])) for p in parts]
    folds = tuple(
        Fold(", ".join(p), runs, np.isin(row_run, runs), is_whole=True) for p, runs in made
    )
    what = "one command" if count == len(names) else f"{count} parts of the commands"
    return Folds(folds, f"leaving out {what} after the other among the fit runs")


def _has_channel_alone(problem: Problem, groups: dict[str, list[int]], name: str) -> bool:
    """Whether a group measures what no other does, such as points of a camera's calibration."""
    seen = {
        group: np.any([np.isfinite(problem.runs[i].measured).any(axis=0) for i in own], axis=0)
        for group, own in groups.items()
    }
    others = [has for group, has in seen.items() if group != name]
    return bool((seen[name] & ~np.any(others, axis=0)).any()) if others else False


def blocks_of(problem: Problem) -> Folds | None:
    """Blocks of time of all runs at once; None where they are too short for three.

    A block is ten times as long as the noise remembers, an eighth of the longest run or more, and
    no shorter than a sample.
    Runs without time, such as points of a camera's calibration, stay.
    """
    row_run = _run_of_rows(problem)
    time = np.concatenate([time_of_rows(problem, run) - run.time_s[0] for run in problem.runs])
    stay = [i for i, run in enumerate(problem.runs) if run.setup.get(TIMELESS)]
    is_cut = ~np.isin(row_run, stay)
    longest = float(time[is_cut].max()) if is_cut.any() else 0.0
    cut = replace(problem, runs=tuple(r for i, r in enumerate(problem.runs) if i not in stay))
    steps = [float(np.median(np.diff(r.time_s))) for r in cut.runs if len(r.time_s) > 1]
    block_s = max(longest / MAX_FOLDS, MEMORY * memory_s(cut), max(steps, default=0.0))
    count = int(longest / block_s) if block_s > 0.0 else 0
    if count < MIN_FOLDS:
        return None
    label = np.minimum((time / longest * count).astype(np.int64), count - 1)
    label[~is_cut] = -1
    folds = []
    for k in range(count):
        rows = label == k
        runs = tuple(int(i) for i in np.unique(row_run[rows]))
        ends = (k * longest / count, (k + 1) * longest / count)
        folds.append(Fold(f"{figure(ends[0])} to {figure(ends[1])} s", runs, rows, is_whole=False))
    words = f"leaving out blocks of {figure(longest / count, 2)} s after each other"
    return Folds(tuple(f for f in folds if f.rows.any()), words)


def memory_s(problem: Problem) -> float:
    """Time in which the noise forgets: until its autocorrelation is below 5 % [s]; 0 if white."""
    steps = [float(np.median(np.diff(r.time_s))) for r in problem.runs if len(r.time_s) > 1]
    if not isinstance(problem.whitener, ArWhitener) or not steps:
        return 0.0
    lags = 0
    for a in problem.whitener.coefficients:
        if len(a):
            # the slowest root of the recursion decides
            slowest = float(np.abs(np.roots([1.0, *-a])).max())
            if slowest < 1.0:
                lags = max(lags, int(np.ceil(np.log(0.05) / np.log(max(slowest, 1e-6)))))
    return lags * max(steps)


@dataclass
class Repeats:
    """How many fits may still be repeated in full, and the weighted steps that each may take."""

    left: int = 4
    steps: float = np.inf


def moved(fit: Fit, kept: Mask) -> Array:
    """Linear refit to some rows, in standardized coordinates, (n,)."""
    problem, u = fit.problem, fit.problem.scaled(fit.x)
    if not len(u):
        return u
    slopes = fit.jacobian[kept] / problem.stretch(fit.x)
    gram = gram_of(slopes)
    is_size = np.arange(len(u)) >= problem.num_base
    right = slopes.T @ fit.residual[kept] + gram @ u
    return problem.standardized(np.asarray(optimum(gram, right, *problem.bounds, is_size, u)))


def left_out_residual(fit: Fit, folds: Folds, repeats: Repeats) -> Array:
    """(num_valid,) whitened residuals, every part from a fit that has not seen it."""
    out = fit.residual.copy()
    for fold in folds.parts:
        out[fold.rows] = _without(fit, fold, repeats)
    return out


def _without(fit: Fit, fold: Fold, repeats: Repeats) -> Array:
    """Residual of a part that is left out."""
    problem, x = fit.problem, moved(fit, ~fold.rows)
    step = (problem.scaled(x) - problem.scaled(fit.x)) / problem.stretch(fit.x)
    predicted = fit.residual[fold.rows] - fit.jacobian[fold.rows] @ step
    try:
        found = _simulate_part(fit, fold, x)
    except DiffsimError:  # too far to be simulated: a fit of its own ends elsewhere
        found = None
    # what separates two names must not hang on how straight the model is
    worse = found is None or 0.5 * (found @ found - predicted @ predicted) > ALONE_NATS
    if worse and repeats.left > 0:
        repeats.left -= 1
        again = _refit_without(fit, fold, x, repeats.steps)
        if again is not None and (found is None or again @ again < found @ found):
            found = again
    return predicted if found is None else found


def _refit_without(fit: Fit, fold: Fold, x: Array, steps: float) -> Array | None:
    """Residual of the part after a fit to the rest, of so many weighted steps; None if that cannot
    be simulated."""
    problem = replace(fit.problem, runs=kept_runs(fit.problem, fold))
    until = problem.model.simulations.steps + steps
    try:
        rest, _ = gauss_newton(problem, linearization_at(problem, x), until=until)
        return _simulate_part(fit, fold, rest.x)
    except DiffsimError:
        return None


def run_apart(fit: Fit, steps: float = np.inf) -> dict[str, float]:
    """The run that a fit misses most, where a fit to the others leaves noise alone.

    Args:
        fit: Plain model, fitted to all of them.
        steps: Weighted steps that the fit to the others may take.

    Returns:
        How far that run then is off, over its noise, by its name; empty where the others leave more
        than noise, or where they are too few.
    """
    problem = fit.problem
    missed = [float(np.mean(r**2)) if len(r) else 0.0 for r in problem.by_run(fit.residual)]
    if len(missed) < MIN_FOLDS:
        return {}
    worst = int(np.argmax(missed))
    rows = _run_of_rows(problem) == worst
    fold = Fold(problem.runs[worst].name, (worst,), rows, is_whole=True)
    others = replace(problem, runs=kept_runs(problem, fold))
    try:
        until = problem.model.simulations.steps + steps
        start = linearization_at(others, moved(fit, ~rows))
        rest, _ = gauss_newton(others, start, until=until)
        off = _simulate_part(fit, fold, rest.x)
    except DiffsimError:  # where they end nothing can be simulated
        return {}
    return {} if leaves_more(rest) else {fold.name: float(np.sqrt(np.mean(off**2)))}


def _simulate_part(fit: Fit, fold: Fold, x: Array) -> Array:
    """Residual of a part simulated at x, the values of its own runs fitted to it."""
    rows = _run_of_rows(fit.problem)
    found = np.zeros(len(rows))
    unmet = unmet_by(replace(fit.problem, runs=kept_runs(fit.problem, fold)))
    for i in fold.runs:
        run, own = fit.problem.runs[i], rows == i
        alone = replace(fit.problem, runs=(run,))
        point, left = x, None
        if fold.is_whole:
            point, left = own_point(alone, x, run, fit.jacobian[own], unmet)
        found[own] = alone.residual(point) if left is None else left
    return np.asarray(found[fold.rows])


def kept_runs(problem: Problem, fold: Fold) -> tuple[Run, ...]:
    """Runs without what is left out; samples of a block of time count as missing."""
    if fold.is_whole:
        return tuple(r for i, r in enumerate(problem.runs) if i not in fold.runs)
    rows, out = _run_of_rows(problem), []
    for i, run in enumerate(problem.runs):
        newest = newest_samples(problem, run)[fold.rows[rows == i]]
        measured = run.measured.copy()
        measured.ravel()[newest] = np.nan
        if np.isfinite(measured).any():
            out.append(replace(run, measured=measured))
    return tuple(out)


def newest_samples(problem: Problem, run: Run) -> IntArray:
    """Sample that a whitened row belongs to: the newest that it uses, (num_valid,)."""
    matrix = problem.whitener.matrix(run)
    if not matrix.shape[0]:
        return np.zeros(0, dtype=np.int64)
    return np.asarray(np.maximum.reduceat(matrix.indices, matrix.indptr[:-1]))


def _run_of_rows(problem: Problem) -> IntArray:
    """Index of the run of every whitened row."""
    counts = [problem.whitener.matrix(run).shape[0] for run in problem.runs]
    return np.repeat(np.arange(len(counts)), counts)


def time_of_rows(problem: Problem, run: Run) -> Array:
    """Time of every whitened row, (num_valid,) [s]: of the newest sample that it uses."""
    return run.time_s[newest_samples(problem, run) // run.measured.shape[1]]
