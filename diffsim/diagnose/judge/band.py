"""Where readings of an unseen run are expected: a band around what the extended model predicts.

Half of its width, by reading, is

    factor * sqrt(noise^2 + times^4 rest^2 + posterior^2).

Noise is the floor of the fit, or what the calmest part leaves where that is less than half of it.
Posterior is what parameters and sizes change in this very run, by one standard deviation along each
principal direction. Rest is what the model leaves beyond both on parts that were not fitted: groups
of runs left out one after the other (else blocks of time), and runs with use: select. Times is how
far outside of the fitted runs the run lies, 1 inside: what a model lacks begins with its next
power, so what it leaves grows as the square. Parts that lie outside of the others have told it from
there.

A part stands for an unseen run where the runs that are left know its parameters: their posterior
moves it by less than the noise; and where the fit without it has not run away. The factor holds the
share of the readings of these parts that is wanted, each part weighing the same and with the rest
that the other parts tell: how much parts differ is in it, and no shape of what is left is assumed.
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
from diffsim.diagnose.judge.gain import RAN_AWAY, LeftOut, Validation, held_out_residual
from diffsim.diagnose.judge.left_out import Fold, Repeats, folds_of, kept_runs, newest_samples
from diffsim.diagnose.judge.own_values import Frozen, held_out_point, own_names, unmet_by
from diffsim.diagnose.judge.records import LEVEL
from diffsim.diagnose.judge.unseen import outside_rows, spans_of, times_outside
from diffsim.identify import Fit, Problem
from diffsim.identify.effect import touches
from diffsim.identify.fitting import posterior_covariance

OVERSTATED = 0.5  # of the noise, that a part leaves at most where it is stated too large
LEAST_PARTS = 2  # one does not tell how parts differ


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

    def power(self, noise: Array) -> Array:
        """Mean square beyond noise and posterior by channel, were they inside, (num_channels,);
        NaN: no reading."""
        seen = np.isfinite(self.left)
        beyond = np.where(seen, self.left**2 - self.spread - noise**2, 0.0)
        count = seen.sum(axis=0) * self.times**4
        return np.where(count, beyond.sum(axis=0) / np.maximum(count, 1), np.nan)

    def is_known(self, noise: Array) -> bool:
        """Whether the posterior moves it by less than the noise, root mean square."""
        moved = (self.spread / noise**2)[np.isfinite(self.left)]
        return bool(moved.size) and float(np.mean(moved)) <= 1.0

    def scores(self, noise: Array, rest_variance: Array) -> Array:
        """Sizes of what is left over its standard deviation, (num_readings, num_channels)."""
        rest = self.times**4 * rest_variance
        return np.asarray(np.abs(self.left) / np.sqrt(noise**2 + rest + self.spread))


@dataclass(frozen=True, eq=False)
class Band:
    """What the band of any run is made from.

    Attributes:
        factor: Half of the width over the root of the three variances.
        num_parts: Parts that nothing was fitted to, which told the factor.
        noise: Standard deviation of the noise by channel [unit of the channel].
        rest: Standard deviation of what is left beyond it [unit of the channel]; only channels that
            one of the parts measured.
        names: Coordinates that runs share.
        correlation: Posterior correlation of these, (n, n).
    """

    factor: float
    num_parts: int
    noise: Mapping[str, float]
    rest: Mapping[str, float]
    names: tuple[str, ...]
    correlation: Array

    def to_dict(self) -> dict[str, Any]:
        """The band in types that JSON and YAML have."""
        return {
            "level": LEVEL,
            "factor": self.factor,
            "num_parts": self.num_parts,
            "noise": dict(self.noise),
            "rest": dict(self.rest),
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
            at: The extended model.
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
        rest = [times**2 * self.rest.get(c.name, np.nan) for c in channels]
        fixed = [self.noise[c.name] ** 2 + r**2 for c, r in zip(channels, rest, strict=True)]
        return np.asarray(self.factor * np.sqrt(spread + np.array(fixed)))


def band_from(content: Mapping[str, Any]) -> Band:
    """The band of a file, the inverse of ``Band.to_dict``."""
    names = tuple(content["names"])
    rows = [[float(v) for v in row.split()] for row in content["correlation"]]
    return Band(
        float(content["factor"]),
        int(content["num_parts"]),
        content["noise"],
        content["rest"],
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
        fit: The extended model.
        channels: Columns of ``measured``.
        noise: Standard deviation of the noise, (num_channels,) [unit of the channel].
        select: Runs with use: select.
        validation: What names were held against; fits without a part are not made again.
        plain: Fit without effects; None: no part is held against it.

    Returns:
        None where parts to leave out and select runs are fewer than two.
    """
    parts = like_unseen(unfitted_parts(fit, channels, select, validation, plain), noise)
    if len(parts) < LEAST_PARTS:
        return None
    # noise that is stated too large would not grow with the distance, nor what it hides
    bare = [replace(part, spread=np.zeros_like(part.left), times=1.0) for part in parts]
    left = [np.sqrt(part.power(np.zeros_like(noise))) for part in bare]
    calmest = np.fmin.reduce(left)
    noise = np.where(calmest < OVERSTATED * noise, calmest, noise)
    rest, factor = factor_of(parts, noise)
    names, correlation = _posterior_of(fit)
    return Band(
        factor=factor,
        num_parts=len(parts),
        noise={c.name: float(v) for c, v in zip(channels, noise, strict=True)},
        rest={c.name: float(v) for c, v in zip(channels, rest, strict=True) if v >= 0.0},
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


def like_unseen(parts: Sequence[Part], noise: Array) -> list[Part]:
    """Parts that stand for an unseen run; all, where these are too few to tell.

    What alone tells of a parameter is predicted badly without it. That says nothing of runs that
    the fit knows as well as its own.

    Args:
        parts: As ``unfitted_parts`` returns them.
        noise: Standard deviation of the noise, (num_channels,) [unit of the channel].
    """
    told = [part for part in parts if not part.ran_away]
    told = told if len(told) >= LEAST_PARTS else list(parts)
    known = [part for part in told if part.is_known(noise)]
    return known if len(known) >= LEAST_PARTS else told


def factor_of(parts: Sequence[Part], noise: Array) -> tuple[Array, float]:
    """Standard deviation of what parts leave beyond noise and posterior, by channel, and the
    band's factor.

    Args:
        parts: Two or more.
        noise: Standard deviation of the noise, (num_channels,) [unit of the channel].
    """
    together, scores = _rest_variance(parts, noise), []
    for k, part in enumerate(parts):
        others = _rest_variance([*parts[:k], *parts[k + 1 :]], noise)
        # a channel of this part alone has no others
        told = np.where(np.isfinite(others), others, together)
        scores.append(part.scores(noise, told))
    return np.sqrt(together), _quantile(scores)


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
        fit: The extended model.
        fold: The part.
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
        fit: The extended model.
        run: One of its runs.
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


def _rest_variance(parts: Sequence[Part], noise: Array) -> Array:
    """Mean variance over parts beyond noise and posterior, by channel; NaN: measured in none."""
    table = np.array([part.power(noise) for part in parts])
    count = np.isfinite(table).sum(axis=0)
    mean = np.nansum(table, axis=0) / np.maximum(count, 1)
    return np.where(count, np.maximum(mean, 0.0), np.nan)


def _quantile(scores: Sequence[Array]) -> float:
    """Quantile of readings over their standard deviations, every part weighing the same."""
    values = [s[np.isfinite(s)] for s in scores]
    weights = np.concatenate([np.full(len(v), 1.0 / len(v)) for v in values if len(v)])
    every = np.concatenate(values)
    order = np.argsort(every, kind="stable")
    share = np.cumsum(weights[order])
    k = min(int(np.searchsorted(share, LEVEL * share[-1])), len(every) - 1)
    return float(every[order[k]])


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
        at: The extended model.
        sd: Posterior standard deviation of its standardized coordinates.
        run: Run that was not fitted; its own values are fitted to it.
        unmet: Parameters that no fitted run has.
    """
    x = held_out_point(at, run, unmet)
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
        slopes = replace(at.problem, runs=(run,)).linearize(x, only=own)[1][:, own]
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
    if not slopes.shape[1]:
        return np.zeros_like(columns)
    gram = slopes.T @ slopes + np.eye(slopes.shape[1])
    return np.asarray(slopes @ np.linalg.solve(gram, slopes.T @ columns))


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
