"""Samples of one group, linearized, and how far single rows and whole goals may be trusted.

Rows while no command changes share a goal: a servo rests a little off its goal, once for all rows,
so that ten rows say hardly more than one. Now and then a goal is missed, and a row is misread. Both
are mixtures: of a goal's offset a narrow normal distribution, one in ten of three times its width
(Tukey, A survey of sampling from contaminated distributions (1960)), and a wide one of what is
missed; of a row normal noise and a Cauchy distribution. Which part a row or a goal belongs to is
chosen for each explanation of the group anew, from the fit of least absolute misfit on, so that no
explanation gains by single ones (Hampel et al., Robust Statistics (1986), 1.3).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from diffsim.core.arrays import Array, IntArray, Mask
from diffsim.core.figures import figure
from diffsim.core.numbers import SD_OVER_MAD
from diffsim.data.study import Run
from diffsim.diagnose.faults.layout import Layout
from diffsim.diagnose.faults.local import Local
from diffsim.identify.effect import Effect
from diffsim.identify.problem import Problem
from diffsim.identify.whitening import WhitenedRuns

Index = IntArray
ROW_ODDS = 0.01  # of a row that was misread, beforehand
ROW_SCALE = 10.0  # of its Cauchy distribution, in sd of the noise
MISSED, TAKEN = 1.0, 50.0  # goals that were missed and taken, before any is seen
FIRST_SHARE = 0.1  # narrow over wide offsets of goals, before any is seen
MOST_USUAL = 3.5  # sd: where all rows are nearer than that, all are trusted
NUM_ABSOLUTE, NUM_CHOICES = 20, 6  # steps to the least absolute misfit, choices from there
USUAL = 10.0  # goals of one channel that the usual offset of all channels weighs as much as
FLOOR = 1e-3  # of a spread of goals' offsets, in sd of the noise
LOOSE, LOOSE_ODDS = 3.0, 0.1  # times the usual offset, and how often


@dataclass(frozen=True, eq=False)
class Tails:
    """How far goals are missed."""

    narrow: Array  # usual offset of a goal, in sd of the noise, (num_channels,)
    wide: Array  # offset of a goal that is missed, in sd of the noise, (num_channels,)
    missed: float  # share of goals that are missed

    @classmethod
    def first(cls, problem: WhitenedRuns) -> Tails:
        """Before any group is seen: a missed goal is anywhere in the range of its channel."""
        values = [problem.whiten(r, np.nan_to_num(r.measured).ravel()) for r in problem.runs]
        channels = [np.nonzero(np.isfinite(r.measured))[1] for r in problem.runs]
        value, channel = np.concatenate(values), np.concatenate(channels)
        wide = np.ones(problem.runs[0].measured.shape[1])
        for k in np.unique(channel):
            own = value[channel == k]
            wide[k] = max(SD_OVER_MAD * float(np.median(np.abs(own - np.median(own)))), 1.0)
        return cls(FIRST_SHARE * wide, wide, MISSED / (MISSED + TAKEN))

    def widened(self, factor: float) -> Tails:
        """Goals that are off by more."""
        return Tails(factor * self.narrow, np.maximum(self.wide, factor * self.narrow), self.missed)


@dataclass(frozen=True, eq=False)
class Goals:
    """Goals that rows share."""

    goal: Index  # goal of each row, (num,)
    channel: Index  # channel of each goal, (num_goals,)
    shared: Mask  # whether the rows of a goal are one of several that a run had, (num_goals,)
    places: tuple[tuple[str, float, float], ...]  # run, first and last time of each goal [s]


class Choice(NamedTuple):
    """Which rows and goals an explanation trusts: log density = level + that of the trusted."""

    kept: Mask  # of rows
    part: Index  # of goals: 0 usual, 1 loose, 2 missed
    level: float

    def equals(self, other: Choice) -> bool:
        """Whether both trust the same."""
        return np.array_equal(self.kept, other.kept) and np.array_equal(self.part, other.part)


class Fit(NamedTuple):
    """The best fit of one explanation: what its trusted rows say, which these are, coordinates
    (n,), and their covariance with the prior."""

    local: Local
    choice: Choice
    at: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Rows(Goals):
    """Whitened samples of one group, linear in scaled coordinates: residual - slopes z."""

    # common, scatter, causes: coordinates, as those of ``Local``
    common: tuple[int, ...]
    scatter: tuple[int, ...]
    causes: tuple[str, ...]
    residual: Array  # at z = 0, (num,)
    slopes: Array  # (num, n)

    def only(self, causes: Sequence[str]) -> Rows:
        """The same with some of its causes."""
        num = len(self.common) + len(self.scatter)
        at = [*range(num), *(num + self.causes.index(c) for c in causes)]
        return replace(self, causes=tuple(causes), slopes=self.slopes[:, at])

    @property
    def plain(self) -> Local:
        """All rows independent and trusted."""
        trusted = Choice(np.ones(len(self.goal), bool), np.zeros(len(self.channel), int), 0.0)
        return self._local(trusted, np.zeros(len(self.channel)))

    def robust(self, tails: Tails, precision: Array, slope: Array) -> Fit:
        """What the trusted rows say under one explanation.

        Args:
            tails: How far goals are missed.
            precision, slope: Normal prior of the coordinates, (n, n) and (n,): it only helps to
                find which rows are trusted, and is no part of what they say.
        """
        narrow = tails.narrow[self.channel]
        spreads = self.shared * np.array([narrow, LOOSE * narrow, tails.wide[self.channel]])
        taken = 1.0 - tails.missed
        odds = np.log([taken * (1.0 - LOOSE_ODDS), taken * LOOSE_ODDS, tails.missed])
        at = self._solve(np.ones(len(self.goal)), precision, slope)
        limit = MOST_USUAL * np.sqrt(1.0 + spreads[0, self.goal] ** 2)
        if np.any(np.abs(self.residual - self.slopes @ at) > limit):
            at = self._least_absolute(limit / MOST_USUAL, precision, slope)
        choice, local = None, self.plain
        for _ in range(NUM_CHOICES):
            new = self._choose(self.residual - self.slopes @ at, spreads, odds)
            is_settled = choice is not None and new.equals(choice)
            choice = new
            local = self._local(choice, np.choose(choice.part, spreads))
            at = np.asarray(np.linalg.solve(local.curvature + precision, local.slope + slope))
            if is_settled:
                break
        assert choice is not None
        return Fit(local, choice, at, np.asarray(np.linalg.inv(local.curvature + precision)))

    def squares(self, fit: Fit) -> tuple[Array, Mask]:
        """Mean square of each goal's offset beyond the noise, the fit being uncertain, and which
        goals tell it, (num_goals,) each."""
        kept, num_goals = fit.choice.kept, len(self.channel)
        num = np.maximum(np.bincount(self.goal, kept, num_goals), 1.0)
        mean = (
            np.bincount(self.goal, kept * (self.residual - self.slopes @ fit.at), num_goals) / num
        )
        slopes = np.zeros((num_goals, self.slopes.shape[1]))
        np.add.at(slopes, self.goal[kept], self.slopes[kept])
        slopes /= num[:, None]
        square = mean**2 + np.sum((slopes @ fit.covariance) * slopes, axis=1) - 1.0 / num
        square = np.where(fit.choice.part == 1, square / LOOSE**2, square)
        told = self.shared & (fit.choice.part < 2) & (np.bincount(self.goal, kept, num_goals) > 0)
        return square, told

    def set_aside(self, choice: Choice, names: Sequence[str]) -> tuple[str, ...]:
        """What an explanation does not trust, in words."""
        out = []
        for k in np.flatnonzero(choice.part == 2):
            run, start, end = self.places[k]
            when = f"{figure(start, 4)} to {figure(end, 4)} s"
            out.append(f"{names[self.channel[k]]} of {run} off its goal, {when}")
        if num := int((~choice.kept).sum()):
            out.append(f"{num} sample{'' if num == 1 else 's'} far off those beside")
        return tuple(out)

    def _solve(self, weight: Array, precision: Array, slope: Array) -> Array:
        weighted = self.slopes * weight[:, None]
        curvature = self.slopes.T @ weighted + precision
        return np.asarray(np.linalg.solve(curvature, weighted.T @ self.residual + slope))

    def _least_absolute(self, scale: Array, precision: Array, slope: Array) -> Array:
        """Fit of least absolute misfit; all rows of a goal count as one."""
        share = 1.0 / np.bincount(self.goal, minlength=len(self.channel))[self.goal]
        at = self._solve(share / scale**2, precision, slope)
        for _ in range(NUM_ABSOLUTE):
            misfit = np.abs(self.residual - self.slopes @ at)
            at = self._solve(share / (scale * np.maximum(misfit, scale)), precision, slope)
        return at

    def _choose(self, misfit: Array, spreads: Array, odds: Array) -> Choice:
        """Rows and goals that are trusted at a misfit."""
        center = np.zeros(len(self.channel))
        for k in np.flatnonzero(self.shared):
            center[k] = _center(misfit[self.goal == k], float(spreads[0, k]))
        off = misfit - center[self.goal]
        price = row_price(off)
        kept = 0.5 * off**2 <= price
        num = np.bincount(self.goal, kept, len(self.channel))
        mean = np.bincount(self.goal, kept * misfit, len(self.channel)) / np.maximum(num, 1)
        levels = _log_normal(mean, spreads**2 + 1.0 / np.maximum(num, 1)) + odds[:, None]
        has_part = self.shared & (num > 0)
        part = np.where(has_part, np.argmax(levels, axis=0), 0)
        level = float(odds[part[has_part]].sum()) - float(price[~kept].sum())
        return Choice(np.asarray(kept), np.asarray(part), level)

    def _local(self, choice: Choice, spread: Array) -> Local:
        """What the trusted rows say, each goal's offset integrated out (num_goals,)."""
        slopes, residual = self.slopes[choice.kept], self.residual[choice.kept]
        goal = self.goal[choice.kept]
        num = np.bincount(goal, minlength=len(self.channel))
        used = np.flatnonzero((spread > 0.0) & (num > 0))
        place = np.full(len(self.channel), -1)
        place[used] = np.arange(len(used))
        at = place[goal]
        sums = np.zeros((len(used), slopes.shape[1] + 1))
        np.add.at(sums, at[at >= 0], np.column_stack([slopes, residual])[at >= 0])
        factor = spread[used] ** 2 / (1.0 + spread[used] ** 2 * num[used])
        taken = (sums * factor[:, None]).T @ sums
        return Local(
            self.common,
            self.scatter,
            self.causes,
            slopes.T @ slopes - taken[:-1, :-1],
            slopes.T @ residual - taken[:-1, -1],
            float(residual @ residual) - float(taken[-1, -1]),
            len(residual),
            choice.level - 0.5 * float(np.log1p(spread[used] ** 2 * num[used]).sum()),
        )


