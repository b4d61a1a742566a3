"""Where readings of an unseen run are expected: a band around what the extended model predicts.

Half of its width, by reading, is

    factor * sqrt(noise^2 + rest^2 + posterior^2).

Noise is the floor of the fit. Rest is what the model leaves beyond it on parts that were not
fitted: groups of runs left out one after the other (else blocks of time), and runs with use:
select. Posterior is what parameters and sizes, by one standard deviation each and correlated as
they are, change in this very run. The factor holds the share of the readings of these parts that
is wanted, each part weighing the same, times Student's quantile over the normal one: few parts
tell little of the next one, so that their band is wide. No shape of what is left is assumed.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse, special
from scipy.sparse.linalg import splu

from diffsim.core.errors import DiffsimError
from diffsim.data.study import Channel, Run
from diffsim.diagnose.judge.gain import LeftOut, Validation, held_out_residual
from diffsim.diagnose.judge.left_out import Repeats, folds_of, newest_samples
from diffsim.diagnose.judge.own_values import Frozen, held_out_point, own_names
from diffsim.diagnose.judge.records import LEVEL
from diffsim.identify import Fit, Problem
from diffsim.identify.effect import touches

Array = NDArray[np.float64]
MORE_FREEDOM = 1  # degrees of freedom of Student's quantile beside the number of parts


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
        channels: Sequence[Channel],
        unmet: Collection[str],
    ) -> Array | None:
        """Half of the width in a run, (num_samples, num_channels) [unit of the channel].

        Args:
            at: The extended model.
            sd: Posterior standard deviation of its standardized coordinates, (n,).
            run: Run that was not fitted; its own values are fitted to it.
            channels: Columns of its ``measured``.
            unmet: Parameters that no fitted run has.

        Returns:
            NaN in channels of which nothing is known; None where the model cannot be simulated
            within its posterior.
        """
        try:
            spread = _posterior_variance(self, at, sd, run, unmet)
        except DiffsimError:
            return None
        fixed = [self.noise[c.name] ** 2 + self.rest.get(c.name, np.nan) ** 2 for c in channels]
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


def no_band(_: Run) -> Array | None:
    """Half of the width where nothing tells of it: none."""
    return None


def posterior_sd(fit: Fit) -> Array:
    """Posterior standard deviation of a fit's standardized coordinates, (n,)."""
    return np.asarray(np.sqrt(np.diag(fit.covariance)))


def band_of(
    fit: Fit,
    channels: Sequence[Channel],
    noise: Array,
    select: Sequence[Run],
    validation: Validation | None = None,
) -> Band | None:
    """The band of a fit, from parts of its runs that are left out and from select runs.

    Args:
        fit: The extended model.
        channels: Columns of ``measured``.
        noise: Standard deviation of the noise, (num_channels,) [unit of the channel].
        select: Runs with use: select.
        validation: What names were held against; fits without a part are not made again.

    Returns:
        None where there is neither a part to leave out nor a select run.
    """
    parts = unfitted_parts(fit, select, validation)
    if not parts:
        return None
    rest, factor = factor_of(parts, noise)
    shared = [i for i, n in enumerate(fit.problem.names) if "@" not in n and n not in fit.at_bound]
    return Band(
        factor=factor,
        num_parts=len(parts),
        noise={c.name: float(v) for c, v in zip(channels, noise, strict=True)},
        rest={c.name: float(v) for c, v in zip(channels, rest, strict=True) if v >= 0.0},
        names=tuple(fit.problem.names[i] for i in shared),
        correlation=fit.correlation[np.ix_(shared, shared)],
    )


def unfitted_parts(
    fit: Fit, select: Sequence[Run], validation: Validation | None = None
) -> list[Array]:
    """Measured minus predicted of parts that were not fitted; arguments as of ``band_of``.

    Returns:
        (num_readings, num_channels) each [unit of the channel]; NaN: not measured, or of another
        part.
    """
    return [*_left_out_parts(fit, validation), *_select_parts(fit, select)]


def factor_of(parts: Sequence[Array], noise: Array) -> tuple[Array, float]:
    """Standard deviation of what parts leave beyond the noise, by channel, and the band's factor.

    Args:
        parts: As ``unfitted_parts`` returns them, one or more.
        noise: Standard deviation of the noise, (num_channels,) [unit of the channel].
    """
    rest = np.sqrt(_rest_variance(parts, noise))
    return rest, _factor([np.abs(left) / np.hypot(noise, rest) for left in parts])


def _left_out_parts(fit: Fit, validation: Validation | None) -> list[Array]:
    """Measured minus predicted of every part of the fitted runs by a fit without it,
    (num_readings, num_channels); NaN in readings of other parts."""
    held = validation
    if not isinstance(held, LeftOut):
        folds = folds_of(fit)
        # a fit that is repeated in full costs as much as a set of causes: the linear one serves
        held = None if folds is None else LeftOut(fit.problem, folds, Repeats(0))
    if held is None:
        return []
    count, problem = len(held.folds.parts), fit.problem
    part_of = np.full(len(fit.residual), -1)
    for k, fold in enumerate(held.folds.parts):
        part_of[fold.rows] = k
    pieces: list[list[Array]] = [[] for _ in range(count)]
    for run, rows, label in zip(
        problem.runs, held.residuals(fit), problem.by_run(part_of), strict=True
    ):
        owner = np.full(run.measured.size, -1)
        owner[newest_samples(problem, run)] = label
        left = _unwhiten(problem, run, rows[:, None])[:, 0]
        for k in np.unique(label[label >= 0]):
            pieces[k].append(np.where(owner == k, left, np.nan).reshape(run.measured.shape))
    return [np.concatenate(p) for p in pieces if p]


