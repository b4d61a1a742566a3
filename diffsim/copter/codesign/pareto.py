"""Fronts of designs between metrics that pull apart."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from concurrent.futures import Executor
from functools import partial
from typing import Any

import numpy as np

from diffsim.copter.codesign.api import codesign
from diffsim.copter.codesign.metrics import parse_objective
from diffsim.copter.codesign.result import CoDesignResult
from diffsim.copter.codesign.space import DesignSpace
from diffsim.core.arrays import Array
from diffsim.core.check import require_number
from diffsim.core.checked import checked
from diffsim.core.progress import show_progress
from diffsim.core.runs import run_each


@checked
def pareto_front(
    design: DesignSpace,
    metrics: Sequence[str],
    *,
    num_points: int = 9,
    progress: bool = True,
    executor: Executor | None = None,
    **settings: Any,
) -> list[CoDesignResult]:
    """Designs of which none is better than another in every metric, by weighted sums.

    The mixes are evenly spread over the simplex of weights. A weighted sum finds the convex part
    of a front only.

    Args:
        design: The parametric design.
        metrics: Two or more names of ``METRICS``.
        num_points: Weights along each edge of the simplex, >= 2.
        progress: Show a progress bar.
        executor: Executor of the mixes (``core.open_executor``); None: one after another.
        **settings: Further arguments of ``codesign``.

    Returns:
        The designs that no other one dominates, sorted by the first metric.

    Raises:
        ValueError: fewer than two metrics, unknown or repeated ones, num_points below 2.
    """
    names = list(parse_objective(dict.fromkeys(metrics, 1.0)))
    if len(names) < 2 or len(names) != len(metrics):
        raise ValueError(f"metrics must be two or more different names, got {list(metrics)}")
    require_number("num_points", num_points, at_least=2)
    mixes = [dict(zip(names, mix, strict=True)) for mix in _simplex(len(names), num_points)]
    with show_progress(total=len(mixes), disable=not progress, unit="mix") as bar:
        results = run_each(
            partial(codesign, design, **settings), mixes, executor, done=lambda *_: bar.update()
        )
    keep = undominated(np.array([[r.metrics[name] for name in names] for r in results]))
    return sorted((results[i] for i in keep), key=lambda r: r.metrics[names[0]])


def undominated(values: Array, *, tolerance: float = 1e-6) -> list[int]:
    """Rows that no other row is below in one column and not above in any; (num_designs, num)."""
    keep: list[int] = []
    for i, row in enumerate(values):
        better = (values <= row + tolerance).all(1) & (values < row - tolerance).any(1)
        same = [j for j in keep if np.abs(values[j] - row).max() <= tolerance]
        if not better.any() and not same:
            keep.append(i)
    return keep


def _simplex(num_metrics: int, num_points: int) -> list[tuple[float, ...]]:
    """Weights that sum to one on a grid, each at least a thousandth so that all are reported."""
    steps = num_points - 1
    grid = [
        tuple(max(k / steps, 1e-3) for k in counts)
        for counts in itertools.product(range(num_points), repeat=num_metrics)
        if sum(counts) == steps
    ]
    return grid
