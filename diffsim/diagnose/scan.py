"""Scans over decades: where fits of effects with kinks start.

The slope at zero of a slack, a dead band or a rate limit says little about large sizes, and of two
that hide each other neither helps alone. Their sizes are simulated from a tenth to thirty times the
typical one, all else refitted linearly; the best is linearized and serves as a center of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from diffsim.core.errors import DiffsimError
from diffsim.data.study import Run
from diffsim.diagnose.optimum import optimum
from diffsim.identify import Problem
from diffsim.identify.effect import Effect
from diffsim.identify.linearization import (
    Linearization,
    linearization_at,
    measured_of,
    records_at,
    whitened,
)
from diffsim.identify.numerics import NumericalEffect
from diffsim.identify.sizes import PRIOR_WIDTH, coordinate_of

Array = NDArray[np.float64]
Members = frozenset[int]
TIMES = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0)  # of the typical size
COARSE_TIMES = (0.3, 1.0, 3.0, 10.0, 30.0)  # in pairs, and for effects of several components
SCAN_NATS = 10.0  # misfit below which nothing large can hide
BORROWED = 1.0  # relative error that slopes from elsewhere are taken to have


@dataclass(frozen=True, eq=False)
class Scan:
    """Sizes that were tried for a group of effects at a center.

    Attributes:
        at: Linearization at the best sizes, in wide coordinates with all slopes; None where none
            is better than zero.
        num_points: Number of sizes that were simulated.
        seconds: CPU time that this took [s].
    """

    at: Linearization | None
    num_points: int
    seconds: float = 0.0


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
        if effects[i].locate is None and _is_scanned(effects[i]):
            yield frozenset({i})
    yield from masking_pairs(effects, members, room)


def _is_scanned(effect: Effect) -> bool:
    is_numerical = isinstance(effect, NumericalEffect)
    return effect.scanned or (not effect.smooth and not is_numerical)


def masking_pairs(effects: Sequence[Effect], members: Members, room: int) -> Iterator[Members]:
    """Pairs of effects outside a set that mask each other, if there is room for two."""
    if room < 2:
        return
    pairs = [
        (i, j)
        for i, j in combinations(range(len(effects)), 2)
        if not {i, j} & members and _mask(effects[i], effects[j])
    ]
    # two with kinks first: one that is smooth shows by its own slope
    for pair in sorted(pairs, key=lambda p: sum(effects[i].smooth for i in p)):
        yield frozenset(pair)


def num_points(effects: Sequence[Effect]) -> int:
    """Number of sizes that a scan of a group tries."""
    return len(_combined(effects))


def scan(wide: Problem, own: Sequence[int], center: Linearization, group: Sequence[int]) -> Scan:
    """Try sizes of a group of effects at a center.

    Args:
        wide: Problem with all candidate effects.
        own: Wide coordinates of base parameters and of the set at the center.
        center: Linearization there, with all slopes.
        group: Indices of the effects whose sizes are tried, ascending.
    """
    effects = [wide.effects[i] for i in group]
    columns = [c for e in effects for c in wide.columns_of(e)]
    tried = _combined(effects)
    coordinates = sorted({*own, *columns})
    narrow = narrowed(wide, coordinates)
    points = np.tile(center.x, (len(tried), 1))
    points[:, columns] = tried
    records = records_for(narrow, points[:, coordinates], center.record)
    rest = [c for c in own if c not in columns]
    costs = costs_of(wide, center, rest, records, points[:, columns])
    here = costs_of(wide, center, rest, center.record[None], np.zeros((1, len(columns))))[0]
    best = int(np.argmin(costs))
    if not costs[best] < here - 2.0:  # within a nat of what no size of theirs does
        return Scan(None, len(tried))
    try:
        place = {c: k for k, c in enumerate(coordinates)}
        at = linearization_at(narrow, points[best][coordinates], [place[c] for c in columns])
    except DiffsimError:  # it cannot be moved there: fits start elsewhere
        return Scan(None, len(tried))
    slopes = center.slopes(range(len(center.x))).copy()
    slopes[:, columns] = at.columns
    everything = tuple(range(len(center.x)))
    found = Linearization(points[best], at.record, everything, slopes, BORROWED)
    return Scan(found, len(tried))


def _mask(a: Effect, b: Effect) -> bool:
    """Whether one names the other, or what its name begins with before the place it acts at."""

    def names(one: Effect, other: Effect) -> bool:
        return any(other.name == m or other.name.startswith(f"{m}_") for m in one.masks)

    return names(a, b) or names(b, a)


def _combined(effects: Sequence[Effect]) -> Array:
    """Standardized coordinates to try, (num_points, num_components)."""
    is_coarse = len(effects) > 1
    parts = [_tried(e, is_coarse or len(e.components) > 1) for e in effects]
    return np.array([np.concatenate(p) for p in product(*parts)])


def _tried(effect: Effect, is_coarse: bool) -> list[Array]:
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
    stands_for = [next(j for j, r in enumerate(runs) if _repeats(run, r)) for run in runs]
    kept = sorted(set(stands_for))
    made = records_at(replace(narrow, runs=tuple(runs[j] for j in kept)), points)
    ends = np.cumsum([runs[j].measured.size for j in kept])[:-1]
    parts = dict(zip(kept, np.split(made, ends, axis=1), strict=True))
    own = np.split(here, np.cumsum([run.measured.size for run in runs])[:-1])
    moved = [parts[j] + (own[i] - own[j]) for i, j in enumerate(stands_for)]
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
    slopes = whitened(wide, center.slopes(rest))
    u = wide.scaled(center.x)[list(rest)]
    low, high = (bound[list(rest)] for bound in wide.bounds)
    is_size = np.array(rest) >= wide.num_base
    gram, measured = slopes.T @ slopes, measured_of(wide)
    costs = np.full(len(records), np.inf)
    for k, record in enumerate(records):
        if not np.isfinite(record).all():
            continue
        residual = whitened(wide, measured - record)
        v = optimum(gram, slopes.T @ residual + gram @ u, low, high, is_size, u)
        left = residual - slopes @ (v - u)
        x = np.where(is_size, coordinate_of(v), v)
        costs[k] = left @ left + x @ x + sizes[k] @ sizes[k]
    return costs


Scans = Mapping[tuple[Members, Members], Scan]
"""By members of the center and group."""
