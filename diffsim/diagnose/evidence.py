"""Laplace evidence of hypotheses, in nats, from one linearization of everything.

With W S ~ W S(x0) + A (x - x0), coordinates of prior N(0, 1), and an unknown cause H z with
z ~ N(0, a^2), columns B = [A_base, A_effects, a H] and r = W (y - S(x0)) + A x0:

    E = -1/2 r' (1 + B B')^-1 r - 1/2 ln|1 + B'B| + sum_half-normal ln(2 Phi(t / s))
        - (number of effects + unknown) ln(number of families) - unknown ln(number of unknowns)

t and s are mean and standard deviation of an unsigned size where its sign is left free: exact for
one such size in a linear problem, and ln 2 each (the half-normal's height) where t >> s. Bounds of
base parameters cost likewise the share of the normal beyond them. Where several bounds are active
they cost together what the optimum within them has lost, so no model is credited with a fit beyond
its bounds. The amplitude a is averaged over ``AMPLITUDES``. Constants are left out: -N/2 ln(2 pi) +
ln|W|, and the share of the base parameters' prior within the bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize, special

from diffsim.identify import Fit, Problem
from diffsim.identify.effect import Effect
from diffsim.identify.unknown import Unknown

Array = NDArray[np.float64]
# root mean square of the unknown's part of the record, in noise standard deviations
AMPLITUDES = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
KEEP_NATS = 4.0  # evidence that a member of a set, or an unknown cause, must add
ALONE_NATS = 3.0  # lead over every rival that a set needs to be named alone


@dataclass(frozen=True)
class Hypothesis:
    """A set of effects and at most one unknown cause, by index."""

    effects: frozenset[int] = frozenset()
    unknown: int | None = None


@dataclass(frozen=True, eq=False)
class Weighed:
    """Evidence of a hypothesis and where its posterior lies.

    Attributes:
        nats: Logarithm of the Laplace evidence [nats].
        x: Standardized coordinates of the optimum within the bounds, (n,); zero for effects not in
            the set.
        sd: Posterior standard deviation of the coordinates, (n,); zero for effects not in the set.
        chi2: |r - B x|^2, after the unknown cause's part.
        amplitude: Most probable amplitude of the unknown cause [noise sd]; 0 without.
        fit: Fit of a set that was refitted; None where linear evidence stands, as it does for sets
            with an unknown cause.
    """

    nats: float
    x: Array
    sd: Array
    chi2: float
    amplitude: float
    fit: Fit | None = None


class LaplaceEvidence:
    """Evidence of any hypothesis from the Gram matrix of all columns at a point; no simulation.

    Args:
        problem: Fitted problem with the effects that may be members.
        x: Standardized coordinates where it was linearized, (n,).
        residual: Whitened residual at x, (num_valid,).
        jacobian: Whitened slopes d(W S)/dx at x, (num_valid, n).
        responses: Whitened responses of each unknown cause, (num_valid, m).
        num_families: Families of effects and unknown causes, for the price of a choice.
        num_unknowns: Unknown causes to choose from, where not all are in ``responses``.
    """

    def __init__(
        self,
        problem: Problem,
        x: Array,
        residual: Array,
        jacobian: Array,
        responses: Sequence[Array],
        num_families: int,
        num_unknowns: int | None = None,
    ):
        self.num_unknowns = len(responses) if num_unknowns is None else num_unknowns
        self.problem, self.x0, self.num_families = problem, x, num_families
        self.residual, self.jacobian = residual, jacobian
        right = residual + jacobian @ x
        blocks = [_unit_power(h) for h in responses]
        stacked = np.hstack([jacobian, *blocks])
        edges = np.cumsum([jacobian.shape[1], *(b.shape[1] for b in blocks)])
        self.unknown_columns = [list(range(a, b)) for a, b in pairwise(edges)]
        self.gram = stacked.T @ stacked
        self.projection = stacked.T @ right
        self.power = float(right @ right)
        self.columns = [problem.columns_of(e) for e in problem.effects]
        self.bounds = problem.bounds

    def weigh(self, hypothesis: Hypothesis) -> Weighed:
        """Evidence of a hypothesis and its optimum."""
        price = np.log(max(self.num_families, 1))
        members = sorted(hypothesis.effects)
        free = list(range(self.problem.num_base)) + [c for i in members for c in self.columns[i]]
        if hypothesis.unknown is None:
            nats, x, sd, chi2 = self._gaussian(free, members, [], 0.0)
            return Weighed(nats - len(members) * price, x, sd, chi2, 0.0)
        extra = self.unknown_columns[hypothesis.unknown]
        tried = [self._gaussian(free, members, extra, a) for a in AMPLITUDES]
        evidences = np.array([t[0] for t in tried])
        best = int(np.argmax(evidences))
        mean = special.logsumexp(evidences) - np.log(len(AMPLITUDES))
        _, x, sd, chi2 = tried[best]
        # the unknown causes share what one more family may claim
        price_unknown = price + np.log(self.num_unknowns)
        return Weighed(mean - len(members) * price - price_unknown, x, sd, chi2, AMPLITUDES[best])

    def _gaussian(
        self, free: list[int], members: list[int], extra: list[int], amplitude: float
    ) -> tuple[float, Array, Array, float]:
        idx = free + extra
        scale = np.concatenate([np.ones(len(free)), np.full(len(extra), amplitude)])
        b = scale * self.projection[idx]
        gram = self.gram[np.ix_(idx, idx)] * np.outer(scale, scale)
        factor = linalg.cho_factor(gram + np.eye(len(idx)), lower=True)
        mean = linalg.cho_solve(factor, b)
        log_det = 2.0 * np.log(np.diag(factor[0])).sum()
        nats = -0.5 * (self.power - b @ mean) - 0.5 * log_det
        inverse = linalg.cho_solve(factor, np.eye(len(idx)))
        sd = np.sqrt(np.diag(inverse))
        unbounded = np.full(len(extra), np.inf)
        low = np.concatenate([self.bounds[0][free], -unbounded])
        high = np.concatenate([self.bounds[1][free], unbounded])
        mean, lost = _within(mean, sd, np.tril(factor[0]).T, low, high)
        chi2 = self.power - 2.0 * (b @ mean) + mean @ gram @ mean
        unsigned = [
            c for i in members if not self.problem.effects[i].signed for c in self.columns[i]
        ]
        nats += len(unsigned) * np.log(2.0) - lost
        x, deviation = np.zeros(len(self.x0)), np.zeros(len(self.x0))
        x[free], deviation[free] = mean[: len(free)], sd[: len(free)]
        return float(nats), x, deviation, float(chi2)


def _within(mean: Array, sd: Array, root: Array, low: Array, high: Array) -> tuple[Array, float]:
    """The optimum within bounds and the nats that they cost.

    Args:
        mean, sd: (n,) of the posterior without bounds.
        root: (n, n) upper, root' root = 1 + B'B.
        low, high: Bounds of the coordinates, (n,).
    """
    shares = _log_share(mean, sd, low, high)
    inside = np.clip(mean, low, high)
    if (inside == mean).all():
        return mean, -float(shares.sum())
    x = optimize.lsq_linear(root, root @ mean, (low, high), method="bvls").x
    # together the bounds cost what the optimum lost, not each one's share of it once more
    lost = 0.5 * float(np.sum((root @ (x - mean)) ** 2))
    return x, lost - float((shares + 0.5 * ((mean - inside) / sd) ** 2).sum())


def unrealized(fit: Fit, weighed: Weighed) -> float:
    """Nats that a Gauss-Newton step from a fit promises but the fit did not reach.

    The evidence from a linearization holds at its optimum; a fit that stopped elsewhere (a kink, a
    fold, too few steps) must not be credited with an optimum that was not simulated.

    Args:
        fit: Fit that was linearized.
        weighed: Evidence from that linearization.
    """
    return 0.5 * (fit.chi2 + fit.prior - weighed.chi2 - float(weighed.x @ weighed.x))


def families(effects: Sequence[Effect], unknowns: Sequence[Unknown]) -> int:
    """Number of families that the candidates belong to."""
    return len({e.family for e in effects}) + (1 if unknowns else 0)


def _log_share(mean: Array, sd: Array, low: Array, high: Array) -> Array:
    """ln of a normal's share between bounds."""
    above, below = (low - mean) / sd, (high - mean) / sd
    swap = above > 0.0  # the tail that has digits
    upper, lower = np.where(swap, -above, below), np.where(swap, -below, above)
    wide = special.log_ndtr(upper)
    with np.errstate(divide="ignore"):
        return np.asarray(wide + np.log1p(-np.exp(special.log_ndtr(lower) - wide)))


def _unit_power(responses: Array) -> Array:
    """Scaled so that N(0, 1) coefficients move a sample by one noise sd, root mean square."""
    power = np.sqrt(np.sum(responses**2) / len(responses))
    return responses / power if power > 0.0 else responses
