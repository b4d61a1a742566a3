"""Which run to record next: the one on which rivals differ most, whatever is refitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from diffsim.data.study import Run
from diffsim.diagnose.evidence import ALONE_NATS
from diffsim.identify import Fit
from diffsim.identify.problem import PredictionError

Array = NDArray[np.float64]
TELLING = 2.0 * ALONE_NATS  # expected chi2 from which on a set would be named alone


@dataclass(frozen=True)
class NextRun:
    """Advice which run to record next.

    Attributes:
        best: Name of the run of the bank that separates the rivals best.
        chi2_gain: Expected chi2 between the nearest pair of rivals, by name of the run in the bank.
        over_median: The best one's over the bank's median.
    """

    best: str
    chi2_gain: dict[str, float]
    over_median: float

    @property
    def words(self) -> str:
        """What to record, or that no run of the bank tells the rivals apart."""
        most = self.chi2_gain[self.best]
        if most < TELLING:
            return (
                f"none of these runs tells them apart: expected chi2 {most:.2g} at most, "
                f"{TELLING:g} is needed; measure by other means what they differ in"
            )
        times = f"{self.over_median:.3g} times the bank's median"
        return f"record {self.best}: expected chi2 {most:.4g}, {times}"


def next_run(rivals: Sequence[Fit], bank: Sequence[Run]) -> NextRun:
    """Projected distance of rivals on every run of a bank.

    d^2 = D' (1 + J C J')^-1 D, D = W (S_a - S_b), J and posterior covariance C of the parameters of
    both rivals: what refitting either could absorb does not count.

    Args:
        rivals: Fits of the rival sets, two or more.
        bank: Runs that could be recorded; ``measured`` only gives the shape (any finite values).
    """
    if len(rivals) < 2:
        raise ValueError(f"rivals must hold at least two fits, got {len(rivals)}")
    if not bank:
        raise ValueError("bank is empty; give at least one run that could be recorded")
    gains = {}
    for run in bank:
        try:
            gains[run.name] = _nearest_pair(rivals, run)
        except PredictionError:  # a run that the model cannot follow is no advice
            continue
    if not gains:
        raise ValueError(f"none of the {len(bank)} runs of the bank can be simulated")
    best = max(gains, key=lambda name: gains[name])
    median = float(np.median(list(gains.values())))
    return NextRun(best, gains, gains[best] / median if median > 0.0 else float("inf"))


def _nearest_pair(rivals: Sequence[Fit], run: Run) -> float:
    linear = []
    for fit in rivals:
        residual, jacobian = replace(fit.problem, runs=(run,)).linearize(fit.x)
        linear.append(
            (residual, jacobian @ linalg.cholesky(_symmetric(fit.covariance), lower=True))
        )
    distances = []
    for a in range(len(linear)):
        for b in range(a + 1, len(linear)):
            apart = linear[a][0] - linear[b][0]
            blur = np.hstack([linear[a][1], linear[b][1]])
            inner = np.eye(blur.shape[1]) + blur.T @ blur
            seen = blur.T @ apart
            distances.append(float(apart @ apart - seen @ np.linalg.solve(inner, seen)))
    return min(distances)


def _symmetric(matrix: Array) -> Array:
    return 0.5 * (matrix + matrix.T)
