"""One group of runs, linearized: a quadratic misfit in parameters, scatter and sizes of causes."""

from __future__ import annotations

from dataclasses import dataclass

from diffsim.core.arrays import Array
from diffsim.diagnose.faults.groups import Group
from diffsim.identify.problem import Problem


@dataclass(frozen=True, eq=False)
class Local:
    """|r|^2 = square - 2 slope z + z curvature z of one group, in scaled coordinates z."""

    common: tuple[int, ...]  # base parameters that other groups share, the first coordinates
    # base parameters by which this group and its runs scatter, the next ones
    scatter: tuple[int, ...]
    causes: tuple[str, ...]  # names of the causes, the last coordinates
    curvature: Array  # (n, n) information of the whitened samples on z
    slope: Array  # (n,)
    square: float  # |r|^2 at z = 0
    num_samples: int  # samples that were measured and are trusted
    level: float = 0.0  # logarithm of the density of what is not trusted, and of that choice

    @property
    def num_nuisances(self) -> int:
        """Number of coordinates that are no causes."""
        return len(self.common) + len(self.scatter)


def problem_of(problem: Problem, group: Group) -> Problem:
    """The problem of one group's runs alone."""
    return Problem(problem.model, group.runs, problem.whitener, problem.effects, problem.jacobian)
