"""Slopes along what the data hardly tell, where differences of simulations claim that they do.

Where friction sticks or a contact opens, a record is smooth in pieces, and a difference is wrong by
a percent of itself. Along most directions that is nothing. But let all masses, gains and frictions
be a tenth larger: the record stays as it is, their slopes cancel, and a percent of each is left.
Read as information, it makes an interval several times too narrow and pulls the fit. So the record
is moved along such directions themselves, by as far as they are uncertain.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import linalg

from diffsim.core.arrays import Array
from diffsim.identify import Problem
from diffsim.identify.effort import FIT_NATS
from diffsim.identify.gaussian import Gaussian
from diffsim.identify.linearization import Linearization, linearization_at, records_at

WEAK = 0.05  # of the strongest direction: below it an error of a percent or two is a good part
CLAIMED = 0.1  # share of a direction's information that its slopes claim, the prior has the rest
WRONG = 0.25  # noise sd, by which slopes may miss what one posterior sd moves
SHARES = (1.0, 0.5, 0.25, 0.125)  # of a step along weak directions, that are tried
ROUNDS = 3  # after the first, weak directions are those of better slopes
STEP, LEAST_STEP = 0.3, 0.1  # posterior sd; at one, smooth records bend; below, slopes stay


def mended(problem: Problem, at: Linearization) -> Linearization:
    """A linearization whose slopes along weak directions are those of steps along them.

    Args:
        problem: Model, runs, noise and effects that are fitted.
        at: Record with the slopes of all coordinates, ``problem``'s.

    Returns:
        The same object where its slopes are right already.
    """
    for _ in range(ROUNDS):
        change = _change(problem, at)
        if not change.any():
            break
        at = replace(at, columns=at.columns + change)
    return at


def descended(problem: Problem, at: Linearization) -> Linearization:
    """Where a fit gets by steps along weak directions alone, by slopes that are right along them.

    With all others, whose slopes edges make wrong, a step may be too long to be taken: a fit stays
    far from its data sheets for nothing.

    Args:
        problem: Model, runs, noise and effects that are fitted.
        at: As of ``mended``.

    Returns:
        The linearization there, mended; the same object where slopes are right.
    """
    for _ in range(ROUNDS):
        better = mended(problem, at)
        if better is at:
            break
        lower = _lower(problem, better)
        if lower is None:
            return better
        at = linearization_at(problem, lower)
    return mended(problem, at)


def stepped(problem: Problem, at: Linearization) -> Array | None:
    """Where slopes that are right along weak directions lead, (n,); None: nothing is promised.

    Valleys are curved: the point may cost more until a fit from there has come back to the bottom.

    Args:
        problem: Model, runs, noise and effects that are fitted.
        at: As of ``mended``, with slopes that are right.
    """
    step, promised, _ = _weak_step(problem, at)
    return None if promised < FIT_NATS else np.clip(at.x + step, *problem.bounds)


def _weak_step(problem: Problem, at: Linearization) -> tuple[Array, float, Array]:
    """The step along weak directions by slopes, (n,), the nats that it promises, the residual."""
    residual = problem.residual_of(at.record)
    slopes = problem.whiten_all(at.columns) * problem.stretch(at.x)
    _, strength, axes = linalg.svd(slopes, full_matrices=False)
    weak = axes[strength < WEAK * strength.max(initial=0.0)]
    ahead = slopes @ weak.T
    along = Gaussian.of(ahead, residual, weak @ at.x)
    return weak.T @ along.mean, 0.5 * float(along.slope @ along.mean), residual


def _lower(problem: Problem, at: Linearization) -> Array | None:
    """A point of less cost along weak directions, (n,); None: nothing is to be had there."""
    step, promised, residual = _weak_step(problem, at)
    if promised < FIT_NATS:
        return None
    points = np.clip(at.x + np.outer(SHARES, step), *problem.bounds)
    left = problem.whiten_all((records_at(problem, points) - at.record).T).T
    costs = ((residual - left) ** 2).sum(1) + (points**2).sum(1)
    here = float(residual @ residual + at.x @ at.x)
    best = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
    return points[best] if costs[best] < here - 2.0 * FIT_NATS else None


def _change(problem: Problem, at: Linearization) -> Array:
    """What slopes lack along weak directions, (N, n); those along all others, orthogonal, stay."""
    stretch = problem.stretch(at.x)
    _, strength, axes = linalg.svd(problem.whiten_all(at.columns) * stretch, full_matrices=False)
    told = strength**2 / (1.0 + strength**2)
    weak = (told > CLAIMED) & (strength < WEAK * strength.max(initial=0.0))
    sd = 1.0 / np.sqrt(1.0 + strength[weak] ** 2)
    steps = stretch * axes[weak] * sd[:, None]  # one posterior sd each, in scaled coordinates
    share = STEP * _within_bounds(problem, at.x, STEP * steps)
    here, moved = problem.scaled(at.x), share[:, None] * steps
    points = [problem.standardized(u) for u in (*(here + moved), *(here - moved))]
    out = np.zeros_like(at.columns)
    if not points:
        return out
    ahead, behind = np.split(records_at(problem, np.array(points)), 2)
    for k, step in enumerate(steps):
        off = 0.5 * (ahead[k] - behind[k]) / max(share[k], LEAST_STEP) - at.columns @ step
        is_known = share[k] >= LEAST_STEP and bool(np.isfinite(off).all())
        if is_known and np.linalg.norm(problem.whiten_all(off)) > WRONG:
            out += np.outer(off, axes[weak][k] / (sd[k] * stretch))
    return out


def _within_bounds(problem: Problem, x: Array, steps: Array) -> Array:
    """Share of each step, (num_steps, n), that bounds allow both ways, (num_steps,)."""
    low, high = problem.bounds
    room = np.minimum(x - low, high - x)[None]  # of sizes bounds are the same in both coordinates
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.where(steps != 0.0, room / np.abs(steps), np.inf)
    return np.asarray(np.clip(shares.min(axis=1), 0.0, 1.0))