def rows_at(problem: Problem, layout: Layout, point: Array, causes: Sequence[Effect]) -> Rows:
    """Linearize a group of runs.

    Args:
        problem: Model, the runs of one group, noise, and effects.
        point: Scaled coordinates of the problem to linearize at, (n,).
        causes: Those of its effects that may act; each has one component.
    """
    common, scatter = layout.of(problem.runs)
    idx = [*common, *scatter, *(problem.columns_of(e)[0] for e in causes)]
    residual, slopes = problem.linearize_scaled(problem.standardized(point), only=idx)
    absolute = residual + slopes @ point[idx]  # residual at z = 0 of the linear model
    goals, keep = _goals_of(problem)
    return Rows(
        **vars(goals),
        common=tuple(common),
        scatter=tuple(scatter),
        causes=tuple(e.name for e in causes),
        residual=absolute[keep],
        slopes=slopes[keep],
    )


def row_price(off: Array) -> Array:
    """Nats that a row costs which is set aside, beside a trusted one that is not off at all."""
    cauchy = np.log(np.pi * ROW_SCALE * (1.0 + (off / ROW_SCALE) ** 2)) - 0.5 * np.log(2.0 * np.pi)
    return np.asarray(cauchy - np.log(ROW_ODDS))


def _center(misfit: Array, narrow: float) -> float:
    """Where most rows of a goal are: one of them, or 0."""
    tried = np.append(np.unique(misfit), 0.0)
    off = misfit[None] - tried[:, None]
    cost = np.minimum(0.5 * off**2, row_price(off)).sum(axis=1)
    cost += np.minimum(0.5 * tried**2 / (narrow**2 + 1.0 / len(misfit)), row_price(tried))
    return float(tried[np.argmin(cost)])