def _select_parts(fit: Fit, select: Sequence[Run]) -> list[Array]:
    """Measured minus predicted of select runs, those of one command together."""
    pieces: dict[str, list[Array]] = {}
    for run in select:
        left = _unwhiten(fit.problem, run, held_out_residual(fit, run)[:, None])
        pieces.setdefault(run.group, []).append(left.reshape(run.measured.shape))
    return [np.concatenate(p) for p in pieces.values()]


def _rest_variance(parts: Sequence[Array], noise: Array) -> Array:
    """Mean variance over parts beyond the noise, by channel; NaN: measured in none."""
    powers = []
    for left in parts:
        count = np.isfinite(left).sum(axis=0)
        powers.append(np.where(count, np.nansum(left**2, axis=0) / np.maximum(count, 1), np.nan))
    table = np.array(powers)
    count = np.isfinite(table).sum(axis=0)
    mean = np.nansum(table, axis=0) / np.maximum(count, 1)
    return np.where(count, np.maximum(mean - noise**2, 0.0), np.nan)


def _factor(scores: Sequence[Array]) -> float:
    """Quantile of readings over their standard deviations, every part weighing the same."""
    values = [s[np.isfinite(s)] for s in scores]
    weights = np.concatenate([np.full(len(v), 1.0 / len(v)) for v in values if len(v)])
    every = np.concatenate(values)
    order = np.argsort(every, kind="stable")
    share = np.cumsum(weights[order])
    k = min(int(np.searchsorted(share, LEVEL * share[-1])), len(every) - 1)
    p = 0.5 * (1.0 + LEVEL)
    few = special.stdtrit(len(values) + MORE_FREEDOM, p) / special.ndtri(p)
    return float(few * every[order[k]])


def _posterior_variance(
    band: Band, at: Frozen, sd: Array, run: Run, unmet: Collection[str]
) -> Array:
    """Variance of a run's readings by the posterior, (num_samples, num_channels)."""
    x = held_out_point(at, run, unmet)
    names = at.problem.names
    own_of_run = set(own_names(names, run, unmet))
    own = [i for i, name in enumerate(names) if name in own_of_run]
    place = {name: i for i, name in enumerate(names) if name not in own_of_run}
    moved = [k for k, name in enumerate(band.names) if name in place and touches(name, run)]
    if not moved:
        return np.zeros(run.measured.shape)
    columns = _changes(at, x, sd, run, [place[band.names[k]] for k in moved])
    if own:  # what the run's own values take up, with their prior, does not show
        slopes = replace(at.problem, runs=(run,)).linearize(x, only=own)[1][:, own]
        gram = slopes.T @ slopes + np.eye(len(own))
        taken = np.linalg.solve(gram, slopes.T @ at.problem.whiten(run, columns))
        columns = columns - np.nan_to_num(_unwhiten(at.problem, run, slopes @ taken))
    correlation = band.correlation[np.ix_(moved, moved)]
    variance = np.einsum("ti,ij,tj->t", columns, correlation, columns)
    return np.asarray(np.maximum(variance, 0.0).reshape(run.measured.shape))


def _changes(at: Frozen, x: Array, sd: Array, run: Run, own: Sequence[int]) -> Array:
    """Change of a run by one standard deviation of each coordinate, (num_readings, n).

    Secants, not slopes: a file's coordinates are posterior standard deviations, in which steps of
    differences would be lost in rounding; and what a wide posterior does is no slope.
    """
    problem = at.problem
    u, step = problem.scaled(x), sd * problem.stretch(x)
    low, high = problem.bounds
    points, steps = [x], []
    for i in own:
        up = min(u[i] + step[i], high[i])
        end = up if up - u[i] >= 0.5 * step[i] else max(u[i] - step[i], low[i])
        steps.append((end - u[i]) / step[i] if step[i] > 0.0 else 0.0)
        point = u.copy()
        point[i] = end
        points.append(problem.standardized(point))
    with torch.no_grad():
        given = [torch.from_numpy(np.ascontiguousarray(p)) for p in points]
        records = problem.predict_many(run, given).numpy().reshape(len(points), -1)
    scale = np.array([1.0 / s if s else 0.0 for s in steps])
    return np.asarray((records[1:] - records[0]).T * scale)


def _unwhiten(problem: Problem, run: Run, rows: Array) -> Array:
    """Whitened rows of a run (num_valid, k) as readings, (num_samples * num_channels, k); NaN where
    nothing was measured."""
    seen = np.flatnonzero(np.isfinite(run.measured))
    full = np.full((run.measured.size, rows.shape[1]), np.nan)
    if len(seen):
        matrix = sparse.csc_array(problem.whitener.matrix(run)[:, seen])
        full[seen] = splu(matrix).solve(np.ascontiguousarray(rows))
    return full
