"""Gain of an extension on what no fit has seen.

Names are held against such parts: runs with use: select, else fit runs left out one after the
other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from diffsim.core.memo import Memo, memo_field
from diffsim.data.study import Run
from diffsim.diagnose.judge.left_out import (
    Folds,
    Repeats,
    folds_of,
    left_out_residual,
)
from diffsim.diagnose.judge.own_values import Frozen, held_out_point
from diffsim.identify import Fit, Problem

Array = NDArray[np.float64]
_MOST_KEPT = 256  # fits
MIN_BLOCKS = 4  # per run; fewer in all say nothing: equal models win three in a row by chance
LEAST = 0.005  # share that is a gain at all: less is shown as 0 %
MOST = 1.2  # share that can be removed, and stated over left noise, where the noise is known
BLOCK_S = 0.3  # longer than the memory of what the models leave


@dataclass(frozen=True)
class Gain:
    """Share of the excess error removed: 1 - (e_ext^2 - n^2) / (e_null^2 - n^2).

    Attributes:
        value: The share; 1: down to the noise, 0: no better, below 0: worse.
        low, high: 90 % block-bootstrap interval.
        excess: (e_null^2 - n^2) in noise variances per sample; where it is small the share means
            little.
        num_blocks: Number of blocks of samples that the bootstrap resamples.
        fall: Lower end of the 90 % interval of e_null^2 - e_ext^2, in noise variances per sample:
            what is known of it where the excess, and with it every share, is uncertain.
    """

    value: float
    low: float
    high: float
    excess: float
    num_blocks: int
    fall: float = 0.0

    @property
    def status(self) -> str:
        """Where the interval lies: "confirmed" (above zero), "not confirmed", "withdrawn" (below);
        or "nothing to gain": the plain model's error is noise alone. Too few blocks confirm
        nothing, and no share of a noise that is not what was stated."""
        if self.high < 0.0:
            return "withdrawn"
        if self.excess <= 0.0:
            return "nothing to gain"
        return "confirmed" if self.is_above_zero and not self.is_below_noise else "not confirmed"

    @property
    def is_above_zero(self) -> bool:
        """Whether the interval of the share lies above zero."""
        return self.num_blocks >= MIN_BLOCKS and min(self.low, self.value) >= LEAST

    @property
    def is_below_noise(self) -> bool:
        """Whether so much is removed that the noise cannot be what was stated; of a small excess a
        share says little, so what is left must be below the noise as well."""
        left = 1.0 + self.excess * (1.0 - self.value)
        return self.excess > 0.0 and self.value > MOST and MOST * left < 1.0

    @property
    def has_fallen(self) -> bool:
        """Whether the error has fallen for sure, however uncertain the share of a small excess."""
        is_gain = self.excess <= 0.0 or self.value >= LEAST
        return is_gain and self.num_blocks >= MIN_BLOCKS and self.fall > 0.0

    @property
    def words(self) -> str:
        """The gain in a sentence."""
        if self.status == "nothing to gain":
            return "On unseen runs the plain model's error is noise alone: nothing is to be gained."
        share, low, high = (_percent(v) for v in (self.value, self.low, self.high))
        interval = f"90 % interval: {low} to {high}"
        if self.num_blocks < MIN_BLOCKS:
            what = "block of samples is" if self.num_blocks == 1 else "blocks of samples are"
            interval = f"{self.num_blocks} {what} too few for an interval"
        why = "; the noise is not what was stated" if self.is_below_noise else ""
        return (
            f"On unseen runs {share} of the error above the noise is removed ({interval}): "
            f"{self.status}{why}."
        )


def _percent(share: float) -> str:
    """A share, as exact as it is small."""
    return f"{share:.0%}" if abs(share) >= 0.095 or share == 0.0 else f"{share:.1%}"


def gain(
    runs: Sequence[Run], null: Frozen, extended: Frozen, *, seed: int, block_s: float = BLOCK_S
) -> Gain:
    """Compare two fits on runs that neither has seen.

    What is a run's own ("offset@run") is fitted to it, for both alike; nothing else is.

    Args:
        runs: Runs that no fit has seen.
        null: Frozen without effects.
        extended: Frozen of the same model with effects.
        seed: Seed of the bootstrap.
        block_s: Length of a resampled block [s].
    """
    if not runs:
        raise ValueError("runs is empty; the gain needs at least one run")
    before, after = held_out_residuals(null, runs), held_out_residuals(extended, runs)
    return compared(runs, null, before, after, seed=seed, block_s=block_s)


def compared(
    runs: Sequence[Run],
    null: Frozen,
    before: Sequence[Array],
    after: Sequence[Array],
    *,
    seed: int,
    block_s: float = BLOCK_S,
    draws: int = 1000,
) -> Gain:
    """Gain from whitened residuals of runs that no fit has seen.

    Args:
        runs: Runs that no fit has seen.
        null: A fit whose noise floor whitened the residuals.
        before: Residuals without the effects, (num_valid,) by run.
        after: Residuals with the effects, (num_valid,) by run.
        seed: Seed of the bootstrap.
        block_s: Length of a resampled block [s].
        draws: Number of resamples of the bootstrap.
    """
    pairs = [
        _blocks(run, block_s, a, b, null) for run, a, b in zip(runs, before, after, strict=True)
    ]
    return share_removed(np.concatenate(pairs), seed=seed, draws=draws)


def held_out_residuals(fit: Frozen, runs: Sequence[Run]) -> list[Array]:
    """``held_out_residual`` of every run."""
    return [held_out_residual(fit, run) for run in runs]


def share_removed(blocks: Array, *, seed: int, draws: int = 1000) -> Gain:
    """The share and its interval from blocks.

    Args:
        blocks: Samples, sum of squares of the null model, and of the extended one, (num_blocks, 3)
            [noise variances].
    """
    rng = np.random.default_rng(seed)
    picks = rng.integers(len(blocks), size=(draws, len(blocks)))
    count, null, extended = np.moveaxis(blocks[picks].sum(axis=1), -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = (null - extended) / (null - count)
    # a resample whose null error is below the noise has no excess to remove: it says nothing
    shares = np.where(null > count, shares, 0.0)
    low, high = np.quantile(shares, [0.05, 0.95])
    fall = float(np.quantile((null - extended) / count, 0.05))
    total = blocks.sum(axis=0)
    excess = (total[1] - total[0]) / total[0]
    value = (total[1] - total[2]) / (total[1] - total[0]) if excess > 0.0 else 0.0
    return Gain(float(value), float(low), float(high), float(excess), len(blocks), fall)


def held_out_residual(fit: Frozen, run: Run) -> Array:
    """(num_valid,) whitened residual with the fit's parameters, nuisances of this run refitted."""
    return replace(fit.problem, runs=(run,)).residual(held_out_point(fit, run))


