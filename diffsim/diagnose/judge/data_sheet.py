"""Base parameters beside their data sheets: those far off are findings, like causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.special import ndtri

from diffsim.core.arrays import Array
from diffsim.core.check import LARGEST
from diffsim.data.study import Run
from diffsim.diagnose.judge.averaging import MODEL_FORM, Widening, widening
from diffsim.diagnose.judge.gain import MIN_BLOCKS
from diffsim.diagnose.judge.own_values import words_of
from diffsim.diagnose.judge.records import EFFECT, HALF_LEVEL, SURE, BaseRow, CauseRow, Interval
from diffsim.diagnose.search.search import LEFT_SHEET_SD
from diffsim.identify import Fit
from diffsim.identify.effect import Effect, effect_coordinates
from diffsim.identify.model import Parameter
from diffsim.identify.ranges import Range

AWAY_SD = 2.0  # of what is stated: nearer, a number is about as stated
WRONG_SHEET_SD = 10.0  # of a data sheet that is wrong, in its own standard deviations


def pull_limit(parameters: Sequence[Parameter]) -> float:
    """Distance from the data sheet from which on a parameter is a finding [prior sd].

    Of many parameters one is far off by chance: the limit grows with their number, so that one
    right description in a hundred has a finding (Bonferroni).

    Args:
        parameters: All base parameters; those that each run has of its own count once.
    """
    num = len({p.name.partition("@")[0] for p in parameters})
    return -float(ndtri((1.0 - SURE) / (2.0 * max(1, num))))


def far_off(rows: Sequence[BaseRow], *, unknown_acts: bool) -> dict[str, float]:
    """Parameters so far off that what is named may stand in for what they took up.

    A finding says itself what is wrong, unless it is further off than 99 % even of wrong data
    sheets are while something unknown acts. What is a run's own says nothing of the data sheet.

    Args:
        rows: Base parameters, findings among them.
        unknown_acts: Whether an unknown cause has the evidence beside the names.

    Returns:
        Distance from the data sheet by the parameter's words [prior sd].
    """
    widest = -WRONG_SHEET_SD * float(ndtri((1.0 - SURE) / 2.0))
    found = {row.name for row in rows if row.finding}

    def limit(row: BaseRow) -> float:
        if row.name.partition("@")[0] not in found:
            return LEFT_SHEET_SD
        return widest if unknown_acts else np.inf

    return {row.words: row.pull for row in rows if abs(row.pull) > limit(row)}


def told_away(rows: Sequence[BaseRow], base: Sequence[Parameter]) -> tuple[BaseRow, ...]:
    """Numbers of all runs that are told to lie away from what is stated, though no findings, the
    furthest first: widths are often guesses, and nobody is surprised by what one allows, but would
    like to know of a gain of 0.6 times the file's.

    Args:
        rows: Base parameters, findings among them.
        base: The same as the study states them.
    """
    usual = {p.name for p in base if p.is_usual}
    away = (
        row
        for row in rows
        if not row.finding and row.run is None and row.name not in usual and row.prior_value > 0.0
        if abs(row.pull) > AWAY_SD
        if max(row.low - row.prior_value, row.prior_value - row.high) > row.prior_sd
    )
    return tuple(sorted(away, key=lambda row: -abs(row.pull)))


def base_rows(
    fit: Fit,
    runs: Sequence[Run],
    wider: Widening,
    *,
    judged: bool,
    wrong: Mapping[str, tuple[float, float]] | None = None,
) -> tuple[BaseRow, ...]:
    """Base parameters of the runs that were fitted, with what their data sheets say.

    A data sheet that is wrong holds its parameter back, and that bends all it is fitted with:
    intervals hold what is found both with it and without.

    Args:
        fit: Fit of the best set.
        judged: Whether findings may be stated: repeats and numerical settings are in order.
        wrong: Value and sd of parameters without the pull of a data sheet that is wrong, in its
            standard deviations, by name; None: none.
    """
    sd, names = np.sqrt(np.diag(fit.covariance)), {run.name for run in runs}
    base, rows = fit.problem.model.base, []
    limit = pull_limit(base)
    moved, free_sd = _without_wrong(fit, limit)
    for i, p in enumerate(base):
        run = p.name.partition("@")[2] or None
        if run is not None and run not in names:
            continue
        # parts agree on what none of them tells: the prior is all that is known of it
        borrowed = wider.usual if run is None and p.name not in fit.undetermined else 1.0
        factor = wider.factors.get(p.name, borrowed)
        x, spread = (wrong or {}).get(p.name, (float(fit.x[i]), float(sd[i])))
        row = _base_row(p, x, spread * factor, run, limit)
        if moved[i] and p.name not in (wrong or {}):
            free = _base_row(p, x + float(moved[i]), float(free_sd[i]) * factor, run, limit)
            row = replace(row, low=min(row.low, free.low), high=max(row.high, free.high))
        # what is stated is what is saved: the fit's value
        value = fit.values[p.name]
        row = replace(row, value=value, low=min(row.low, value), high=max(row.high, value))
        rows.append(row)
    if not judged:
        return tuple(rows)
    # far off, and the interval does not hold the value of the data sheet, if there is one
    usual = {p.name for p in base if p.is_usual}
    alone = (
        replace(r, finding=abs(r.pull) > r.limit and not r.low <= r.prior_value <= r.high)
        if r.run is None and r.name not in usual
        else r
        for r in rows
    )
    return (*alone, *_pulled_together(rows))


def misfit_unheld(fit: Fit) -> float:
    """Misfit that a fit leaves, by slopes, if data sheets that it has left hardly hold it."""
    left = _left_sheets(fit, pull_limit(fit.problem.model.base))
    if not left:
        return fit.chi2
    pulls, inner = fit.x[left], np.linalg.inv(fit.covariance[np.ix_(left, left)])
    taken = 1.0 - WRONG_SHEET_SD**-2  # of the precision of their priors
    # a record may not tell one of them where it has gone: without a sheet it would be anywhere
    free = np.linalg.solve(inner - taken * np.eye(len(left)), pulls)
    return fit.chi2 - taken**2 * float(pulls @ free)


def _left_sheets(fit: Fit, limit: float) -> list[int]:
    base = fit.problem.model.base
    return [j for j, p in enumerate(base) if "@" not in p.name and abs(fit.x[j]) > limit]


def _without_wrong(fit: Fit, limit: float) -> tuple[Array, Array]:
    """Where a fit goes, by its slopes, if data sheets that it has left do not hold it.

    Returns:
        Change of the coordinates, (n,), and their standard deviations there, (n,).
    """
    covariance, left = fit.covariance, _left_sheets(fit, limit)
    if not left:
        return np.zeros(len(fit.x)), np.sqrt(np.diag(covariance))
    columns = covariance[:, left]
    taken = 1.0 - WRONG_SHEET_SD**-2  # of the precision of their priors
    inner = np.eye(len(left)) / taken - covariance[np.ix_(left, left)]  # a change of low rank
    free = covariance + columns @ np.linalg.solve(inner, columns.T)
    return free[:, left] @ (taken * fit.x[left]), np.sqrt(np.diag(free))


def _base_row(p: Parameter, x: float, sd: float, run: str | None, limit: float) -> BaseRow:
    def at(q: float) -> float:
        value = float(p.value_at(torch.tensor(q, dtype=torch.float64)))
        return min(value, LARGEST)  # files have no infinity

    scale = at(x) * p.sd if p.log else p.sd
    return BaseRow(
        name=p.name,
        words=words_of(p.name),
        unit=p.unit,
        value=at(x),
        sd=scale * sd,
        low=at(x - HALF_LEVEL * sd),
        high=at(x + HALF_LEVEL * sd),
        prior_value=p.value,
        prior_sd=p.sd * p.value if p.log else p.sd,
        pull=x,
        limit=limit,
        run=run,
    )


def pull_of(pulls: Sequence[float]) -> float:
    """Pull of one parameter, or of what several runs have each [prior sd of their mean]."""
    return float(np.mean(pulls) * np.sqrt(len(pulls)))


def _pulled_together(rows: Sequence[BaseRow]) -> tuple[BaseRow, ...]:
    """Parameters of single runs that lie on one side of their data sheet in all runs: a row for
    each, with the mean over the runs; its interval holds those of all runs."""
    stems: dict[str, list[BaseRow]] = {}
    for row in rows:
        if row.run is not None:
            stems.setdefault(row.name.partition("@")[0], []).append(row)
    found = []
    for stem, own in stems.items():
        pulls = [row.pull for row in own]
        same_side = len(own) >= MIN_BLOCKS and abs(np.sign(pulls).sum()) == len(own)
        if same_side and abs(pull_of(pulls)) > own[0].limit:
            together = replace(
                own[0],
                name=stem,
                words=f"{words_of(stem)} in all runs",
                value=float(np.mean([row.value for row in own])),
                sd=float(np.sqrt(np.mean([row.sd**2 for row in own]))),  # of one run
                low=min(row.low for row in own),
                high=max(row.high for row in own),
                pull=pull_of(pulls),
                run=None,
                finding=True,
            )
            found.append(together)
    return tuple(found)


def ranges_of_answer(
    fit: Fit, base: Sequence[BaseRow], causes: Sequence[CauseRow]
) -> dict[str, Range]:
    """Intervals as an answer states them, by name of parameter or component, each in its unit."""
    return _ranges(fit, base, {row.name: row.size for row in causes if row.origin == EFFECT})


def _ranges(
    fit: Fit, base: Sequence[BaseRow], sizes: Mapping[str, Mapping[str, Interval]]
) -> dict[str, Range]:
    """Intervals by name, of sizes by name of the cause and of its component."""
    stated: dict[str, BaseRow | Interval] = {row.name: row for row in base}
    for effect in fit.problem.effects:
        own = sizes.get(effect.name, {})
        names = effect_coordinates([effect])
        stated |= {n: own[c] for n, c in zip(names, effect.components, strict=True) if c in own}
    found = {name: (value, stated[name]) for name, value in fit.values.items() if name in stated}
    return {name: Range(v, min(at.low, v), max(at.high, v)) for name, (v, at) in found.items()}


def ranges_of_fit(fit: Fit, runs: Sequence[Run]) -> dict[str, Range]:
    """Intervals of one fit, widened to the spread over fits without a part of the runs.

    Args:
        fit: Fit of the extended model, whose causes were chosen before.
    """
    wider = widening(fit)
    rows = base_rows(fit, runs, wider, judged=False)
    sizes = {e.name: _sizes(fit, e, wider.factors, wider.usual) for e in fit.problem.effects}
    return _ranges(fit, rows, sizes)


def _sizes(
    fit: Fit, effect: Effect, factors: Mapping[str, float], usual: float
) -> dict[str, Interval]:
    """Sizes of an effect by component, their normals widened."""
    out = {}
    for name, component in zip(effect_coordinates([effect]), effect.components, strict=True):
        value = fit.values[name]
        half = HALF_LEVEL * np.hypot(fit.sd[name] * factors.get(name, usual), MODEL_FORM * value)
        low = value - half if effect.signed else max(value - half, 0.0)
        out[component] = Interval(value, float(low), float(value + half))
    return out
