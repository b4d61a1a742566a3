"""Causes without a form: a smooth force, drift or law of one channel, as Gaussian processes.

Each gives responses H, the change of the record per independent N(0, 1) coefficient. Their
common amplitude is averaged over in ``evidence``, so only their shape matters here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import linalg

from diffsim.core.arrays import Array
from diffsim.core.checked import checked, checked_methods
from diffsim.identify.effect import Effect
from diffsim.identify.linearization import linearization_at
from diffsim.identify.model import has_tangents
from diffsim.identify.problem import Problem

if TYPE_CHECKING:
    from diffsim.data.study import Run


@checked_methods
class Unknown(ABC):
    """A generic cause: any smooth force or drift, without a named form.

    Attributes:
        name: Name in the report, such as "unknown force".
    """

    name: str

    @abstractmethod
    def slopes(self, problem: Problem, x: Array) -> Array:
        """(N, k) change of all samples of all runs per component, at x, not whitened."""

    def mix(self, slopes: Array) -> Array:
        """(N, m) of (N, k): from components to independent coefficients."""
        return slopes

    def suited(self, num_cosines: int) -> Unknown:
        """The cause as fast as that many cosines over the longest run; itself if it is as it is."""
        return self

    @property
    def label(self) -> str:
        """Name under which what was simulated for it is kept."""
        return self.name

    def responses(self, problem: Problem, x: Array) -> Array:
        """(num_valid, m * num_groups) whitened responses at x, rows in the order of
        ``problem.runs``; one block of columns per command."""
        return self.spread(problem, self.slopes(problem, x))

    def spread(self, problem: Problem, slopes: Array) -> Array:
        """Whitened responses by the slopes of its components, (N, k) not whitened."""
        return by_group(problem, self.mix(slopes))


@checked_methods
class UnknownForce(Unknown):
    """A smooth force, the same in all repeats of a command, different between commands.

    Args:
        effect: Effect whose components are the force's coefficients, such as knots in time times
            shapes.
        covariance: (num_components, num_components) of the coefficients, such as
            ``smooth_covariance`` of the knots; scale free.
        name: Name in the report.
        make: The same force with a number of knots; None: those of ``effect`` are all there are.
        most_knots: Largest number of them.
    """

    @checked
    def __init__(
        self,
        effect: Effect,
        covariance: Array,
        name: str = "unknown force",
        make: Callable[[int], UnknownForce] | None = None,
        most_knots: int = 0,
    ):
        m = len(effect.components)
        if covariance.shape != (m, m):
            raise ValueError(f"covariance must have shape ({m}, {m}), got {covariance.shape}")
        self.effect, self.name = effect, name
        self._root = _root(covariance)
        self._make, self._most_knots = make, most_knots
        # by a secant, one simulation each, where slopes need simulations: only the shape matters
        self._secant = replace(effect, smooth=False)

    def suited(self, num_cosines: int) -> Unknown:
        """With three knots for each cosine, of which a correlation over two leaves a tenth of the
        power of the fastest."""
        if self._make is None:
            return self
        made = self._make(min(3 * num_cosines + 1, self._most_knots))
        return self if made.label == self.label else made

    @property
    def label(self) -> str:
        """Its name and the number of its components."""
        return f"{self.name} of {len(self.effect.components)}"

    def mix(self, slopes: Array) -> Array:
        """Components drawn from their covariance."""
        return slopes @ self._root

    def slopes(self, problem: Problem, x: Array) -> Array:
        """Per standardized component of the effect; simulated for one run of each command, as
        repeats differ by their nuisances only."""
        first: dict[object, Run] = {}
        # repeats that are sampled alike
        twins = [first.setdefault((r.group, r.time_s.tobytes()), r) for r in problem.runs]
        effect = self.effect if has_tangents(problem.model) else self._secant
        wide = replace(problem, runs=tuple(first.values()), effects=(*problem.effects, effect))
        own = wide.columns_of(effect)
        at = np.concatenate([x, np.zeros(len(own))])
        columns = linearization_at(wide, at, own, screen=True).columns
        edges = np.cumsum([run.measured.size for run in wide.runs])[:-1]
        of_run = dict(zip((run.name for run in wide.runs), np.split(columns, edges), strict=True))
        return np.concatenate([of_run[run.name] for run in twins])


class UnknownDrift(Unknown):
    """A smooth drift of one channel, the same in all repeats of a command: no force.

    Args:
        channel: Index of the channel.
        name: Name in the report.
        knots_per_s: Density; the correlation length is two knots.
        num_knots: Largest number of knots in time, over the longest run.
    """

    @checked
    def __init__(self, channel: int, name: str, knots_per_s: float = 5.0, num_knots: int = 30):
        self.channel, self.name = channel, name
        self.knots_per_s, self.num_knots = knots_per_s, num_knots

    @checked(kinds_only=True)
    def slopes(self, problem: Problem, x: Array) -> Array:
        """Smooth functions of time; nothing is simulated."""
        longest = max(float(r.time_s[-1] - r.time_s[0]) for r in problem.runs)
        count = min(max(round(longest * self.knots_per_s) + 1, 4), self.num_knots)
        if longest > 0.0:
            knots = np.linspace(0.0, longest, count)
            root = _root(smooth_covariance(knots, 2.0 * longest / (count - 1)))
        else:  # poses, a sample each: a change of the channel in each
            knots, root = np.zeros(1), np.ones((1, 1))
        blocks = []
        for run in problem.runs:
            curves = [np.interp(run.time_s - run.time_s[0], knots, e) for e in root.T]
            record = np.zeros((*run.measured.shape, len(curves)))
            record[:, self.channel] = np.stack(curves, 1)
            blocks.append(record.reshape(-1, len(curves)))
        return np.concatenate(blocks)


class UnknownLaw(Unknown):
    """A smooth function of what a run holds, added to one channel: the same in all runs.

    Args:
        channel: Index of the channel.
        name: Name in the report.
        feature: Gives what it is a function of in a run, (num_samples,).
        num_knots: Number of knots over its range; the correlation length is two of them.
    """

    def __init__(
        self, channel: int, name: str, feature: Callable[[Run], Array], num_knots: int = 8
    ):
        self.channel, self.name = channel, name
        self.feature, self.num_knots = feature, num_knots

    def slopes(self, problem: Problem, x: Array) -> Array:
        """Smooth functions of the feature; nothing is fitted."""
        places = [np.nan_to_num(self.feature(run)) for run in problem.runs]
        low, high = min(p.min() for p in places), max(p.max() for p in places)
        knots = np.linspace(low, high if high > low else low + 1.0, self.num_knots)
        root = _root(smooth_covariance(knots, 2.0 * (knots[1] - knots[0])))
        blocks = []
        for run, place in zip(problem.runs, places, strict=True):
            record = np.zeros((*run.measured.shape, root.shape[1]))
            record[:, self.channel] = np.stack([np.interp(place, knots, e) for e in root.T], 1)
            blocks.append(record.reshape(-1, root.shape[1]))
        return np.concatenate(blocks)

    def spread(self, problem: Problem, slopes: Array) -> Array:
        """One block of columns for all runs."""
        return problem.whiten_all(self.mix(slopes))


@checked
def smooth_covariance(knots: Array, length: float) -> Array:
    """(m, m) squared-exponential covariance of values at ``knots``."""
    return np.exp(-0.5 * ((knots[:, None] - knots[None, :]) / length) ** 2)


def _root(covariance: Array) -> Array:
    """R with R R' = covariance, directions without variance left out."""
    values, vectors = linalg.eigh(covariance)
    keep = values > 1e-8 * values[-1]
    return vectors[:, keep] * np.sqrt(values[keep])


def by_group(problem: Problem, slopes: Array) -> Array:
    """Whitened, columns of each command side by side: independent between commands.

    Args:
        problem: Fitting problem whose runs the rows belong to.
        slopes: Change of all samples per component, (N, m) [unit of the channel].
    """
    groups = list(dict.fromkeys(run.group for run in problem.runs))
    m = slopes.shape[1]
    spread = np.zeros((sum(problem.num_valid), m * len(groups)))
    start = row = 0
    for run, count in zip(problem.runs, problem.num_valid, strict=True):
        own = problem.whiten(run, slopes[start : start + run.measured.size])
        at = groups.index(run.group) * m
        spread[row : row + count, at : at + m] = own
        start, row = start + run.measured.size, row + count
    return spread


def drifts(channels: Sequence[str]) -> list[Unknown]:
    """One ``UnknownDrift`` per channel."""
    return [UnknownDrift(i, f"unknown drift of {name}") for i, name in enumerate(channels)]