def _log_normal(at: Array, variance: Array) -> Array:
    return np.asarray(-0.5 * at**2 / variance - 0.5 * np.log(variance))


def _goals_of(problem: Problem) -> tuple[Goals, Mask]:
    """Goals of the whitened rows of one group, and which of its rows have one: those as a new goal
    comes have none."""
    goals, channels, shared, keeps = [], [], [], []
    places: list[tuple[str, float, float]] = []
    for run in problem.runs:
        stretch, are_goals = _stretches(run)
        valid = np.isfinite(run.measured)
        at, channel = np.nonzero(valid)  # in the order of the rows
        own = np.full(len(at), -1)
        between = are_goals & (np.bincount(stretch)[stretch] < 2)
        for k in np.unique(channel):
            mine = (channel == k) & ~between[at]
            label = stretch[at[mine]]
            for one in np.unique(label):
                chosen = np.flatnonzero(mine)[label == one]
                own[chosen] = len(places)
                times = run.time_s[at[chosen]]
                places.append((run.name, float(times[0]), float(times[-1])))
                channels.append(k)
                shared.append(are_goals)
        goals.append(own)
        keeps.append(~between[at])
    keep = np.concatenate(keeps)
    found = Goals(
        np.concatenate(goals)[keep],
        np.array(channels, dtype=int),
        np.array(shared, dtype=bool),
        tuple(places),
    )
    return found, keep


