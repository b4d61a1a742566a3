"""Evidence of one set of causes in one group, averaged over what is not known of the scatter.

Sizes have the heavy-tailed prior of ``diffsim.identify.sizes``; near the most probable size a
normal one stands for it, and one-sided sizes are integrated over their side only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import log_ndtr, logsumexp, ndtr, owens_t

from diffsim.diagnose.faults.learn import Learned
from diffsim.diagnose.faults.local import Local
from diffsim.diagnose.faults.marginal import Information, without
from diffsim.identify.effect import Effect
from diffsim.identify.sizes import TAIL, coordinate_of, precision_at

Array = NDArray[np.float64]
NUM_MODE_STEPS = 8
NUM_SAMPLES = 40  # of the sizes, for each draw of the scatter
LEAST_SHARE = 1e-12  # of a normal distribution on the allowed side, that is computed
TINY = 1e-12  # the formula for a quadrant divides by means, to which it is not sensitive


@dataclass(frozen=True, eq=False)
class Evidence:
    """How well a set of causes explains a group.

    Attributes:
        log_evidence: Logarithm of the density of the samples, averaged over the scatter.
        scaled: Most probable scaled sizes, (num_causes,).
        strength: Length of the set's misfit in sd of noise and scatter, if it were left out.
        samples: Posterior samples of the scaled sizes, (num, num_causes).
        weights: Their weights, (num,), summing to one.
    """

    log_evidence: float
    scaled: Array
    strength: float
    samples: Array
    weights: Array


def informations(
    learned: Learned, local: Local, *, daily_factor: float = 1.0, new_state: bool = False
) -> list[Information]:
    """What a group says of the sizes of its causes, for each draw of the scatter.

    Args:
        learned: What other groups say of shared parameters and scatter.
        local: The group, linearized.
        daily_factor: Factor on spreads of groups, and of a new state.
        new_state: Whether the group is in a state that was never seen.
    """
    gone = slice(0, local.num_nuisances)
    out = []
    for k, draw in enumerate(learned.draws):
        mean, covariance = learned.of_shared(local, k, new_state=new_state, factor=daily_factor)
        shared = np.asarray(np.linalg.inv(covariance))
        scatter = learned.precision(local, draw, daily_factor=daily_factor)
        prior = block_diag(shared, np.diag(scatter)) if len(mean) else np.diag(scatter)
        slope = np.concatenate([shared @ mean, np.zeros(len(scatter))])
        out.append(without(local.curvature, local.slope, -0.5 * local.square, gone, prior, slope))
    return out


def evidence(
    found: Sequence[Information], effects: Sequence[Effect], rng: np.random.Generator
) -> Evidence:
    """Evidence of all causes of a linearized group, and their sizes.

    Args:
        found: What the group says of the sizes of one set, for each draw of the scatter.
        effects: Causes of the set, in the same order.
        rng: Of the samples of sizes.
    """
    if not effects:
        level = float(logsumexp([f.level for f in found]) - np.log(len(found)))
        return Evidence(level, np.zeros(0), 0.0, np.zeros((1, 0)), np.ones(1))
    signed = np.array([e.signed for e in effects])
    mode, width = _mode(found, signed)
    prior = np.diag(width)
    constant = _prior_at(mode, width, signed)
    levels, means, covariances = [], [], []
    for f in found:
        covariance: Array = np.asarray(np.linalg.inv(f.curvature + prior))
        mean = covariance @ f.slope
        half = 0.5 * np.linalg.slogdet(covariance)[1] + 0.5 * f.slope @ mean
        share = _log_share(mean, covariance, signed)
        levels.append(f.level + constant + half + 0.5 * len(mean) * np.log(2.0 * np.pi) + share)
        means.append(mean)
        covariances.append(covariance)
    weight = np.exp(np.array(levels) - logsumexp(levels))
    samples, weights = _samples(means, covariances, weight, signed, rng)
    curvature = np.mean([f.curvature for f in found], axis=0)
    return Evidence(
        float(logsumexp(levels) - np.log(len(levels))),
        mode,
        float(np.sqrt(max(mode @ curvature @ mode, 0.0))),
        samples,
        weights,
    )


def mixed(parts: Sequence[Evidence], log_weights: Sequence[float]) -> Evidence:
    """One evidence from those in several states.

    Args:
        parts: Evidence of one set of causes in each state.
        log_weights: Logarithms of the probabilities of the states beforehand.
    """
    levels = np.array([p.log_evidence for p in parts]) + np.array(log_weights)
    share = np.exp(levels - logsumexp(levels))
    return Evidence(
        float(logsumexp(levels)),
        np.asarray(sum(w * p.scaled for w, p in zip(share, parts, strict=True))),
        float(sum(w * p.strength for w, p in zip(share, parts, strict=True))),
        np.concatenate([p.samples for p in parts]),
        np.concatenate([w * p.weights for w, p in zip(share, parts, strict=True)]),
    )


def _mode(found: Sequence[Information], signed: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Most probable scaled sizes, and the precision of the normal prior that stands there."""
    curvature = np.mean([f.curvature for f in found], axis=0)
    slope = np.mean([f.slope for f in found], axis=0)
    width = np.ones(len(signed))
    mode = np.zeros(len(signed))
    for _ in range(NUM_MODE_STEPS):
        mode = np.linalg.solve(curvature + np.diag(width), slope)
        mode = np.where(signed, mode, np.maximum(mode, 0.0))
        width = precision_at(mode)
    return mode, width


