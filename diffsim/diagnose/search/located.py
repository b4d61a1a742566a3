"""Scan of an effect that is located in time: few simulations, at the places it proposes.

G are the whitened responses to knots in time at a center, J those of what is fitted there, r the
residual. All else refitted with prior N(0, 1), the course gains what

    G~'G~ = G'G - G'J (J'J + 1)^-1 J'G,    G~'r = G'r - G'J (J'J + 1)^-1 (J'r - x)

say (as in ``screen``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from diffsim.data.study import Run
from diffsim.diagnose.search.scan import Scan, costs_of, linearized, narrowed
from diffsim.identify import Problem
from diffsim.identify.effect import PRIOR_WIDTH, Effect, Locator, coordinate_of
from diffsim.identify.gaussian import Gaussian
from diffsim.identify.linearization import Linearization, linearization_at, records_at
from diffsim.identify.locate import Course, Proposal

Array = NDArray[np.float64]
CHUNK = 128  # knots that are simulated at once
MAX_PROPOSALS = 6


def course_at(wide: Problem, own: Sequence[int], center: Linearization, locator: Locator) -> Course:
    """What any course in time would gain at a center.

    Args:
        wide: Problem with all candidate effects.
        own: Wide coordinates of base parameters and of the set at the center.
        center: Linearization there, with all slopes.
        locator: How the effect finds where it lies.
    """
    residual = wide.residual_of(center.record)
    j = wide.whiten_all(center.slopes(own)) * wide.stretch(center.x)[list(own)]
    at = Gaussian.of(j, residual, center.x[list(own)])
    k = len(locator.times)
    gram, score, cross = np.zeros((k, k)), np.zeros(k), np.zeros((len(own), k))
    narrow = narrowed(wide, own)
    row = 0
    for run in wide.runs:
        count = len(wide.whiten(run, np.zeros(run.measured.size)))
        rows = slice(row, row + count)
        row += count
        if not locator.acts_in(run) or not count:
            continue
        knots = _inside(locator.times, run)
        g = _responses(narrow, run, center.x[list(own)], locator, knots)
        gram[np.ix_(knots, knots)] += g.T @ g
        score[knots] += g.T @ residual[rows]
        cross[:, knots] += j[rows].T @ g
    return Course(locator.times, *at.left_to(cross, gram, score))


def scan_located(
    wide: Problem, own: Sequence[int], center: Linearization, effect: Effect, course: Course
) -> Scan:
    """Simulate the places that an effect proposes, and linearize at the best.

    Args:
        wide: Problem with all candidate effects.
        own: Wide coordinates of base parameters and of the set at the center.
        center: Linearization there, with all slopes.
        effect: Effect with a locator.
        course: What any course in time would gain at the center.
    """
    assert effect.locate is not None
    proposals = list(effect.locate.propose(course))[:MAX_PROPOSALS]
    if not proposals:
        return Scan(None, 0)
    placed = sorted({i for p in proposals for i in _find_parameters(wide, p)})
    columns = [*placed, *wide.columns_of(effect)]
    coordinates = sorted({*own, *columns})
    points = np.stack([_point(wide, center.x, effect, p) for p in proposals])
    records = records_at(narrowed(wide, coordinates), points[:, coordinates])
    rest = [c for c in own if c not in columns]
    costs = costs_of(wide, center, rest, records, points[:, columns])
    here = costs_of(wide, center, rest, center.record[None], center.x[None, columns])[0]
    best = int(np.argmin(costs))
    if not costs[best] < here - 2.0:
        return Scan(None, len(points))
    return Scan(linearized(wide, own, center, columns, points[best]), len(points))


def _inside(times: Array, run: Run) -> NDArray[np.int64]:
    """Knots whose force reaches into a run."""
    step = times[1] - times[0]
    near = (times > run.time_s[0] - step) & (times < run.time_s[-1] + step)
    return np.flatnonzero(near)


def _responses(
    narrow: Problem, run: Run, x: Array, locator: Locator, knots: NDArray[np.int64]
) -> Array:
    """Whitened change of a run per unit of each knot, (num_valid, len(knots))."""
    secant = replace(locator.course, smooth=False)  # one simulation each
    problem = replace(narrow, runs=(run,), effects=(*narrow.effects, secant))
    first = len(x)
    at = np.concatenate([x, np.zeros(len(secant.components))])
    unit = problem.size_units[-1]
    parts = []
    for start in range(0, len(knots), CHUNK):
        wanted = [first + int(k) for k in knots[start : start + CHUNK]]
        columns = linearization_at(problem, at, wanted, screen=True).columns
        parts.append(problem.whiten(run, columns) / unit)
    return np.hstack(parts)


def _find_parameters(wide: Problem, proposal: Proposal) -> list[int]:
    names = [p.name for p in wide.model.base]
    return [names.index(n) for n in proposal.parameters]


def _point(wide: Problem, x: Array, effect: Effect, proposal: Proposal) -> Array:
    """Standardized coordinates of a proposal at a center."""
    out = x.copy()
    for i, value in zip(
        _find_parameters(wide, proposal), proposal.parameters.values(), strict=True
    ):
        parameter = wide.model.base[i]
        low, high = wide.bounds[0][i], wide.bounds[1][i]
        out[i] = np.clip(parameter.coordinate_of(value), low, high)
    out[wide.columns_of(effect)] = coordinate_of(proposal.sizes / (PRIOR_WIDTH * effect.typical))
    return out
