"""One group of runs, linearized: a quadratic misfit in parameters, scatter and sizes of causes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from diffsim.diagnose.faults.groups import Group
from diffsim.diagnose.faults.layout import Layout
from diffsim.identify.effect import Effect
from diffsim.identify.problem import Problem

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Local:
    """|r|^2 = square - 2 slope z + z curvature z of one group, in scaled coordinates z.

    Attributes:
        common: Base parameters that other groups share, the first coordinates.
        scatter: Base parameters by which this group and its runs scatter, the next ones.
        causes: Names of the causes, the last coordinates.
        curvature: (n, n) information of the whitened samples on z.
        slope: (n,).
        square: |r|^2 at z = 0.
        num_samples: Samples that were measured.
    """

    common: tuple[int, ...]
    scatter: tuple[int, ...]
    causes: tuple[str, ...]
    curvature: Array
    slope: Array
    square: float
    num_samples: int

    @property
    def num_nuisances(self) -> int:
        """Number of coordinates that are no causes."""
        return len(self.common) + len(self.scatter)


def local_at(problem: Problem, layout: Layout, point: Array, causes: Sequence[Effect]) -> Local:
    """Linearize a group of runs.

    Args:
        problem: Model, the runs of one group, noise, and effects.
        layout: Where the base parameters belong.
        point: Scaled coordinates of the problem to linearize at, (n,).
        causes: Those of its effects that may act; each has one component.
    """
    common, scatter = layout.of(problem.runs)
    idx = [*common, *scatter, *(problem.columns_of(e)[0] for e in causes)]
    residual, slopes = problem.linearize_scaled(problem.standardized(point), only=idx)
    slopes = slopes[:, idx]
    absolute = residual + slopes @ point[idx]  # residual at z = 0 of the linear model
    return Local(
        tuple(common),
        tuple(scatter),
        tuple(e.name for e in causes),
        slopes.T @ slopes,
        slopes.T @ absolute,
        float(absolute @ absolute),
        len(residual),
    )


def problem_of(problem: Problem, group: Group) -> Problem:
    """The problem of one group's runs alone."""
    return Problem(problem.model, group.runs, problem.whitener, problem.effects, problem.jacobian)