def _prior_at(mode: Array, width: Array, signed: NDArray[np.bool_]) -> float:
    """Log density of the prior of scaled sizes at the mode, its normal stand-in taken off."""
    x = coordinate_of(mode)
    density = -0.5 * x**2 - 0.5 * np.log(2.0 * np.pi) - np.log(np.cosh(TAIL * x))
    return float(np.sum(density + np.where(signed, 0.0, np.log(2.0)) + 0.5 * width * mode**2))


def _log_share(mean: Array, covariance: Array, signed: NDArray[np.bool_]) -> float:
    """Logarithm of the share of a normal distribution on the allowed side."""
    one = np.flatnonzero(~signed)
    if not len(one):
        return 0.0
    if len(one) == 1:
        i = one[0]
        return float(log_ndtr(mean[i] / np.sqrt(covariance[i, i])))
    if len(one) == 2:
        inner = covariance[np.ix_(one, one)]
        sd = np.sqrt(np.diag(inner))
        return float(
            np.log(max(positive_quadrant(mean[one] / sd, inner[0, 1] / sd.prod()), LEAST_SHARE))
        )
    from scipy.stats import multivariate_normal  # half a second that other commands do not need

    normal = multivariate_normal(cov=covariance[np.ix_(one, one)], allow_singular=True, seed=0)
    return float(np.log(max(float(normal.cdf(mean[one])), LEAST_SHARE)))


def positive_quadrant(mean: Array, correlation: float) -> float:
    """Probability that two normal numbers of standard deviation one are both positive.

    Args:
        mean: Their means, (2,).
        correlation: Their correlation, between -1 and 1.

    Source: Owen, Tables for computing bivariate normal probabilities, Ann. Math. Statist. 27
    (1956) 1075, eq. 2.1.
    """
    h, k = (float(np.copysign(max(abs(m), TINY), m)) for m in mean)
    across = np.sqrt(max((1.0 - correlation) * (1.0 + correlation), TINY**2))
    tails = owens_t(h, (k - correlation * h) / (h * across))
    tails += owens_t(k, (h - correlation * k) / (k * across))
    half = 0.0 if h * k > 0.0 else 0.5
    return float(0.5 * (ndtr(h) + ndtr(k)) - tails - half)


def _samples(
    means: Sequence[Array],
    covariances: Sequence[Array],
    weight: Array,
    signed: NDArray[np.bool_],
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Samples of the sizes on the allowed side, and their weights."""
    rows, weights = [], []
    for mean, covariance, w in zip(means, covariances, weight, strict=True):
        factor = np.linalg.cholesky(covariance)
        drawn = mean + rng.standard_normal((NUM_SAMPLES, len(mean))) @ factor.T
        inside = drawn[(signed | (drawn > 0.0)).all(axis=1)]
        inside = inside if len(inside) else np.where(signed, mean, np.maximum(mean, 0.0))[None]
        rows.append(inside)
        weights.append(np.full(len(inside), w / len(inside)))
    return np.concatenate(rows), np.concatenate(weights)
