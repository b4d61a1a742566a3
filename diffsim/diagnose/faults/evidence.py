"""Evidence of one set of causes in one group, averaged over what is not known of the scatter.

Sizes have the heavy-tailed prior of ``diffsim.identify.effect``; near the most probable size a
normal one stands for it, and one-sided sizes are integrated over their side only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr, logsumexp, ndtr, owens_t

from diffsim.core.arrays import Array, Mask
from diffsim.diagnose.faults.local import Local
from diffsim.diagnose.faults.marginal import Priors, without
from diffsim.identify.effect import TAIL, Effect, coordinate_of, precision_at
from diffsim.identify.gaussian import Gaussian

NUM_SAMPLES = 40  # of the sizes, for each draw of the scatter
TINY = 1e-12  # share of a normal distribution that is computed, and mean that one is divided by


@dataclass(frozen=True, eq=False)
class Evidence:
    """How well a set of causes explains a group."""

    log_evidence: float  # logarithm of the density of the samples, averaged over the scatter
    scaled: Array  # most probable scaled sizes, (num_causes,)
    strength: float  # length of the set's misfit in sd of noise and scatter, if it were left out
    samples: Array  # posterior samples of the scaled sizes, (num, num_causes)
    weights: Array  # their weights, (num,), summing to one


def informations(local: Local, priors: Priors) -> list[Gaussian]:
    """What a group says of the sizes of its causes, for each draw of the scatter.

    Args:
        priors: What is known of its nuisances, ``Learned.priors`` of the group.
    """
    gone = slice(0, local.num_nuisances)
    level = local.level - 0.5 * local.square
    return without(local.curvature, local.slope, level, gone, priors)


def evidence(
    found: Sequence[Gaussian],
    effects: Sequence[Effect],
    rng: np.random.Generator,
    known: Mapping[str, float],
) -> Evidence:
    """Evidence of all causes of a linearized group, and their sizes.

    Args:
        found: What the group says of the sizes of one set, for each draw of the scatter.
        effects: Causes of the set, in the same order.
        known: Scaled sizes that are known, by name of the cause.
    """
    at = [k for k, e in enumerate(effects) if e.name in known]
    if not at:
        return _evidence(found, effects, rng)
    values = np.array([known[effects[k].name] for k in at])
    rest = [k for k in range(len(effects)) if k not in at]
    part = _evidence([f.given(at, values) for f in found], [effects[k] for k in rest], rng)
    scaled, samples = np.zeros(len(effects)), np.zeros((len(part.samples), len(effects)))
    scaled[at], scaled[rest] = values, part.scaled
    samples[:, at], samples[:, rest] = values, part.samples
    return replace(part, scaled=scaled, samples=samples, strength=_strength(found, scaled))


def _evidence(
    found: Sequence[Gaussian], effects: Sequence[Effect], rng: np.random.Generator
) -> Evidence:
    """Evidence of causes whose size is not known."""
    if not effects:
        level = float(logsumexp([f.level for f in found]) - np.log(len(found)))
        return Evidence(level, np.zeros(0), 0.0, np.zeros((1, 0)), np.ones(1))
    signed = np.array([e.signed for e in effects])
    mode, width = _mode(found, signed)
    prior = np.diag(width)
    constant = _prior_at(mode, width, signed)
    slopes = np.array([f.slope for f in found])
    covariances: Array = np.asarray(np.linalg.inv(np.array([f.curvature for f in found]) + prior))
    means = (covariances @ slopes[..., None])[..., 0]
    half = 0.5 * np.linalg.slogdet(covariances)[1] + 0.5 * np.sum(slopes * means, axis=-1)
    constant += 0.5 * len(effects) * np.log(2.0 * np.pi)
    levels = np.array([f.level for f in found]) + constant + half
    levels += _log_shares(means, covariances, signed)
    weight = np.exp(levels - logsumexp(levels))
    samples, weights = _samples(means, covariances, weight, signed, rng)
    level = float(logsumexp(levels) - np.log(len(levels)))
    return Evidence(level, mode, _strength(found, mode), samples, weights)


def _strength(found: Sequence[Gaussian], scaled: Array) -> float:
    """Length of the misfit of sizes, in sd of noise and scatter."""
    curvature = np.mean([f.curvature for f in found], axis=0)
    return float(np.sqrt(max(scaled @ curvature @ scaled, 0.0)))


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


def _mode(found: Sequence[Gaussian], signed: Mask) -> tuple[Array, Array]:
    """Most probable scaled sizes, and the precision of the normal prior that stands there."""
    curvature = np.mean([f.curvature for f in found], axis=0)
    slope = np.mean([f.slope for f in found], axis=0)
    width = np.ones(len(signed))
    mode = np.zeros(len(signed))
    for _ in range(8):
        mode = np.linalg.solve(curvature + np.diag(width), slope)
        mode = np.where(signed, mode, np.maximum(mode, 0.0))
        width = precision_at(mode)
    return mode, width


def _prior_at(mode: Array, width: Array, signed: Mask) -> float:
    """Log density of the prior of scaled sizes at the mode, its normal stand-in taken off."""
    x = coordinate_of(mode)
    density = -0.5 * x**2 - 0.5 * np.log(2.0 * np.pi) - np.log(np.cosh(TAIL * x))
    return float(np.sum(density + np.where(signed, 0.0, np.log(2.0)) + 0.5 * width * mode**2))


def _log_shares(means: Array, covariances: Array, signed: Mask) -> Array:
    """Logarithms of the shares of normal distributions on the allowed side, (num_draws,)."""
    one = np.flatnonzero(~signed)
    if not len(one):
        return np.zeros(len(means))
    inner = covariances[:, one[:, None], one]
    sd = np.sqrt(inner.diagonal(axis1=1, axis2=2))
    if len(one) == 1:
        return np.asarray(log_ndtr(means[:, one] / sd)[:, 0])
    if len(one) == 2:
        shares = [
            positive_quadrant(m, c)
            for m, c in zip(means[:, one] / sd, inner[:, 0, 1] / sd.prod(axis=1), strict=True)
        ]
    else:
        from scipy.stats import multivariate_normal  # half a second that others do not need

        normals = (multivariate_normal(cov=c, allow_singular=True, seed=0) for c in inner)
        shares = [float(n.cdf(m)) for n, m in zip(normals, means[:, one], strict=True)]
    return np.log(np.maximum(shares, TINY))


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
    means: Array,
    covariances: Array,
    weight: Array,
    signed: Mask,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Samples of the sizes on the allowed side, and their weights."""
    factors = np.linalg.cholesky(covariances)
    drawn = rng.standard_normal((len(means), NUM_SAMPLES, means.shape[1]))
    drawn = means[:, None] + drawn @ factors.swapaxes(1, 2)
    allowed: Mask = np.asarray(np.all(signed | (drawn > 0.0), axis=2))
    none = ~np.any(allowed, axis=1)  # there the mean, moved to the allowed side, is the only sample
    drawn[none, 0] = np.where(signed, means, np.maximum(means, 0.0))[none]
    allowed[none, 0] = True
    weights = np.broadcast_to((weight / allowed.sum(axis=1))[:, None], allowed.shape)
    return drawn[allowed], weights[allowed]
