"""Gain of an extension on what no fit has seen.

Names are held against such parts: runs with use: select, else fit runs left out one after the
other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from scipy import special

from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.core.figures import figure, percent
from diffsim.core.memo import Memo, memo_field
from diffsim.data.study import Run
from diffsim.diagnose.judge.left_out import (
    Folds,
    Repeats,
    folds_of,
    left_out_residual,
    time_of_rows,
)
from diffsim.diagnose.judge.own_values import Frozen, held_out_residual
from diffsim.identify import Fit, Problem
from diffsim.identify.problem import PredictionError
from diffsim.identify.ranges import SURE_SD

MIN_BLOCKS = 4  # fewer say nothing: three agree by chance
MOST_BLOCKS = 256  # begin: shorter ones make no interval narrower that is worth its name
MOST = 1.2  # share that can be removed, and stated over left noise, where the noise is known
NEAR_ZERO = 0.01  # noise variances per sample: a change of the error that is none
RAN_AWAY = 10.0  # times the plain model's error: a fit without these samples says nothing of them


@checked(kinds_only=True)
@dataclass(frozen=True)
class Gain:
    """Share of the excess error removed: 1 - (e_ext^2 - n^2) / (e_null^2 - n^2).

    Attributes:
        value: The share; 1: down to the noise, 0: no better, below 0: worse.
        low, high: 90 % block-bootstrap interval; both ``value`` for a single block.
        excess: (e_null^2 - n^2) in noise variances per sample; where it is small the share means
            little.
        num_blocks: Number of blocks of samples, as long as what moves the share is correlated.
        fall: Lower end of the 90 % interval of e_null^2 - e_ext^2, in noise variances per sample:
            what is known of it where the excess, and with it every share, is uncertain.
        farthest: How far a value that was fitted to these runs ended from what is stated of it, at
            most [prior sd], and which value that is, such as "zero closing".
    """

    value: float
    low: float
    high: float
    excess: float
    num_blocks: int
    fall: float = 0.0
    farthest: tuple[float, str] = (0.0, "")

    @property
    def status(self) -> str:
        """Where the interval lies: "confirmed" (above zero), "not confirmed", "withdrawn" (below);
        "nothing to gain": the plain model's error is noise alone; "cannot be judged": the share is
        one of next to nothing, or the extended model ran away. Too few blocks confirm nothing, nor
        do runs whose own values had to be fitted far off."""
        if self.high < 0.0 and self.num_blocks > 1:
            return "withdrawn" if self._can_be_judged else "cannot be judged"
        if self.excess <= 0.0:
            return "nothing to gain"
        is_sure = self.is_above_zero and self.farthest[0] <= SURE_SD
        return "confirmed" if is_sure else "not confirmed"

    @property
    def _can_be_judged(self) -> bool:
        """Whether a share below zero says that the extended model is the worse one."""
        is_change = -self.value * self.excess > NEAR_ZERO
        return is_change and self.left < RAN_AWAY**2 * (1.0 + max(self.excess, 0.0))

    @property
    def left(self) -> float:
        """What the extended model leaves [noise variances per sample]."""
        return 1.0 + self.excess * (1.0 - self.value)

    @property
    def is_above_zero(self) -> bool:
        """Whether the interval of the share lies above zero."""
        return self.num_blocks >= MIN_BLOCKS and min(self.low, self.value) > 0.0

    @property
    def has_share(self) -> bool:
        """Whether its share says anything: of next to nothing any share can be removed."""
        return self.status not in ("nothing to gain", "cannot be judged")

    @property
    def is_below_noise(self) -> bool:
        """Whether so much is removed that the noise must be less than was stated; of a small excess
        a share says little, so what is left must be below the noise as well."""
        return self.excess > 0.0 and self.value > MOST and MOST * self.left < 1.0

    @property
    def has_fallen(self) -> bool:
        """Whether the error has fallen for sure, however uncertain the share of a small excess."""
        is_gain = self.excess <= 0.0 or self.value > 0.0
        return is_gain and self.num_blocks >= MIN_BLOCKS and self.fall > 0.0

    @property
    def words(self) -> str:
        """The gain in a sentence."""
        if self.status == "nothing to gain":
            return "On unseen runs the plain model's error is noise alone: nothing is to be gained."
        if self.status == "cannot be judged":
            is_lost = self.left > 1.0 + max(self.excess, 0.0) + NEAR_ZERO
            why = "without these samples the fit ran away"
            why = why if is_lost else "next to nothing was there to be removed"
            return f"On unseen runs the gain cannot be judged: {why}."
        share, low, high = (percent(v) for v in (self.value, self.low, self.high))
        interval = f"90 % interval: {low} to {high}"
        if self.num_blocks < MIN_BLOCKS:
            what = "block of samples is" if self.num_blocks == 1 else "blocks of samples are"
            interval = f"{self.num_blocks} {what} too few for an interval"
        why = ""
        if (far := self.farthest[0]) > SURE_SD:
            why = f"; {self.farthest[1]} is {figure(far, 2)} standard deviations off in them"
        if self.is_below_noise:
            share = percent(float(np.sqrt(max(self.left, 0.0))))
            why = f"; the stated noise is too large, {share} of it is left"
        return (
            f"On unseen runs {share} of the error above the noise is removed ({interval}): "
            f"{self.status}{why}."
        )


@checked
def gain(runs: Sequence[Run], null: Frozen, extended: Frozen, *, seed: int) -> Gain:
    """Compare two fits on runs that neither has seen.

    What is a run's own ("offset@run") is fitted to it, for both alike; nothing else is.

    Args:
        runs: Runs that no fit has seen.
        null: Frozen without effects.
        extended: Frozen of the same model with effects.
        seed: Seed of the bootstrap.
    """
    if not runs:
        raise ValueError("runs is empty; the gain needs at least one run")
    before, after = held_out_residuals(null, runs), held_out_residuals(extended, runs)
    return compared(runs, null, before, after, seed=seed)


def compared(
    runs: Sequence[Run],
    null: Frozen,
    before: Sequence[Array],
    after: Sequence[Array],
    *,
    seed: int,
) -> Gain:
    """Gain from whitened residuals of runs that no fit has seen.

    Blocks are doubled, up to whole runs, and those count by which the share is least sure: shorter
    ones are not independent of each other, longer ones say no more.

    Args:
        null: A fit whose noise floor whitened the residuals.
        before: Residuals without the effects, (num_valid,) by run.
        after: Residuals with the effects, (num_valid,) by run.
        seed: Seed of the bootstrap.
    """
    times = [time_of_rows(null.problem, run) for run in runs]
    squares = [(a**2, b**2) for a, b in zip(before, after, strict=True)]
    spans = [float(np.ptp(time)) for time in times]
    block_s = sum(spans) / MOST_BLOCKS
    tables: list[Array] = []
    while not tables or block_s < 2.0 * max(spans):
        rows = [_blocks(t, block_s, *both) for t, both in zip(times, squares, strict=True)]
        table = np.concatenate(rows)
        if tables and len(table) < MIN_BLOCKS:
            break
        tables.append(table)
        block_s *= 2.0
    return share_removed(max(tables, key=_sure_sd), seed=seed)


def held_out_residuals(fit: Frozen, runs: Sequence[Run]) -> list[Array]:
    """``held_out_residual`` of every run."""
    return [held_out_residual(fit, run) for run in runs]


def share_removed(blocks: Array, *, seed: int) -> Gain:
    """The share and its interval from blocks.

    The bootstrap's quantiles are taken as far out as Student's interval is wider than the normal
    one: a resample of few blocks varies less than they do (Hesterberg 2015, "What teachers should
    know about the bootstrap").

    Args:
        blocks: Samples, sum of squares of the null model, and of the extended one, (num_blocks, 3)
            [noise variances].
    """
    rng, num_blocks = np.random.default_rng(seed), len(blocks)
    picks = rng.integers(num_blocks, size=(1000, num_blocks))
    drawn, total = blocks[picks].sum(axis=1), blocks.sum(axis=0)
    excess = total[1] - total[0]
    # a resample whose null error is below the noise has nothing to remove, but may get worse
    worse = np.minimum(drawn[:, 1] - drawn[:, 2], 0.0) / (excess if excess > 0.0 else np.inf)
    shares = np.where(drawn[:, 1] > drawn[:, 0], _share(drawn), worse)
    few = max(num_blocks - 1, 1)
    tail = special.ndtr(np.sqrt(num_blocks / few) * special.stdtrit(few, 0.05))
    low, high = np.quantile(shares, [tail, 1.0 - tail])
    fall = float(np.quantile((drawn[:, 1] - drawn[:, 2]) / drawn[:, 0], tail))
    per_sample, value = float(excess / total[0]), float(_share(total))
    return Gain(value, float(low), float(high), per_sample, num_blocks, fall)


def _share(sums: Array) -> Array:
    """The share from sums over blocks, (...,) of (..., 3); 0 where the null model's error is below
    the noise."""
    count, null, extended = np.moveaxis(sums, -1, 0)
    return np.where(null > count, null - extended, 0.0) / np.where(null > count, null - count, 1.0)


def _sure_sd(blocks: Array) -> float:
    """Standard deviation of the share, from what leaving out each block changes, less what that of
    few blocks may be off by; 0 of one block."""
    num_blocks, value = len(blocks), _share(blocks.sum(axis=0))
    count, null, extended = blocks.T
    total = float((null - count).sum())
    if num_blocks < 2 or total <= 0.0:
        return 0.0
    moved = (null - extended - value * (null - count)) / total
    sure = 1.0 - 1.0 / np.sqrt(2.0 * (num_blocks - 1))
    return float(sure * np.sqrt(num_blocks / (num_blocks - 1) * (moved @ moved)))


def _blocks(time: Array, block_s: float, null: Array, extended: Array) -> Array:
    """(num_blocks, 3) sums of squares over blocks of time of at least ``block_s``, the whole run if
    that is shorter.

    Args:
        time: Of every whitened row, (num_valid,) [s].
        block_s: Length of a block [s].
        null, extended: Squares of the residuals, (num_valid,).
    """
    since, span = time - time.min(), float(np.ptp(time))
    count = max(int(span / block_s), 1) if span > 0.0 else 1
    label = np.minimum((since * (count / max(span, block_s, 1e-300))).astype(np.int64), count - 1)
    table = np.column_stack([np.bincount(label, w) for w in (np.ones_like(null), null, extended)])
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

    def residuals(self, fit: Fit) -> Sequence[Array] | None:
        """(num_valid,) whitened residuals by run; None where one cannot be simulated."""
        ...


@dataclass(eq=False)
class SelectRuns:
    """Runs with use: select, to which nothing is fitted but what is their own.

    Args:
        runs: These runs.
    """

    runs: Sequence[Run]
    words: str = "runs with use: select"
    _kept: Memo[Sequence[Array] | None] = memo_field()

    def residuals(self, fit: Fit) -> Sequence[Array] | None:
        """(num_valid,) whitened residuals by run; None where one cannot be simulated."""

        def compute() -> Sequence[Array] | None:
            try:
                return held_out_residuals(fit, self.runs)
            except PredictionError:  # it diverges there, though not where it was fitted
                return None

        return self._kept(fit, compute)


@dataclass(eq=False)
class LeftOut:
    """Parts of the fit runs, each predicted by a fit without it.

    Args:
        problem: Problem with the runs that are fitted.
    """

    problem: Problem
    folds: Folds
    repeats: Repeats = field(default_factory=Repeats)
    _kept: Memo[Sequence[Array]] = memo_field()

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


def validation_of(plain: Fit, select: Sequence[Run], steps: float = np.inf) -> Validation | None:
    """Select runs if there are any, else fit runs left out; None where they are too few.

    Args:
        select: Runs with use: select.
        steps: Weighted steps that each fit may take that is repeated in full.
    """
    if select:
        return SelectRuns(select)
    folds = folds_of(plain)
    return None if folds is None else LeftOut(plain.problem, folds, Repeats(steps=steps))


def gain_over(validation: Validation, without: Fit, best: Fit, seed: int) -> Gain | None:
    """Gain of a fit over another on what neither has seen; None where one of them cannot be
    simulated there."""
    before, after = validation.residuals(without), validation.residuals(best)
    if before is None or after is None:
        return None
    return compared(validation.runs, without, before, after, seed=seed)