def _stretches(run: Run) -> tuple[Index, bool]:
    """Stretch of rows without a change of a command, and whether the run has such goals: several,
    of more than one row for the most part. Else each row is for itself."""
    num = len(run.time_s)
    alone = np.arange(num), False
    if not run.command or num < 2:
        return alone
    changes = np.any([np.diff(values) != 0.0 for values in run.command.values()], axis=0)
    stretch = np.append(0, np.cumsum(changes))
    rows = np.bincount(stretch)
    is_held = len(rows) > 1 and rows[rows > 1].sum() > 0.5 * num
    return (stretch, True) if is_held else alone


def learned_tails(found: Iterable[tuple[Rows, Fit]], before: Tails) -> Tails:
    """How far goals are off in groups that teach: the next step of their expectation maximization.

    Args:
        before: What was thought before.
    """
    num_channels = len(before.narrow)
    total, count = np.zeros(num_channels), np.zeros(num_channels)
    missed = 0.0
    for rows, fit in found:
        square, told = rows.squares(fit)
        total += np.bincount(rows.channel[told], square[told], num_channels)
        count += np.bincount(rows.channel[told], minlength=num_channels)
        missed += float(np.sum(fit.choice.part == 2))
    of_all = float(total.sum() / count.sum())
    narrow = np.sqrt(np.maximum((total + USUAL * of_all) / (count + USUAL), FLOOR**2))
    share = (MISSED + missed) / (MISSED + TAKEN + missed + count.sum())
    return Tails(narrow, before.wide, float(share))
