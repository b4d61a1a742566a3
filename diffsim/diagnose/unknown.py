"""Causes without a form: a smooth force, or a smooth drift of one channel, as Gaussian processes.

Each gives responses H, the whitened change of the record per independent N(0, 1) coefficient. Their
common amplitude is averaged over in ``evidence``, so only their shape matters here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from diffsim.diagnose.effect import Effect
from diffsim.identify import Problem

Array = NDArray[np.float64]


class Unknown(ABC):
    """A generic cause.

    Attributes:
        name: For the report, such as "unknown force".
    """

    name: str

    @abstractmethod
    def responses(self, problem: Problem, x: Array) -> Array:
        """(num_valid, m) whitened responses at x, rows in the order of ``problem.runs``."""


class UnknownForce(Unknown):
    """A smooth force, the same in all repeats of a command, different between commands.

    Args:
        effect: Whose components are the force's coefficients, such as knots in time times shapes.
        covariance: (num_components, num_components) of the coefficients, such as
            ``smooth_covariance`` of the knots; scale free.
        name: For the report.
    """

    def __init__(self, effect: Effect, covariance: Array, name: str = "unknown force"):
        m = len(effect.components)
        if covariance.shape != (m, m):
            raise ValueError(f"covariance must have shape ({m}, {m}), got {covariance.shape}")
        self.effect, self.name = effect, name
        self._root = _root(covariance)

    def responses(self, problem: Problem, x: Array) -> Array:
        """One block of columns per command."""
        wide = Problem(
            problem.model,
            problem.runs,
            problem.whitener,
            (*problem.effects, self.effect),
            problem.jacobian,
            problem.numerics,
            problem.workers,
        )
        own = wide.columns_of(self.effect)
        point = np.concatenate([x, np.zeros(len(own))])
        _, jacobian = wide.linearise(point, only=own)
        return _by_group(problem, jacobian[:, own] @ self._root)


class UnknownDrift(Unknown):
    """A smooth drift of one channel, the same in all repeats of a command: no force.

    Args:
        channel: Index of the channel.
        name: For the report.
        knots_per_s: Density; the correlation length is two knots.
        num_knots: At most, over the longest run.
    """

    def __init__(self, channel: int, name: str, knots_per_s: float = 5.0, num_knots: int = 30):
        self.channel, self.name = channel, name
        self.knots_per_s, self.num_knots = knots_per_s, num_knots

    def responses(self, problem: Problem, x: Array) -> Array:
        """Hat functions in time, one block of columns per command."""
        longest = max(float(r.time_s[-1] - r.time_s[0]) for r in problem.runs)
        count = min(max(round(longest * self.knots_per_s) + 1, 4), self.num_knots)
        knots = np.linspace(0.0, longest, count)
        root = _root(smooth_covariance(knots, 2.0 * longest / (count - 1)))
        blocks = []
        for run in problem.runs:
            hats = np.stack([np.interp(run.time_s - run.time_s[0], knots, e) for e in root.T], 1)
            record = np.zeros((*run.measured.shape, count))
            record[:, self.channel] = hats
            blocks.append(problem.whiten(run, record.reshape(-1, count)))
        return _by_group(problem, np.concatenate(blocks))


def smooth_covariance(knots: Array, length: float) -> Array:
    """(m, m) squared-exponential covariance of values at ``knots``."""
    return np.exp(-0.5 * ((knots[:, None] - knots[None, :]) / length) ** 2)


def _root(covariance: Array) -> Array:
    """R with R R' = covariance, directions without variance left out."""
    values, vectors = linalg.eigh(covariance)
    keep = values > 1e-8 * values[-1]
    return vectors[:, keep] * np.sqrt(values[keep])


def _by_group(problem: Problem, columns: Array) -> Array:
    """Columns of each command side by side: independent between commands."""
    groups = list(dict.fromkeys(run.group for run in problem.runs))
    counts = [problem.whitener.matrix(run).shape[0] for run in problem.runs]
    m = columns.shape[1]
    out, start = np.zeros((len(columns), m * len(groups))), 0
    for run, count in zip(problem.runs, counts, strict=True):
        at = groups.index(run.group) * m
        out[start : start + count, at : at + m] = columns[start : start + count]
        start += count
    return out


def drifts(channels: Sequence[str]) -> list[Unknown]:
    """One ``UnknownDrift`` per channel."""
    return [UnknownDrift(i, f"unknown drift of {name}") for i, name in enumerate(channels)]
