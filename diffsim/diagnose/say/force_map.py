"""Score of a generic force over its noise: where and when a force is missing.

With residual r = W (y - S) of the plain model and slopes G_c of component c (a knot in time, a
shape, in one command), the score is the gradient

    s_c = d(-1/2 |r|^2) / d f_c = sum over repeats of G_c' r

Repeats a and b with signs + and - in place of + and + give a map of the same noise that no
repeatable force touches: its root mean square over |G_c| is the noise scale.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.identify import Problem
from diffsim.identify.unknown import UnknownForce


@checked(kinds_only=True)
@dataclass(frozen=True, eq=False)
class ForceMap:
    """Scores of a generic force by command, place and time.

    Attributes:
        name: Name of the generic force.
        groups: Names of the commands, one row each.
        components: Components of the force, one column each.
        values: Scores, (num_groups, num_components) [nats per standardized component].
        noise: Standard deviation of the scores under noise alone, of the same shape.
    """

    name: str
    groups: tuple[str, ...]
    components: tuple[str, ...]
    values: Array
    noise: Array

    @property
    def z(self) -> Array:
        """Scores in noise standard deviations; zero where the record does not move at all."""
        return np.divide(
            self.values, self.noise, out=np.zeros_like(self.values), where=self.noise > 0.0
        )


@checked
def force_map(problem: Problem, force: UnknownForce, slopes: Array, residual: Array) -> ForceMap:
    """Scores of a force at the plain model.

    Args:
        problem: Fitted problem that left the residual.
        force: Generic force whose components are mapped.
        slopes: Response to each component at the fit, (N, num_components) [unit of the channel].
        residual: Whitened residual of the fit, (num_valid,).
    """
    scores, lengths = _by_run(problem, slopes, residual)
    members: dict[str, list[int]] = defaultdict(list)
    for i, run in enumerate(problem.runs):
        members[run.group].append(i)
    values, noise = [], []
    for group in members.values():
        values.append(scores[group].sum(axis=0))
        length = np.sqrt(lengths[group].sum(axis=0))
        noise.append(length * _scatter(scores[group], lengths[group]))
    return ForceMap(
        force.name,
        tuple(members),
        tuple(force.effect.components),
        np.array(values),
        np.array(noise),
    )


def _by_run(problem: Problem, slopes: Array, residual: Array) -> tuple[Array, Array]:
    """(num_runs, num_components) G'r and |G|^2 of every run."""
    scores, lengths, row, valid = [], [], 0, 0
    for run in problem.runs:
        g = problem.whiten(run, slopes[row : row + run.measured.size])
        scores.append(g.T @ residual[valid : valid + len(g)])
        lengths.append(np.sum(g**2, axis=0))
        row += run.measured.size
        valid += len(g)
    return np.array(scores), np.array(lengths)


def _scatter(scores: Array, lengths: Array) -> float:
    """Root mean square of the first two repeats' difference over what unit noise makes of it; 1
    without repeats."""
    if len(scores) < 2:
        return 1.0
    length = np.sqrt(lengths[:2].sum(axis=0))
    seen = length > 0.0
    if not seen.any():
        return 1.0
    return float(np.sqrt(np.mean(((scores[0] - scores[1])[seen] / length[seen]) ** 2)))
