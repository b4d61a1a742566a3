"""A run unlike the others: read in another unit, with a turned sign, by another clock or column.

The plain model is fitted to the runs in which nothing was changed by hand, each as noisy as what it
leaves, so that one bad run has no say. A run of any use is then held against what the others tell.
It is at fault where one change of its record brings it to where the others are, and the same change
of theirs would spoil them: a cause acts in all runs, a slip of the logger in one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import torch

from diffsim.core.arrays import Array
from diffsim.core.errors import DiffsimError
from diffsim.core.unit_slips import LESSER_SLIPS, UNIT_SLIPS
from diffsim.data.record.signals import Record
from diffsim.data.signal import scatter
from diffsim.data.study import Run, Study
from diffsim.data.study_check import Problem
from diffsim.identify.effect import touches
from diffsim.identify.model import TOGETHER, SimModel
from diffsim.identify.ranges import SURE_SD
from diffsim.identify.setup import DiagnosisSetup

RULE = "runs"
ROWS = 1000  # of a run, that are simulated
MIN_SAMPLES = 8  # of a run or a window: fewer tell no motion
MOST_RUNS = 12  # that are looked at
MOST_STEPS = 1e6  # weighted: a sixteenth of a first answer, some four seconds
STEPS = 5  # of the fit
NUDGE = 0.01  # sd of a number, for slopes
FAR_SQUARES = SURE_SD**2  # times the squares that the others leave: three times as far
TOLD_SHARE = 0.25  # of a channel's squares, at most, that the others leave
FAR_SHARE = 0.02  # of a channel's squares: less is no slip
NEAR_SQUARES = 2.0  # times the squares of the others, or of the best change: explained as well
CURED = 1e3  # times less squares than with the slip: near, if not as near as others
LATEST = 0.25  # of a run: how far a clock may be off


@dataclass(frozen=True, eq=False)
class _RunAsTold:
    """A run as the plain model tells it."""

    run: Run  # its beginning
    told: Array  # predicted, (num_samples, num_channels) [unit of the channel]
    slopes: Array  # along the standardized numbers, (num_samples, num_channels, num_base)

    @property
    def off(self) -> Array:
        """Measured minus predicted."""
        return self.run.measured - self.told


@dataclass(frozen=True)
class _Change:
    """A slip that a run may have, as what its record would be without it."""

    says: str  # the slip in words
    remedy: str  # keys that mend it
    # which channels it changes: the columns of the record that stand in their places
    channels: tuple[tuple[int, int], ...] = ()
    scale: tuple[float, float] = (1.0, 0.0)  # factor and level that mend these channels
    later: int = 0  # rows by which channels come too late
    # which command is to be taken for which, and its factor
    commands: tuple[tuple[str, str, float], ...] = ()

    def measured(self, values: Array) -> Array:
        """Channels without the slip, (num_samples, num_channels)."""
        out = values.copy()
        for to, source in self.channels:
            out[:, to] = self.scale[0] * values[:, source] + self.scale[1]
        if self.later:
            out = np.full_like(values, np.nan)
            k, n = self.later, len(values)
            out[max(-k, 0) : n - max(k, 0)] = values[max(k, 0) : n - max(-k, 0)]
        return out

    def of(self, run: Run) -> Run:
        """The run without the slip."""
        new = {to: times * run.command[source] for to, source, times in self.commands}
        return replace(run, command={**run.command, **new}, measured=self.measured(run.measured))


def run_problems(study: Study, setup: DiagnosisSetup) -> Iterator[Problem]:
    """Runs whose record has a slip that the others do not have, whatever they are used for.

    Args:
        setup: What the description made; where it cuts the runs, nothing is asked.
    """
    if setup.study is not None or study.faults is not None:
        return
    runs = [run.part(slice(ROWS)) for run in study.runs if len(run.time_s) >= MIN_SAMPLES]
    runs = runs[:MOST_RUNS]
    if len(runs) < 3 or _cost(setup.model, runs) > MOST_STEPS:
        return
    told = _Others.of(setup.model, study, runs)
    for k, seen in enumerate(told.runs):
        if told.is_off(k) and (problem := told.slip_of(k)) is not None:
            yield Problem("error", f"run {seen.run.name}", problem, RULE)


def _cost(model: SimModel, runs: Sequence[Run]) -> float:
    """Weighted steps of the fit."""
    more = sum(TOGETHER if model.batched else 1.0 for p in model.base if not p.of_effect)
    return STEPS * (1.0 + more) * sum(model.cost(run) for run in runs)


@dataclass(frozen=True, eq=False)
class _Others:
    """Runs beside a plain model that is fitted to all of them, each as noisy as what it leaves."""

    study: Study
    model: SimModel
    runs: tuple[_RunAsTold, ...]  # as the fit tells them
    q: Array  # standardized numbers of the fit, (num_base,)
    floor: Array  # noise of each channel, (num_channels,) [unit of the channel]

    @classmethod
    def of(cls, model: SimModel, study: Study, runs: Sequence[Run]) -> _Others:
        """The fit, from the data sheet."""
        stated = [c.sd or _noise(runs, i) for i, c in enumerate(study.channels)]
        at = cls(study, model, (), model.at_prior().numpy(), np.maximum(stated, 1e-300))
        at = at.moved(runs, at.q)
        for _ in range(STEPS):
            whole, pull = at.normal()
            step = np.linalg.solve(whole, pull) - at.q
            before = at.loss
            for share in (1.0, 0.3, 0.1):
                new = at.moved(runs, at.q + share * step)
                if new.loss < at.loss:
                    at = new
                    break
            if before - at.loss < 1.0:
                break
        return at

    def moved(self, runs: Sequence[Run], q: Array) -> _Others:
        """The same at other numbers."""
        return replace(self, q=q, runs=tuple(_run_as_told(self.model, run, q) for run in runs))

    @property
    def left(self) -> Array:
        """Mean squares that each run leaves of each channel, (num_runs, num_channels); NaN where
        nothing was measured, infinite where there is no number."""
        return np.stack([_mean_squares(seen.off, seen.told) for seen in self.runs])

    @property
    def loss(self) -> float:
        """Twice the negative logarithm of the posterior, noise as large as what is left."""
        counts = np.stack([np.isfinite(seen.run.measured).sum(0) for seen in self.runs])
        left = np.fmax(self.left, self.floor**2)
        there = (counts > 0) & np.isfinite(left)
        lost = 1e300 if np.isinf(self.left).all(1).all() else 0.0
        return float((counts[there] * np.log(left[there])).sum() + (self.q**2).sum() + lost)

    def normal(self, without: int = -1) -> tuple[Array, Array]:
        """Normal matrix of the numbers with their priors, and its right side.

        Args:
            without: Place of a run that has no say.
        """
        whole, pull = np.eye(len(self.q)), np.zeros(len(self.q))
        for k, (seen, left) in enumerate(zip(self.runs, self.left, strict=True)):
            if k == without or np.isinf(left).any():
                continue
            rows, off = _rows(seen.slopes, seen.off, np.sqrt(np.fmax(left, self.floor**2)))
            whole += rows.T @ rows
            pull += rows.T @ (off + rows @ self.q)
        return whole, pull

    def level(self, k: int) -> Array:
        """Squares that the others usually leave of each channel, (num_channels,)."""
        others = np.ma.masked_invalid(np.delete(self.left, k, axis=0))
        return np.fmax(np.ma.median(others, axis=0).filled(np.nan), self.floor**2)

    def is_off(self, k: int) -> bool:
        """Whether a run is far from what the others tell, whatever numbers they leave open."""
        seen, level = self.runs[k], self.level(k)
        if not np.isfinite(level).all():
            return False
        usual = np.array([_usual(self.runs, i) for i in range(len(level))])
        far = np.fmax(FAR_SQUARES * level, FAR_SHARE * usual)
        is_told = level < TOLD_SHARE * usual  # by the others; else nothing is known of it
        left = self.beside(k, seen, level) * level
        return bool(((left > far) & is_told).any())

    def beside(self, k: int, seen: _RunAsTold, level: Array) -> Array:
        """Squares over the usual ones that a record leaves beside what the other runs tell.

        Args:
            k: Place of the run that has no say.
            seen: Its record as it is or as it would be, and what is told of it.
            level: Usual squares, (num_channels,).
        """
        if not np.isfinite(seen.told).all():
            return np.full(len(level), np.inf)
        whole, pull = self.normal(without=k)
        at = np.linalg.solve(whole, pull)
        own = [i for i, p in enumerate(self.model.base) if p.name.endswith(f"@{seen.run.name}")]
        whole[own, own] = 1e-9  # free: its start may be stated by the record that has the slip
        off = seen.off - seen.slopes @ (at - self.q)
        rows, left = _rows(seen.slopes, off, np.sqrt(level))
        by = np.linalg.solve(whole + rows.T @ rows, rows.T @ left)
        spread = np.full(off.shape, np.nan)
        spread[np.isfinite(off)] = left - rows @ by
        # how far the numbers go from what the others tell of them is a misfit, too
        return _mean_squares(spread, spread) + by @ whole @ by / max(len(left), 1)

    def slip_of(self, k: int) -> str | None:
        """The change that mends a run and would spoil the others, in words; None: there is none."""
        seen, level = self.runs[k], self.level(k)
        before = self.beside(k, seen, level)
        found: list[tuple[float, _Change]] = []
        for change in _changes(self, k):
            after = self.after(k, change, level)
            most = float(np.nanmax(before))
            if after <= max(min(NEAR_SQUARES, most / FAR_SQUARES), most / CURED):
                # of a record that is a thousand times too small nothing is left with no command
                size = np.nanvar(change.measured(seen.run.measured))
                share = after * float(np.nanmax(level / np.maximum(size, 1e-300)))
                found.append((share, change))
        found = [(a, c) for a, c in found if a < TOLD_SHARE and self.spoils(k, c)]
        if not found:
            return None
        found.sort(key=lambda pair: pair[0])
        least, first = found[0]
        twins = [c.says for a, c in found[1:] if a <= NEAR_SQUARES * least]
        beside = f" (as well: {'; '.join(twins[:2])})" if twins else ""
        times = float(np.sqrt(np.nanmax(before)))
        return (
            f"{first.says}{beside}, as the model sees it: without this slip it agrees with the "
            f"other runs, with it its misfit is {times:.2g} times theirs: {first.remedy}"
        )

    def after(self, k: int, change: _Change, level: Array) -> float:
        """Squares over the usual ones that a run leaves with a slip mended; the worst channel."""
        seen = self.runs[k]
        run = change.of(seen.run)
        if change.commands:
            seen = _run_as_told(self.model, run, self.q)
        else:  # a model may begin where the record does
            told = _told_by_model(self.model, run, torch.from_numpy(self.q)[None])[0]
            seen = replace(seen, run=run, told=told)
        left = self.beside(k, seen, level)
        return float(np.nanmax(left)) if np.isfinite(left).any() else np.inf

    def spoils(self, k: int, change: _Change) -> bool:
        """Whether a change that mends one run makes all others worse: then it is no cause."""
        level = self.level(k)
        changed = []
        for j, seen in enumerate(self.runs):
            if j == k or np.isinf(self.left[j]).any():
                continue
            before = float(np.nanmax(self.beside(j, seen, level)))
            if before > FAR_SQUARES:
                continue  # at fault itself
            if (now := self.after(j, change, level)) < before:
                return False
            changed.append(now)
        return bool(changed) and float(np.mean(changed)) > FAR_SQUARES


def _run_as_told(model: SimModel, run: Run, q: Array) -> _RunAsTold:
    """A run at numbers, with slopes along those that act in it."""
    base = model.base
    acting = [i for i, p in enumerate(base) if not p.of_effect and touches(p.name, run)]
    at = torch.from_numpy(q)
    points = at.repeat(len(acting) + 1, 1)
    for row, i in enumerate(acting):
        points[row + 1, i] += NUDGE
    slopes, told = np.zeros((*run.measured.shape, len(base))), _told_by_model(model, run, points)
    if np.isfinite(told).all():
        slopes[..., acting] = np.moveaxis(told[1:] - told[0], 0, -1) / NUDGE
        return _RunAsTold(run, told[0], slopes)
    return _RunAsTold(run, np.full_like(run.measured, np.nan), slopes)


def _told_by_model(model: SimModel, run: Run, points: torch.Tensor) -> Array:
    """Predictions at points, (num_points, num_samples, num_channels); NaN where there are none."""
    try:
        with torch.no_grad():
            return np.asarray(model.predict_many(run, points).numpy())
    except DiffsimError:  # such as a pull that nothing bears
        return np.full((len(points), *run.measured.shape), np.nan)


def _noise(runs: Sequence[Run], i: int) -> float:
    """Scatter of a channel from sample to sample, in the usual run [unit of the channel]."""
    seen = [run.measured[:, i] for run in runs if np.isfinite(run.measured[:, i]).sum() > 2]
    found = [float(scatter(np.diff(x[np.isfinite(x)], 2), 2)) for x in seen]
    return float(np.median(found)) if found else 0.0


def _usual(runs: Sequence[_RunAsTold], i: int) -> float:
    """Mean square of a channel about its mean, in the usual run [unit of the channel, squared]."""
    seen = [seen.run.measured[:, i] for seen in runs]
    found = [float(np.nanvar(x)) for x in seen if np.isfinite(x).any()]
    return float(np.median(found)) if found else 0.0


def _rows(slopes: Array, off: Array, sd: Array) -> tuple[Array, Array]:
    """Slopes (num, num_base) and misfits (num,) of what was measured, over its noise."""
    there = np.isfinite(off)
    return (slopes / sd[:, None])[there], (off / sd)[there]


def _mean_squares(off: Array, told: Array) -> Array:
    """Mean square of each channel, (num_channels,); NaN: nothing measured, inf: no prediction."""
    counts = np.isfinite(off).sum(0)
    sums = np.where(np.isfinite(off), off, 0.0) ** 2
    mean = np.where(counts > 0, sums.sum(0) / np.maximum(counts, 1), np.nan)
    return mean if np.isfinite(told).any() else np.full(off.shape[1], np.inf)


def _changes(others: _Others, k: int) -> Iterator[_Change]:
    """Slips that a run may have: exchanges, signs, units, its clock; of channels, then commands."""
    study, seen = others.study, others.runs[k]
    record = Record.of(study)
    columns = [s.column for s in record.channels]
    inputs = {s.name: s for s in record.commands}
    names = [c.name for c in study.channels]
    for a, b in combinations(range(len(names)), 2):
        yield _Change(
            f"its columns of channels {names[a]} and {names[b]} are exchanged",
            f"`columns: {{{names[a]}: {columns[b]}, {names[b]}: {columns[a]}}}` in this run",
            channels=((a, b), (b, a)),
        )
    for group in _groups(study):
        which = ", ".join(names[i] for i in group)
        are = f"channel{'s' if len(group) > 1 else ''} {which}"
        for factor, says in _factors(study.channels[group[0]].unit):
            keys = ", ".join(
                f'{names[i]}: {{formula: "{columns[i]}*({factor:.6g})"}}' for i in group
            )
            yield _Change(
                f"{are} {says}",
                f"`columns: {{{keys}}}` in this run",
                channels=tuple((i, i) for i in group),
                scale=(factor, 0.0),
            )
        if study.channels[group[0]].unit == "K":
            keys = ", ".join(f"{names[i]}: {{column: {columns[i]}, unit: degF}}" for i in group)
            yield _Change(
                f"{are} in degrees Fahrenheit",
                f"`columns: {{{keys}}}` in this run",
                channels=tuple((i, i) for i in group),
                scale=(1.0 / 1.8, 273.15 - (32.0 + 273.15) / 1.8),
            )
    if (rows := _latest(others, k)) != 0:
        late = rows * float(np.median(np.diff(seen.run.time_s)))
        yield _Change(
            f"its channels are {abs(late):.3g} s {'late' if late > 0 else 'early'}",
            "set one of the two clocks of its file anew, or leave the run out",
            later=rows,
        )
    driven = [n for n in seen.run.command if n in inputs]
    for one, two in combinations(driven, 2):
        yield _Change(
            f"its columns of commands {one} and {two} are exchanged",
            f"`columns: {{{one}: {inputs[two].column}, {two}: {inputs[one].column}}}` in this run",
            commands=((one, two, 1.0), (two, one, 1.0)),
        )
    for name in driven:
        column = inputs[name].column
        for factor, says in _factors(inputs[name].unit):
            yield _Change(
                f"command {name} {says}",
                f'`columns: {{{name}: {{formula: "{column}*({factor:.6g})"}}}}` in this run',
                commands=((name, name, factor),),
            )


def _groups(study: Study) -> list[tuple[int, ...]]:
    """Channels that may have a slip alike: each alone, all of a unit, and all."""
    every = range(len(study.channels))
    units = dict.fromkeys(c.unit for c in study.channels)
    alike = [tuple(i for i in every if study.channels[i].unit == unit) for unit in units]
    return list(dict.fromkeys([*((i,) for i in every), *alike]))


def _factors(unit: str | None) -> Iterator[tuple[float, str]]:
    """Factors that mend a slip of what has a unit, with its words."""
    yield -1.0, "with a turned sign"
    for slip in (s for s in (*UNIT_SLIPS, *LESSER_SLIPS) if s.suits(unit)):
        for factor in (1.0 / slip.ratio, slip.ratio):
            yield factor, f"in another unit, by {slip.words}"


def _latest(others: _Others, k: int) -> int:
    """Rows by which channels come later than commands: those that leave least of the record."""
    seen, level = others.runs[k], others.level(k)
    most = int(LATEST * len(seen.run.time_s))
    off = {}
    for rows in range(-most, most + 1):
        moved = _Change("", "", later=rows).measured(seen.run.measured) - seen.told
        off[rows] = float(np.nanmax(_mean_squares(moved, seen.told) / level))
    return min(off, key=lambda rows: off[rows])
