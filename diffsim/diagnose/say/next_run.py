"""Which run to record next: the one on which rivals differ most, whatever is refitted.

Where nothing is open: the one that narrows most what is known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from diffsim.core.checked import checked
from diffsim.core.errors import DiffsimError
from diffsim.core.figures import figure
from diffsim.data.study import Run
from diffsim.diagnose.judge.own_values import words_of
from diffsim.diagnose.say.wording import MOST_LISTED
from diffsim.diagnose.search.evidence import ALONE_NATS
from diffsim.identify import Fit
from diffsim.identify.fitting import posterior_covariance
from diffsim.identify.gaussian import Gaussian
from diffsim.identify.problem import PredictionError

TELLING = 2.0 * ALONE_NATS  # squared noise sd from which on a set would be named alone
NARROWER = 0.95  # of an interval's width: what narrows less is not worth a run


@checked(kinds_only=True)
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
    def apart(self) -> dict[str, float]:
        """How far the nearest pair of rivals differs [noise sd], by name of the run."""
        return {name: float(np.sqrt(max(gain, 0.0))) for name, gain in self.chi2_gain.items()}

    @property
    def words(self) -> str:
        """What to record, or that no run of the bank tells the rivals apart."""
        most, enough = self.apart[self.best], figure(TELLING**0.5, 2)
        if most**2 < TELLING:
            return (
                f"none of these runs tells them apart: {figure(most, 2)} noise sd at most, "
                f"{enough} are needed; measure by other means what they differ in"
            )
        usual = figure(float(np.sqrt(most**2 / self.over_median)), 2)
        return (
            f"record {self.best}: it parts the nearest two by {figure(most, 2)} noise sd, where "
            f"{enough} tell them apart; a usual run by {usual}"
        )


@dataclass(frozen=True)
class Narrowing:
    """What a further run would narrow where no cause is open."""

    best: str  # name of the run of the bank that narrows the named parameters most
    # width of each one's interval after that run over its width now, by name of the parameter, by
    # name of the run: what noise alone leaves
    shares: dict[str, dict[str, float]]

    @property
    def words(self) -> str:
        """What to record to know more exactly, or that it is not worth it."""
        shares = self.shares[self.best]
        least = [n for n in sorted(shares, key=lambda n: shares[n]) if shares[n] < NARROWER]
        if not least:
            return "none of these runs narrows an interval by more than 5 %"
        said = ", of ".join(f"{words_of(n)} to {figure(shares[n], 2)}" for n in least[:MOST_LISTED])
        return f"for more, record {self.best}: it narrows the interval of {said} of its width"

    def width(self, run: str) -> float:
        """Geometric mean of the widths that are left after a run."""
        return _mean_width(self.shares[run])


def narrowing(fit: Fit, bank: Sequence[Run], names: Sequence[str]) -> Narrowing:
    """Posterior sd of parameters with each run of a bank, over that without it.

    Args:
        bank: Runs that could be recorded; ``measured`` only gives the shape (any finite values).
        names: Parameters and sizes of the fit, one or more.

    Raises:
        ValueError: no such parameters.
        PredictionError: no run of the bank can be simulated.
    """
    if not names:
        raise ValueError("names is empty; give at least one parameter of the fit")
    index = [fit.problem.names.index(name) for name in names]
    now = np.sqrt(np.diagonal(fit.covariance))[index]
    shares = {}
    for run in bank:
        try:
            _, jacobian = replace(fit.problem, runs=(run,)).linearize(fit.x)
        except DiffsimError:  # a run that the model cannot follow is no advice
            continue
        then = posterior_covariance(np.vstack([fit.jacobian, jacobian]))
        left = np.sqrt(np.diagonal(then))[index] / now
        shares[run.name] = dict(zip(names, left.tolist(), strict=True))
    if not shares:
        raise PredictionError(f"none of the {len(bank)} runs of the bank can be simulated")
    return Narrowing(min(shares, key=lambda name: _mean_width(shares[name])), shares)


def _mean_width(shares: Mapping[str, float]) -> float:
    return float(np.exp(np.mean(np.log(list(shares.values())))))


@checked
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
            gain = _nearest_pair(rivals, run)
        except DiffsimError:  # a run that the model cannot follow is no advice
            continue
        if np.isfinite(gain):  # nor is one on which a rival runs away
            gains[run.name] = gain
    if not gains:
        raise PredictionError(f"none of the {len(bank)} runs of the bank can be simulated")
    best = max(gains, key=lambda name: gains[name])
    median = float(np.median(list(gains.values())))
    return NextRun(best, gains, gains[best] / median if median > 0.0 else float("inf"))


def _nearest_pair(rivals: Sequence[Fit], run: Run) -> float:
    """Squared distance of the two rivals that a run parts least [noise sd]; NaN where one of them
    runs away."""
    linear = []
    for fit in rivals:
        residual, jacobian = replace(fit.problem, runs=(run,)).linearize(fit.x)
        if not np.isfinite(jacobian).all():
            return float("nan")
        linear.append(
            (
                residual,
                jacobian @ linalg.cholesky(0.5 * (fit.covariance + fit.covariance.T), lower=True),
            )
        )
    distances = []
    for a in range(len(linear)):
        for b in range(a + 1, len(linear)):
            apart = linear[a][0] - linear[b][0]
            blur = np.hstack([linear[a][1], linear[b][1]])
            if not (np.isfinite(apart).all() and np.isfinite(blur).all()):
                return np.nan  # a rival runs away on it
            distances.append(float(apart @ (apart - blur @ Gaussian.of(blur, apart).mean)))
    return min(distances)
