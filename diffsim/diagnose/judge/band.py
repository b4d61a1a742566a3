"""Where readings of an unseen run are expected: a band around what the extended model predicts.

Half of its width, by reading, is

    factor * sqrt(noise^2 + posterior^2 + growth^2 (rest^2 + excess^2 posterior^2)),

    growth = times^2.

Noise is the floor of the fit; where the calmest part leaves less than half of it, what differs
there from reading to reading, for the rest of it is no noise and grows with the distance.
Posterior is what parameters and sizes change in this very run, by one standard deviation along each
principal direction. Rest is what the model leaves beyond both on parts that were not fitted: groups
of runs left out one after the other (else blocks of time), and runs with use: select. Times is how
far outside of the fitted runs the run lies, 1 inside: what a model lacks begins with its next
power, the square. Half as wide as Chebyshev's polynomial T2 of equal ripples, it holds as much.

A misfit that stays is alike over a whole run: it moves parameters farther than the posterior says,
by the factor excess beside it. Parts tell excess and rest together, as the variances that make them
most likely: those which the other runs know tell rest, those of which they hardly know the
parameters tell excess. A part whose fit has run away tells nothing.

The factor holds the share of the readings of these parts that is wanted, each part weighing the
same and with what the other parts tell: how much parts differ is in it, and no shape of what is
left is assumed. Of few parts that differ such a factor holds less of one more: it is multiplied by
what the factors of all parts but one need to hold that share of the one, on average.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.linalg import splu

from diffsim.core.arrays import Array
from diffsim.core.errors import DiffsimError
from diffsim.data.study import Channel, Run
from diffsim.diagnose.judge.gain import RAN_AWAY, LeftOut, Validation
from diffsim.diagnose.judge.left_out import Fold, Repeats, folds_of, kept_runs, newest_samples
from diffsim.diagnose.judge.own_values import (
    Frozen,
    held_out_point,
    held_out_residual,
    own_names,
    unmet_by,
)
from diffsim.diagnose.judge.records import LEVEL
from diffsim.diagnose.judge.unseen import outside_rows, spans_of, times_outside
from diffsim.identify import Fit, Problem
from diffsim.identify.effect import touches
from diffsim.identify.fitting import posterior_covariance
from diffsim.identify.gaussian import Gaussian

BELOW_NOISE = 0.5  # of the noise, left where it is stated too large: two arms leave 0.25 to 0.4,
# 46 sealed cases 0.96 or more
LEAST_PARTS = 2  # one does not tell how parts differ
GROWTH = 4.0  # power of times, of the variance of what is left: a model lacks the square first
TINY = 1e-300  # added to sums of what is asked: their ratio is 1 where nothing is


@dataclass(frozen=True, eq=False)
class Part:
    """Readings that nothing was fitted to, of a fit that has not seen them.

    Attributes:
        left: Measured minus predicted, (num_readings, num_channels) [unit of the channel]; NaN: not
            measured, or of another part.
        spread: Variance of the predicted by the posterior of that fit, of the same shape.
        times: How far outside of the runs of that fit they lie; 1: inside.
        ran_away: Whether so much more is left than by the plain model that the fit, not the model,
            tells it.
    """

    left: Array
    spread: Array
    times: float = 1.0
    ran_away: bool = False


@dataclass(frozen=True, eq=False)
class BandVariance:
    """What parts tell of an unseen run."""

    # variance of what is left beyond noise and posterior, by channel, (num_channels,); NaN:
    # measured in no part
    rest: Array
    excess: float  # what the variance by the posterior is multiplied by, to be added to it

    def variance(self, noise: Array, part: Part) -> Array:
        """Variance of what is left of a part, or of another run, as ``Part.spread``."""
        more = part.times**GROWTH * (self.rest + self.excess * part.spread)
        return np.asarray(noise**2 + part.spread + more)


@dataclass(frozen=True, eq=False)
class Band:
    """What the band of any run is made from."""

    factor: float  # half of the width over the root of the sum of variances
    num_parts: int  # parts that nothing was fitted to, which told the factor
    noise: Mapping[str, float]  # standard deviation of the noise by channel [unit of the channel]
    # standard deviation of what is left beyond it [unit of the channel]; only channels that one of
    # the parts measured
    rest: Mapping[str, float]
    excess: float  # how many times farther than their posterior says a misfit moves parameters
    names: tuple[str, ...]  # coordinates that runs share
    correlation: Array  # posterior correlation of these, (n, n)

    def to_dict(self) -> dict[str, Any]:
        """The band in types that JSON and YAML have."""
        return {
            "level": LEVEL,
            "factor": self.factor,
            "num_parts": self.num_parts,
            "noise": dict(self.noise),
            "rest": dict(self.rest),
            "excess": self.excess,
            "names": list(self.names),
            # a line per row: as lists they would be most of the file
            "correlation": [" ".join(f"{v:.6g}" for v in row) for row in self.correlation],
        }

    def half_widths(
        self,
        at: Frozen,
        sd: Array,
        run: Run,
        times: float,
        *,
        channels: Sequence[Channel],
        unmet: Collection[str],
    ) -> Array | None:
        """Half of the width in a run, (num_samples, num_channels) [unit of the channel].

        Args:
            sd: Posterior standard deviation of its standardized coordinates, (n,).
            run: Run that was not fitted; its own values are fitted to it.
            times: How far outside of the fitted runs it lies; 1: inside.
            channels: Columns of its ``measured``.
            unmet: Parameters that no fitted run has.

        Returns:
            NaN in channels of which nothing is known; None where the model cannot be simulated
            within its posterior.
        """
        try:
            spread = _posterior_variance(self.names, self.correlation, at, sd, run, unmet)
        except DiffsimError:
            return None
        noise = np.array([self.noise[c.name] for c in channels])
        rest = np.array([self.rest.get(c.name, np.nan) for c in channels])
        here = Part(run.measured, spread, times)
        variance = BandVariance(rest**2, self.excess**2).variance(noise, here)
        return np.asarray(self.factor * np.sqrt(variance))


def band_from(content: Mapping[str, Any]) -> Band:
    """The band of a file, the inverse of ``Band.to_dict``."""
    names = tuple(content["names"])
    rows = [[float(v) for v in row.split()] for row in content["correlation"]]
    return Band(
        float(content["factor"]),
        int(content["num_parts"]),
        content["noise"],
        content["rest"],
        float(content.get("excess", 0.0)),  # files of before have none
        names,
        np.array(rows).reshape(len(names), len(names)),
    )


def band_of(
    fit: Fit,
    channels: Sequence[Channel],
    noise: Array,
    select: Sequence[Run],
    validation: Validation | None = None,
    plain: Fit | None = None,
) -> Band | None:
    """The band of a fit, from parts of its runs that are left out and from select runs.

    Args:
        channels: Columns of ``measured``.
        noise: Standard deviation of the noise, (num_channels,) [unit of the channel].
        select: Runs with use: select.
        validation: What names were held against; fits without a part are not made again.
        plain: Fit without effects; None: no part is held against it.

    Returns:
        None where parts to leave out and select runs are fewer than two.
    """
    parts = settled(unfitted_parts(fit, channels, select, validation, plain))
    if len(parts) < LEAST_PARTS:
        return None
    noise = noise_of(parts, noise)
    told, factor = factor_of(parts, noise)
    rest = np.sqrt(told.rest)
    names, correlation = _posterior_of(fit)
    return Band(
        factor=factor,
        num_parts=len(parts),
        noise={c.name: float(v) for c, v in zip(channels, noise, strict=True)},
        rest={c.name: float(v) for c, v in zip(channels, rest, strict=True) if v >= 0.0},
        excess=float(np.sqrt(told.excess)),
        names=names,
        correlation=correlation,
    )


def _posterior_of(fit: Fit) -> tuple[tuple[str, ...], Array]:
    """Names of coordinates that runs share, and their posterior correlation, (n, n)."""
    names = fit.problem.names
    shared = [i for i, n in enumerate(names) if "@" not in n and n not in fit.at_bound]
    return tuple(names[i] for i in shared), fit.correlation[np.ix_(shared, shared)]


def unfitted_parts(
    fit: Fit,
    channels: Sequence[Channel],
    select: Sequence[Run],
    validation: Validation | None = None,
    plain: Fit | None = None,
) -> list[Part]:
    """Parts of its runs, and select runs, that were not fitted; arguments as of ``band_of``."""
    left_out = _left_out_parts(fit, channels, validation, plain)
    return [*left_out, *_select_parts(fit, channels, select)]


def settled(parts: Sequence[Part]) -> list[Part]:
    """Parts whose fit has not run away; all, where these are too few to tell."""
    told = [part for part in parts if not part.ran_away]
    return told if len(told) >= LEAST_PARTS else list(parts)


def factor_of(parts: Sequence[Part], noise: Array) -> tuple[BandVariance, float]:
    """What parts tell, and the band's factor.

    Args:
        parts: Two or more.
        noise: Standard deviation of the noise, (num_channels,) [unit of the channel].
    """
    together, scores = variances_of(parts, noise), []
    for k, part in enumerate(parts):
        others = variances_of([*parts[:k], *parts[k + 1 :]], noise)
        # a channel of this part alone has no others
        rest = np.where(np.isfinite(others.rest), others.rest, together.rest)
        over = np.abs(part.left) / np.sqrt(replace(others, rest=rest).variance(noise, part))
        scores.append(over[np.isfinite(over)])
    scores = [own for own in scores if len(own)]
    # of a part, over the factor that the others alone would have given it
    needed = [
        own / (_width_held([*scores[:k], *scores[k + 1 :]]) + TINY)
        for k, own in enumerate(scores)
        if len(scores) > 1
    ]
    return together, _width_held(scores) * (_width_held(needed) if needed else 1.0)


def _width_held(scores: Sequence[Array]) -> float:
    """What the wanted share of the scores is at most, each part weighing the same.

    Args:
        scores: Of one part or more, (num_readings,) each, one or more.
    """
    weights = np.concatenate([np.full(len(own), 1.0 / len(own)) for own in scores])
    every = np.concatenate(scores)
    order = np.argsort(every, kind="stable")
    share = np.cumsum(weights[order])
    k = min(int(np.searchsorted(share, LEVEL * share[-1])), len(every) - 1)
    return float(every[order[k]])


def noise_of(parts: Sequence[Part], noise: Array) -> Array:
    """The noise as stated; where that is too large, what differs from reading to reading.

    What stays of a misfit would hide in it, and not grow with the distance.

    Args:
        noise: Standard deviation as stated, (num_channels,) [unit of the channel].
    """
    calmest = np.fmin.reduce([_mean_measured(part.left**2) for part in parts])
    steps = [0.5 * _mean_measured(np.diff(part.left, axis=0) ** 2) for part in parts]
    found = np.sqrt(np.fmin(calmest, np.fmin.reduce(steps)))
    return np.where(np.sqrt(calmest) < BELOW_NOISE * noise, found, noise)


def variances_of(parts: Sequence[Part], noise: Array) -> BandVariance:
    """The variances that make what parts leave most likely, each part weighing the same.

    With mean squares m of a part and channel and v its mean variance they maximize -(log v + m / v)
    by the rounds of Zhou et al. 2019, "MM algorithms for variance components models", which raise
    it and keep them above zero. For the rest a part weighs less, the more its posterior moves it:
    what is hardly known says little of what is left of the known. Parts that do not tell the excess
    leave it where it begins, at 1.

    Args:
        noise: Standard deviation of the noise, (num_channels,) [unit of the channel].
    """
    left = np.array([_mean_measured(part.left**2) for part in parts])
    seen = np.isfinite(left)
    moved = [np.where(np.isfinite(part.left), part.spread, np.nan) for part in parts]
    spread = np.array([_mean_measured(values) for values in moved])
    left, spread = (np.where(seen, table, 0.0) for table in (left, spread))
    weight = seen / np.maximum(seen.sum(axis=1, keepdims=True), 1)
    known = 1.0 / (1.0 + np.sum(weight * spread / noise**2, axis=1, keepdims=True))
    grown = np.array([[part.times] for part in parts]) ** GROWTH
    rest, excess = np.sum(left / grown, axis=0) / np.maximum(seen.sum(axis=0), 1), 1.0
    for _ in range(200):  # each multiplies the variances; a hundred settle three digits
        variance = noise**2 + spread + grown * (rest + excess * spread)
        told, asked = weight * grown * left / variance**2, weight * grown / variance
        ahead, back = (known * told).sum(axis=0) + TINY, (known * asked).sum(axis=0) + TINY
        rest = rest * np.sqrt(ahead / back)
        ahead, back = (told * spread).sum() + TINY, (asked * spread).sum() + TINY
        excess *= float(np.sqrt(ahead / back))
    return BandVariance(np.where(seen.any(axis=0), rest, np.nan), excess)


def _mean_measured(values: Array) -> Array:
    """Mean by channel of values of readings, (num_readings, num_channels), of which those that were
    not measured are NaN; NaN: none was."""
    seen = np.isfinite(values)
    count = seen.sum(axis=0)
    total = np.sum(np.where(seen, values, 0.0), axis=0)
    return np.where(count, total / np.maximum(count, 1), np.nan)


def _left_out_parts(
    fit: Fit, channels: Sequence[Channel], validation: Validation | None, plain: Fit | None
) -> list[Part]:
    """Every part of the fitted runs by a fit without it."""
    held = validation
    if not isinstance(held, LeftOut):
        folds = folds_of(fit)
        # a fit that is repeated in full costs as much as a set of causes: the linear one serves
        held = None if folds is None else LeftOut(fit.problem, folds, Repeats(0))
    if held is None:
        return []
    residuals = held.residuals(fit)
    before = None if plain is None else np.concatenate(list(held.residuals(plain)))
    parts = []
    for fold in held.folds.parts:
        part = _left_out_part(fit, fold, channels, residuals)
        if before is not None:
            after = np.concatenate(list(residuals))[fold.rows]
            most = RAN_AWAY**2 * max(float(np.mean(before[fold.rows] ** 2)), 1.0)
            part = replace(part, ran_away=float(np.mean(after**2)) > most)
        parts.append(part)
    return parts


def _left_out_part(
    fit: Fit, fold: Fold, channels: Sequence[Channel], residuals: Sequence[Array]
) -> Part:
    """A part of the fitted runs.

    Args:
        channels: Columns of ``measured``.
        residuals: Whitened, by run, of fits that have not seen them, (num_valid,) each.
    """
    problem, covariance = fit.problem, posterior_covariance(fit.jacobian[~fold.rows])
    slopes = problem.by_run(fit.jacobian)
    is_left_out = problem.by_run(np.where(fold.rows, 1.0, 0.0))
    unmet = unmet_by(replace(problem, runs=kept_runs(problem, fold))) if fold.is_whole else ()
    left, spread = [], []
    for i in fold.runs:
        run = problem.runs[i]
        inside = np.zeros(run.measured.size, dtype=bool)
        inside[newest_samples(problem, run)[is_left_out[i] > 0.0]] = True
        own = own_names(problem.names, run, unmet) if fold.is_whole else ()
        readings = _unwhiten(problem, run, residuals[i][:, None])[:, 0]
        left.append(np.where(inside, readings, np.nan).reshape(run.measured.shape))
        spread.append(_linear_variance(fit, run, slopes[i], covariance, own))
    times = 1.0
    if fold.is_whole and (kept := kept_runs(problem, fold)):
        runs = (problem.runs[i] for i in fold.runs)
        here = [replace(r, measured=r.measured - own) for r, own in zip(runs, left, strict=True)]
        times = times_outside(outside_rows(here, channels, spans_of(kept, channels)))
    return Part(np.concatenate(left), np.concatenate(spread), times)


def _linear_variance(
    fit: Fit, run: Run, slopes: Array, covariance: Array, own: Collection[str]
) -> Array:
    """Variance of a run's readings by a posterior near the fit, (num_samples, num_channels).

    Args:
        slopes: Whitened slopes of this run at the fit, (num_valid, n).
        covariance: Posterior of the coordinates, (n, n).
        own: Names of coordinates that are fitted to this run anyway.
    """
    names = fit.problem.names
    alone = [i for i, n in enumerate(names) if n in own]
    shared = [i for i, n in enumerate(names) if n not in own and n not in fit.at_bound]
    moves = slopes[:, shared] @ _principal_moves(covariance[np.ix_(shared, shared)])
    moves = moves - _take_up(slopes[:, alone], moves)
    changed = np.nan_to_num(_unwhiten(fit.problem, run, moves))
    return np.asarray(np.sum(changed**2, axis=1).reshape(run.measured.shape))


def _select_parts(fit: Fit, channels: Sequence[Channel], select: Sequence[Run]) -> list[Part]:
    """Select runs, those of one command together; none that its posterior cannot simulate."""
    pieces: dict[str, list[Part]] = {}
    names, correlation = _posterior_of(fit)
    sd, unmet = np.sqrt(np.diag(fit.covariance)), unmet_by(fit.problem)
    spans = spans_of(fit.problem.runs, channels)
    for run in select:
        left = _unwhiten(fit.problem, run, held_out_residual(fit, run)[:, None])
        said = replace(run, measured=run.measured - left.reshape(run.measured.shape))
        far = times_outside(outside_rows([said], channels, spans))
        try:
            spread = _posterior_variance(names, correlation, fit, sd, run, unmet)
        except DiffsimError:
            continue
        piece = Part(left.reshape(run.measured.shape), spread, far)
        pieces.setdefault(run.group, []).append(piece)
    return [
        Part(
            np.concatenate([p.left for p in own]),
            np.concatenate([p.spread for p in own]),
            max(p.times for p in own),
        )
        for own in pieces.values()
    ]


def _posterior_variance(
    names: Sequence[str],
    correlation: Array,
    at: Frozen,
    sd: Array,
    run: Run,
    unmet: Collection[str],
) -> Array:
    """Variance of a run's readings by the posterior, (num_samples, num_channels).

    Args:
        names: Coordinates that runs share.
        correlation: Posterior correlation of these, (n, n).
        sd: Posterior standard deviation of its standardized coordinates.
        run: Run that was not fitted; its own values are fitted to it.
        unmet: Parameters that no fitted run has.
    """
    x = held_out_point(at, run, unmet)[0]
    own_of_run = set(own_names(at.problem.names, run, unmet))
    own = [i for i, name in enumerate(at.problem.names) if name in own_of_run]
    place = {name: i for i, name in enumerate(at.problem.names) if name not in own_of_run}
    moved = [k for k, name in enumerate(names) if name in place and touches(name, run)]
    if not moved:
        return np.zeros(run.measured.shape)
    directions = np.zeros((len(moved), len(x)))
    places, among = [place[names[k]] for k in moved], correlation[np.ix_(moved, moved)]
    directions[:, places] = _principal_moves(among).T
    columns = _changes(at, x, sd * directions, run)
    if own:  # what the run's own values take up, with their prior, does not show
        slopes = replace(at.problem, runs=(run,)).linearize(x, only=own)[1]
        taken = _take_up(slopes, at.problem.whiten(run, columns))
        columns = columns - np.nan_to_num(_unwhiten(at.problem, run, taken))
    return np.asarray(np.sum(columns**2, axis=1).reshape(run.measured.shape))


def _principal_moves(covariance: Array) -> Array:
    """Principal directions, each as long as its standard deviation, (n, n) by column.

    Along them parameters move as they may together: one alone leaves the valley of the posterior,
    and of such moves a sum cancels only while they are straight.
    """
    variances, axes = np.linalg.eigh(covariance)
    return np.asarray(axes * np.sqrt(np.maximum(variances, 0.0)))


def _take_up(slopes: Array, columns: Array) -> Array:
    """Part of whitened columns that coordinates with these slopes take up, with their prior."""
    if not np.isfinite(slopes).all():  # nothing is known of it
        return np.full_like(columns, np.nan)
    own = Gaussian.of(slopes, np.zeros(len(slopes)))
    return slopes @ own.solve(slopes.T @ columns)


def _changes(at: Frozen, x: Array, moves: Array, run: Run) -> Array:
    """Change of a run by each move of the standardized coordinates, (num_readings, num_moves).

    Secants, not slopes: a file's coordinates are posterior standard deviations, in which steps of
    differences would be lost in rounding; and what a wide posterior does is no slope.
    """
    problem = at.problem
    u = problem.scaled(x)
    points, shares = [x], []
    for move in moves * problem.stretch(x):
        ahead, back = (_find_room(u, m, problem.bounds) for m in (move, -move))
        share = ahead if ahead >= 0.5 else max(ahead, -back, key=abs)
        points.append(problem.standardized(u + share * move))
        shares.append(share)
    with torch.no_grad():
        given = [torch.from_numpy(np.ascontiguousarray(p)) for p in points]
        records = problem.predict_many(run, given).numpy().reshape(len(points), -1)
    scale = np.array([1.0 / s if s else 0.0 for s in shares])
    return np.asarray((records[1:] - records[0]).T * scale)


def _find_room(u: Array, move: Array, bounds: tuple[Array, Array]) -> float:
    """Share of a move that stays within bounds, at most 1."""
    end = np.clip(u + move, *bounds)
    moves = move != 0.0
    return float(np.min((end - u)[moves] / move[moves], initial=1.0))


def _unwhiten(problem: Problem, run: Run, rows: Array) -> Array:
    """Whitened rows of a run (num_valid, k) as readings, (num_samples * num_channels, k); NaN where
    nothing was measured."""
    seen = np.flatnonzero(np.isfinite(run.measured))
    full = np.full((run.measured.size, rows.shape[1]), np.nan)
    if len(seen):
        matrix = sparse.csc_array(problem.whitener.matrix(run)[:, seen])
        full[seen] = splu(matrix).solve(np.ascontiguousarray(rows))
    return full