def _blocks(run: Run, block_s: float, null: Array, extended: Array, fit: Frozen) -> Array:
    """(num_blocks, 3) sums over blocks of time."""
    matrix = fit.problem.whitener.matrix(run)
    # a short run has four blocks at least: one block would have an interval of no width
    block_s = min(block_s, float(run.time_s[-1] - run.time_s[0]) / MIN_BLOCKS)
    # a whitened row belongs to its newest sample: the largest column it uses
    newest = np.maximum.reduceat(matrix.indices, matrix.indptr[:-1])
    time = run.time_s[newest // run.measured.shape[1]]
    since = time - run.time_s[0]  # a run of one sample is a block
    label = (since / block_s).astype(int) if block_s > 0.0 else np.zeros(len(since), dtype=int)
    size = label.max() + 1
    rows = [np.bincount(label, w, size) for w in (np.ones_like(null), null**2, extended**2)]
    table = np.column_stack(rows)
    return np.asarray(table[table[:, 0] > 0], dtype=np.float64)


class Validation(Protocol):
    """Runs, or parts of runs, that a fit has not seen.

    Attributes:
        words: What they are, as the report says it.
        runs: Runs that residuals belong to.
    """

    @property
    def words(self) -> str: ...

    @property
    def runs(self) -> Sequence[Run]: ...

    def residuals(self, fit: Fit) -> Sequence[Array]:
        """(num_valid,) whitened residuals by run."""
        ...


@dataclass(eq=False)
class SelectRuns:
    """Runs with use: select, to which nothing is fitted but what is their own.

    Args:
        runs: These runs.
    """

    runs: Sequence[Run]
    words: str = "runs with use: select"
    _kept: Memo[Sequence[Array]] = memo_field(_MOST_KEPT)

    def residuals(self, fit: Fit) -> Sequence[Array]:
        """(num_valid,) whitened residuals by run."""
        return self._kept(fit, lambda: held_out_residuals(fit, self.runs))


@dataclass(eq=False)
class LeftOut:
    """Parts of the fit runs, each predicted by a fit without it.

    Args:
        problem: Problem with the runs that are fitted.
        folds: Parts that are left out.
    """

    problem: Problem
    folds: Folds
    repeats: Repeats = field(default_factory=Repeats)
    _kept: Memo[Sequence[Array]] = memo_field(_MOST_KEPT)

    @property
    def words(self) -> str:
        """How parts were left out."""
        return self.folds.words

    @property
    def runs(self) -> Sequence[Run]:
        """Runs that are fitted."""
        return self.problem.runs

    def residuals(self, fit: Fit) -> Sequence[Array]:
        """(num_valid,) whitened residuals by run."""
        return self._kept(
            fit, lambda: fit.problem.by_run(left_out_residual(fit, self.folds, self.repeats))
        )


def validation_of(plain: Fit, select: Sequence[Run]) -> Validation | None:
    """Select runs if there are any, else fit runs left out; None where they are too few.

    Args:
        plain: Fit of the plain model.
        select: Runs with use: select.
    """
    if select:
        return SelectRuns(select)
    folds = folds_of(plain)
    return None if folds is None else LeftOut(plain.problem, folds)


def gain_over(validation: Validation, without: Fit, best: Fit, seed: int) -> Gain:
    """Gain of a fit over another on what neither has seen."""
    before, after = validation.residuals(without), validation.residuals(best)
    return compared(validation.runs, without, before, after, seed=seed)
