"""Scans over decades: where fits of effects with kinks start.

The slope at zero of a slack, a dead band or a rate limit says little about large sizes, and of two
that hide each other neither helps alone. Their sizes are simulated from a tenth to thirty times the
typical one, all else refitted linearly; the best is linearized and serves as a center of its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, permutations, product

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from diffsim.core.errors import DiffsimError
from diffsim.data.study import Run
from diffsim.diagnose.search.optimum import optimum
from diffsim.identify import Problem
from diffsim.identify.effect import PRIOR_WIDTH, Effect, coordinate_of, touches
from diffsim.identify.linearization import Linearization, linearization_at, records_at
from diffsim.identify.model import slopes_are_simulated
from diffsim.identify.numerics import NumericalEffect
from diffsim.identify.whitening import gram_of

Array = NDArray[np.float64]
Members = frozenset[int]
TIMES = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0)  # of the typical size
COARSE_TIMES = TIMES[1:]  # in pairs, and for effects of several components
CLOSE = 30  # sizes from which the best are sought in one run
BEST = 3  # of them, that are looked around and then tried in all runs
ROUNDS = 3  # of looking around, each a third as far as the one before
SHOWING_SIZES = 5  # of them, that show in which run
BORROWED = 1.0  # relative error that slopes from elsewhere are taken to have


@dataclass(frozen=True, eq=False)
class Scan:
    """Sizes that were tried for a group of effects at a center.

    Attributes:
        at: Linearization at the best sizes, in wide coordinates with all slopes; None where none
            is better than zero.
        num_points: Number of sizes that were simulated.
        steps: Weighted steps that this took.
    """

    at: Linearization | None
    num_points: int
    steps: int = 0


def groups(effects: Sequence[Effect], members: Members, room: int) -> Iterator[Members]:
    """Effects outside a set that are located in time, those with kinks, then pairs of effects that
    mask each other.

    Args:
        effects: All candidates.
        members: The set at the center.
        room: Number of effects that may still be added.
    """
    if room < 1:
        return
    outside = [i for i in range(len(effects)) if i not in members]
    placed = {effects[i].family for i in members if effects[i].locate is not None}
    for i in outside:
        # forms of one event share their place in time: a second one cannot lie elsewhere
        if effects[i].locate is not None and effects[i].family not in placed:
            yield frozenset({i})
    for i in outside:
        effect = effects[i]
        is_rough = not effect.smooth and not isinstance(effect, NumericalEffect)
        if effect.locate is None and (effect.scanned or is_rough):
            yield frozenset({i})
    yield from masking_pairs(effects, members, room)


def masking_pairs(effects: Sequence[Effect], members: Members, room: int) -> Iterator[Members]:
    """Pairs of effects outside a set that mask each other, if there is room for two."""
    if room < 2:
        return
    # one names the other, or what its name begins with before the place it acts at
    pairs = {
        (min(i, j), max(i, j))
        for i, j in permutations([i for i in range(len(effects)) if i not in members], 2)
        for masked in effects[j].masks
        if effects[i].name == masked or effects[i].name.startswith(f"{masked}_")
    }
    # two with kinks first: one that is smooth shows by its own slope
    for pair in sorted(pairs, key=lambda p: (sum(effects[i].smooth for i in p), p)):
        yield frozenset(pair)


def num_points(effects: Sequence[Effect], num_runs: int = 1) -> int:
    """Number of sizes that a scan of a group tries.

    Args:
        effects: The group.
        num_runs: Runs that are simulated for each size; one in one run alone counts by its share.
    """
    count = len(_combine_tries(effects))
    if not _is_close(effects):
        return count
    return SHOWING_SIZES + BEST + -(-(count + 2 * BEST * ROUNDS) // num_runs)


def run_for_scans(
    wide: Problem, center: Linearization, tried: Iterable[Members], most: tuple[float, float]
) -> int | None:
    """Index of the run that sizes are tried in, the worst one; None: all of them can be paid.

    A scan finds where fits start, and these have all runs.

    Args:
        wide: Problem with all candidate effects.
        center: Linearization with all slopes.
        tried: Groups of effects whose sizes are tried; those that are located have none.
        most: Sizes, and weighted steps that they may take.
    """
    sizes = [[wide.effects[i] for i in group] for group in tried]
    points = sum(
        num_points(effects, len(first_runs(wide.runs)))
        for effects in sizes
        if effects[0].locate is None
    )
    if min(points, most[0]) * wide.cost() <= most[1] or not can_scan_one_run(wide):
        return None
    misfits = [float(r @ r) for r in wide.by_run(wide.residual_of(center.record))]
    return int(np.argmax(misfits))


def can_scan_one_run(wide: Problem) -> bool:
    """Whether sizes may be tried in one run alone: each is a simulation of its own."""
    return len(first_runs(wide.runs)) > 1 and slopes_are_simulated(wide.model)


def scan(
    wide: Problem,
    own: Sequence[int],
    center: Linearization,
    group: Sequence[int],
    run: int | None = None,
) -> Scan:
    """Try sizes of a group of effects at a center.

    Args:
        wide: Problem with all candidate effects.
        own: Wide coordinates of base parameters and of the set at the center.
        center: Linearization there, with all slopes.
        group: Indices of the effects whose sizes are tried, ascending.
        run: Index of the run that they are tried in; None, or none that they move: all.
    """
    effects = [wide.effects[i] for i in group]
    columns = [c for e in effects for c in wide.columns_of(e)]
    rest = [c for c in own if c not in columns]
    count, tried = num_points(effects, len(first_runs(wide.runs))), _combine_tries(effects)
    if _is_close(effects):
        tried = _best_of_one_run(wide, own, center, columns, tried)
    seen, there = wide, center
    if run is not None and all(touches(wide.names[c], wide.runs[run]) for c in columns):
        seen, there = _in_run(wide, center, run)
    costs = _costs_at(seen, own, there, columns, tried)
    here = costs_of(seen, there, rest, there.record[None], np.zeros((1, len(columns))))[0]
    best = int(np.argmin(costs))
    if not costs[best] < here - 2.0:  # within a nat of what no size of theirs does
        return Scan(None, count)
    x = center.x.copy()
    x[columns] = tried[best]
    return Scan(linearized(wide, own, center, columns, x), count)


def linearized(
    wide: Problem, own: Sequence[int], center: Linearization, columns: Sequence[int], x: Array
) -> Linearization | None:
    """Linearization at sizes that were tried, all other slopes borrowed from the center; None: the
    problem cannot be moved there, and fits start elsewhere."""
    coordinates = sorted({*own, *columns})
    place = {c: k for k, c in enumerate(coordinates)}
    try:
        narrow = narrowed(wide, coordinates)
        at = linearization_at(narrow, x[coordinates], [place[c] for c in columns])
    except DiffsimError:
        return None
    everything = tuple(range(len(center.x)))
    slopes = center.slopes(everything).copy()
    slopes[:, columns] = at.columns
    return Linearization(x, at.record, everything, slopes, BORROWED)


def _costs_at(
    wide: Problem, own: Sequence[int], center: Linearization, columns: Sequence[int], tried: Array
) -> Array:
    """chi2 and prior of sizes (num_points, num_columns), all else refitted linearly."""
    records = _records_at(wide, own, center, columns, tried)
    rest = [c for c in own if c not in columns]
    return costs_of(wide, center, rest, records, tried)


def _records_at(
    wide: Problem, own: Sequence[int], center: Linearization, columns: Sequence[int], tried: Array
) -> Array:
    coordinates = sorted({*own, *columns})
    points = np.tile(center.x, (len(tried), 1))
    points[:, columns] = tried
    return records_for(narrowed(wide, coordinates), points[:, coordinates], center.record)


def _best_of_one_run(
    wide: Problem, own: Sequence[int], center: Linearization, columns: Sequence[int], tried: Array
) -> Array:
    """The best few sizes by the run that they move most, each looked around more and more closely.

    Args:
        tried: Sizes of one component, (num_points, 1); others as of ``_costs_at``.
    """
    tried = tried[np.argsort(tried[:, 0])]
    chosen = _most_moved(wide, own, center, columns, tried[:: len(tried) // SHOWING_SIZES])
    one, there = _in_run(wide, center, chosen)
    costs = _costs_at(one, own, there, columns, tried)
    best = _valleys(costs)[:BEST]
    points, least = tried[best], costs[best]
    away = np.gradient(tried[:, 0])[best, None]
    for _ in range(ROUNDS):
        away = away / 3.0
        around = np.concatenate([points - away, points + away])
        beside = _costs_at(one, own, there, columns, around)
        places = np.concatenate([points, around]).reshape(3, len(points))
        found = np.concatenate([least, beside]).reshape(3, len(points))
        now = np.argmin(found, 0), np.arange(len(points))
        points, least = places[now][:, None], found[now]
    return points


def _in_run(wide: Problem, center: Linearization, run: int) -> tuple[Problem, Linearization]:
    """One run alone, and its part of a linearization."""
    rows = _rows_of(wide.runs)[run]
    part = Linearization(center.x, center.record[rows], center.idx, center.columns[rows])
    return replace(wide, runs=(wide.runs[run],)), part


def _valleys(costs: Array) -> NDArray[np.intp]:
    """Indices of what is no worse than both neighbors, best first."""
    padded = np.concatenate([[np.inf], costs, [np.inf]])
    low = np.flatnonzero((costs <= padded[:-2]) & (costs <= padded[2:]))
    return low[np.argsort(costs[low])]


def _most_moved(
    wide: Problem, own: Sequence[int], center: Linearization, columns: Sequence[int], some: Array
) -> int:
    """Index of the run whose record some sizes move most, over the noise."""
    moved = np.nan_to_num(_records_at(wide, own, center, columns, some) - center.record)
    rows = _rows_of(wide.runs)
    one = [replace(wide, runs=(run,)) for run in wide.runs]
    moves = [linalg.norm(p.whiten_all(moved[:, r].T)) for p, r in zip(one, rows, strict=True)]
    return int(np.argmax(moves))


def _rows_of(runs: Sequence[Run]) -> list[slice]:
    ends = np.cumsum([0, *(run.measured.size for run in runs)])
    return [slice(a, b) for a, b in pairwise(ends)]


def least_tried(effect: Effect) -> float:
    """Size below which an effect that must be known closely was never looked for [unit]; else 0."""
    return min(effect.tries) * effect.typical if _is_close([effect]) else 0.0


def _is_close(effects: Sequence[Effect]) -> bool:
    """Whether an effect of one component names so many sizes that one run has to choose."""
    return len(effects) == 1 and len(effects[0].tries) >= CLOSE and not effects[0].components[1:]


def first_runs(runs: Sequence[Run]) -> list[int]:
    """Indices of the runs that a scan simulates: of one command the first."""
    return sorted(set(_stand_ins(runs)))


def _stand_ins(runs: Sequence[Run]) -> list[int]:
    return [next(j for j, r in enumerate(runs) if _repeats(run, r)) for run in runs]


def _combine_tries(effects: Sequence[Effect]) -> Array:
    """Standardized coordinates to try, (num_points, num_components)."""
    is_coarse = len(effects) > 1
    parts = [_list_tries(e, is_coarse or len(e.components) > 1) for e in effects]
    return np.array([np.concatenate(p) for p in product(*parts)])


def _list_tries(effect: Effect, is_coarse: bool) -> list[Array]:
    """Coordinates of one effect: each component alone, of both signs where it may have them."""
    times = np.array(effect.tries or (COARSE_TIMES if is_coarse else TIMES))
    signs = (1.0, -1.0) if effect.signed else (1.0,)
    count = len(effect.components)
    values = [coordinate_of(s * times / PRIOR_WIDTH) for s in signs]
    return [v * unit for unit in np.eye(count) for part in values for v in part]


def narrowed(wide: Problem, coordinates: Sequence[int]) -> Problem:
    """The problem with the effects only whose coordinates are among the given ones."""
    inside = set(coordinates)
    return replace(
        wide, effects=tuple(e for e in wide.effects if set(wide.columns_of(e)) <= inside)
    )


def records_for(narrow: Problem, points: Array, here: Array) -> Array:
    """Records at points, (K, N); of runs with one command only the first is simulated.

    A repeat is taken to move as the first does, and to differ from it as at the center: its own
    gain or offset is small, and a scan only finds where fits start.

    Args:
        narrow: Problem of the coordinates that are moved.
        points: Standardized coordinates, (K, n).
        here: Record at the center, (N,).
    """
    runs = narrow.runs
    representatives = _stand_ins(runs)
    kept = sorted(set(representatives))
    made = records_at(replace(narrow, runs=tuple(runs[j] for j in kept)), points)
    ends = np.cumsum([runs[j].measured.size for j in kept])[:-1]
    parts = dict(zip(kept, np.split(made, ends, axis=1), strict=True))
    own = np.split(here, np.cumsum([run.measured.size for run in runs])[:-1])
    moved = [parts[j] + (own[i] - own[j]) for i, j in enumerate(representatives)]
    return np.concatenate(moved, axis=1)


def _repeats(run: Run, first: Run) -> bool:
    """Whether a run has the samples, the set-up and the command of another."""
    if run is first:
        return True
    if run.measured.shape != first.measured.shape or run.setup != first.setup:
        return False
    return (
        run.group == first.group
        and run.command.keys() == first.command.keys()
        and np.array_equal(run.time_s - run.time_s[0], first.time_s - first.time_s[0])
        and all(np.array_equal(u, first.command[name]) for name, u in run.command.items())
    )


def costs_of(
    wide: Problem, center: Linearization, rest: Sequence[int], records: Array, sizes: Array
) -> Array:
    """chi2 and prior of records after a linear refit of the rest, (num_points,)."""
    slopes = wide.whiten_all(center.slopes(rest))
    u = wide.scaled(center.x)[list(rest)]
    low, high = (bound[list(rest)] for bound in wide.bounds)
    is_size = np.array(rest) >= wide.num_base
    gram = gram_of(slopes)
    costs = np.full(len(records), np.inf)
    known = np.flatnonzero(np.isfinite(records).all(axis=1))
    if not len(known):
        return costs
    residuals = wide.residual_of(records[known].T)
    pulls = (residuals.T @ slopes) + gram @ u
    ends = np.array([optimum(gram, pull, low, high, is_size, u) for pull in pulls])
    left = residuals - slopes @ (ends - u).T
    x = np.where(is_size, coordinate_of(ends), ends)
    costs[known] = (left**2).sum(0) + (x**2).sum(1) + (sizes[known] ** 2).sum(1)
    return costs
