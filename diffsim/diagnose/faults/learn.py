"""Common parameters and spreads, learned from groups whose faults are known.

The spreads maximize their posterior with all scatter integrated out (restricted maximum
likelihood, Patterson and Thompson, Biometrika 58 (1971) 545, with a prior on their logarithms).
Few groups leave them uncertain: later steps average over draws of them, so that a verdict has
the heavier tails of a Student distribution. A large spread is refuted far sooner than a normal
distribution about the best one says; so draws of that are kept by their posterior (sampling and
importance resampling, Rubin, Bayesian Statistics 3 (1988) 395).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from diffsim.core.arrays import Array, IntArray
from diffsim.diagnose.faults.goals import Fit, Rows, Tails, learned_tails, rows_at
from diffsim.diagnose.faults.groups import Group
from diffsim.diagnose.faults.layout import Layout
from diffsim.diagnose.faults.local import Local, problem_of
from diffsim.diagnose.faults.marginal import Priors, without
from diffsim.diagnose.faults.one_sided import Terms
from diffsim.identify.effect import PRIOR_WIDTH
from diffsim.identify.gaussian import Gaussian
from diffsim.identify.problem import Problem

FACTOR_SD = 1.0  # sd of the logarithm of a spread about the stated one: a factor of e
KNOWN_PRECISION = 1.0 / 3.0**2  # of known sizes: up to about five typical sizes
NUM_DRAWS = 32  # of the spreads
NUM_TRIED = 128  # normal draws that they are chosen from, in pairs about the best ones


@dataclass(frozen=True, eq=False)
class GroupPosterior:
    """What groups with known faults say of all others."""

    layout: Layout
    problem: Problem  # model, all runs, noise and effects
    tails: Tails  # how far goals are missed
    locals: Mapping[str, Local]  # groups that taught, linearized, by label
    states: Mapping[str, str]  # state of each that taught, by label; "" where states are not used
    log_spread: Array  # most probable logarithm of spread over stated spread, (num_families,)
    covariance: Array  # inverse of the curvature of its posterior there
    standard: Array  # standard normal numbers that draws are tried with, (NUM_TRIED, num_families)
    draws: Array  # draws of it, (NUM_DRAWS, num_families)
    # mean, common_covariance: of the common parameters for each draw, standardized, (NUM_DRAWS,
    # num_common) and (NUM_DRAWS, num_common, num_common)
    mean: Array
    common_covariance: Array
    point: Array  # scaled base coordinates at the most probable spreads, scatter 0, (num_base,)

    def precision(
        self, local: Local | Rows, log_spread: Array, *, daily_factor: float = 1.0
    ) -> Array:
        """Prior precision of a group's scatter, (num_scatter,).

        Args:
            log_spread: Logarithms of spreads over stated ones.
            daily_factor: Factor on the spreads of groups, 1 for groups like those that taught.
        """
        return _precision(self.layout, local, log_spread, daily_factor)

    def of_shared(
        self, local: Local | Rows, draw: int, *, new_state: bool = False, factor: float = 1.0
    ) -> tuple[Array, Array]:
        """What is known of the shared parameters of a group for one draw: mean and covariance.

        Args:
            new_state: Whether the group is in a state that was never seen.
            factor: Factor on the spreads of such a state.
        """
        place = {i: k for k, i in enumerate(self.layout.shared)}
        at = np.array([place[i] for i in local.common], dtype=int)
        mean = self.mean[draw][at].copy()
        covariance = self.common_covariance[draw][np.ix_(at, at)].copy()
        if new_state:
            fresh = self.layout.is_state[list(local.common)]
            prior = factor**2 / self.layout.shared_precision(self.draws[draw])[at]
            mean[fresh] = 0.0
            covariance[fresh] = covariance[:, fresh] = 0.0
            covariance[fresh, fresh] = prior[fresh]
        return mean, covariance

    def priors(
        self, local: Local | Rows, *, new_state: bool = False, daily_factor: float = 1.0
    ) -> Priors:
        """What is known of a group's nuisances, for each draw of the scatter.

        Args:
            local: The group, linearized anywhere.
            new_state: Whether the group is in a state that was never seen.
            daily_factor: Factor on spreads of groups, and of a new state.
        """
        size, num = len(local.common) + len(local.scatter), len(local.common)
        precision = np.zeros((len(self.draws), size, size))
        means = np.zeros((len(self.draws), size))
        for k, draw in enumerate(self.draws):
            mean, covariance = self.of_shared(local, k, new_state=new_state, factor=daily_factor)
            scatter = self.precision(local, draw, daily_factor=daily_factor)
            means[k, :num] = mean
            precision[k, :num, :num] = np.linalg.inv(covariance)
            precision[k, num:, num:] = np.diag(scatter)
        return Priors.of(precision, means)

    def known_sizes(self, sizes: Mapping[str, float]) -> dict[str, float]:
        """Scaled sizes of causes of which the study states them."""
        typical = {e.name: e.typical for e in self.problem.effects}
        return {name: size / (PRIOR_WIDTH * typical[name]) for name, size in sizes.items()}

    def without(self, label: str) -> GroupPosterior:
        """What the other groups say."""
        if label not in self.locals:
            return self
        left = {k: v for k, v in self.locals.items() if k != label}
        states = {k: v for k, v in self.states.items() if k != label}
        return _learn_posterior(replace(self, states=states), left, self.log_spread)


def learn(
    problem: Problem,
    layout: Layout,
    groups: Sequence[Group],
    *,
    seed: int,
    state: str | None = None,
) -> GroupPosterior:
    """Learn from the groups whose faults are known.

    Args:
        problem: Model, all runs, noise and effects.
        groups: All groups; those that do not teach are left out.
        seed: Of the draws of spreads.
        state: Fact of the runs that says which state of the rig they share; None: none.

    Raises:
        ValueError: fewer than three groups teach.
    """
    teachers = [g for g in groups if g.teaches]
    if len(teachers) < 3:
        raise ValueError(
            f"faults.known: {len(teachers)} groups with use: fit have a known fault or none; "
            "scatter between groups needs at least three"
        )
    num_base = len(layout.names)
    tails = Tails.first(problem)
    own = {g.label: problem_of(problem, g) for g in teachers}
    points = {g.label: np.zeros(len(problem.names)) for g in teachers}
    effects = {e.name: e for e in problem.effects}
    log_spread = np.zeros(len(layout.families))
    rng = np.random.default_rng(seed)
    half = rng.standard_normal((NUM_TRIED // 2, len(layout.families)))
    empty = np.zeros(0)
    states = {g.label: str(g.runs[0].setup.get(state or "", "")) for g in teachers}
    started = GroupPosterior(
        layout,
        problem,
        tails,
        {},
        states,
        log_spread,
        empty,
        np.vstack([half, -half]),
        empty,
        empty,
        empty,
        empty,
    )
    before = np.full(num_base, np.inf)
    for _ in range(5):
        rows = {
            g.label: rows_at(
                own[g.label], layout, points[g.label], [effects[c] for c in g.known or ()]
            )
            for g in teachers
        }
        locals_, tails = _find_trusted(layout, rows, tails, log_spread)
        log_spread = best_spread(layout, locals_, log_spread)
        common = common_information(layout, locals_, log_spread).mean
        place = np.zeros(num_base)
        place[layout.shared] = common
        for g in teachers:
            points[g.label] = _solve_point(
                own[g.label], layout, locals_[g.label], place, log_spread
            )
        if np.abs(place - before).max() < 1e-3:  # of prior sd: common parameters have settled
            break
        before = place
    return _learn_posterior(replace(started, tails=tails), locals_, log_spread)


def _find_trusted(
    layout: Layout, rows: Mapping[str, Rows], tails: Tails, log_spread: Array
) -> tuple[dict[str, Local], Tails]:
    """What the trusted rows of each group say, and how far goals are missed in them."""
    for _ in range(5):
        found: dict[str, Fit] = {}
        for label, own in rows.items():
            known = layout.shared_precision(log_spread)[np.isin(layout.shared, own.common)]
            prior = np.concatenate([known, _scatter_prior(layout, own, log_spread)])
            found[label] = own.robust(tails, np.diag(prior), np.zeros(len(prior)))
        if not any(own.shared.any() for own in rows.values()):
            break
        tails = learned_tails(((rows[k], fit) for k, fit in found.items()), tails)
    return {label: fit.local for label, fit in found.items()}, tails


def _learn_posterior(
    state: GroupPosterior, locals_: Mapping[str, Local], start: Array
) -> GroupPosterior:
    """Posterior of spreads and common parameters; ``state`` gives layout and draws."""
    layout = state.layout
    one = {e.name for e in state.problem.effects if not e.signed}
    terms = {label: Terms.none(local) for label, local in locals_.items()}
    start = best_spread(layout, locals_, start)
    terms = _terms(layout, locals_, start, terms, one, sweeps=4)
    held = _with_terms(locals_, terms)
    best = best_spread(layout, held, start)
    covariance: Array = np.asarray(np.linalg.inv(_curvature(layout, held, best)))
    draws = _draws(layout, held, best, covariance, state.standard)
    found = [_common_above_zero(layout, locals_, d, terms, one) for d in draws]
    point = np.zeros(len(layout.names))
    point[layout.shared] = common_information(layout, held, best).mean
    return replace(
        state,
        locals=dict(locals_),
        log_spread=best,
        covariance=covariance,
        draws=draws,
        mean=np.stack([f.mean for f in found]),
        common_covariance=np.stack([f.covariance for f in found]),
        point=point,
    )


def _with_terms(locals_: Mapping[str, Local], terms: Mapping[str, Terms]) -> dict[str, Local]:
    """Groups by label, each with its terms among what its samples say."""
    return {label: terms[label].on(local) for label, local in locals_.items()}


def _terms(
    layout: Layout,
    locals_: Mapping[str, Local],
    log_spread: Array,
    terms: Mapping[str, Terms],
    one: Collection[str],
    sweeps: int,
) -> dict[str, Terms]:
    """Terms by which the known sizes of all groups keep their sign.

    Args:
        locals_: Groups that teach, linearized.
        log_spread: Logarithms of spreads over stated ones, (num_families,).
        one: Causes whose size is never below 0.
        sweeps: How often all terms are renewed.
    """
    place = {i: k for k, i in enumerate(layout.shared)}
    out = dict(terms)
    for _ in range(sweeps):
        held = _with_terms(locals_, out)
        common = common_information(layout, held, log_spread)
        mean, covariance = common.mean, common.covariance
        for label, local in held.items():
            if any(cause in one for cause in local.causes):
                at = [place[i] for i in local.common]
                own = _own_moments(layout, local, log_spread, mean[at], covariance[np.ix_(at, at)])
                sizes = slice(len(local.scatter), None)
                out[label] = out[label].renewed(local, own.mean[sizes], own.variance[sizes], one)
    return out


def _common_above_zero(
    layout: Layout,
    locals_: Mapping[str, Local],
    log_spread: Array,
    terms: Mapping[str, Terms],
    one: Collection[str],
) -> Gaussian:
    """What groups say together of the shared parameters, known sizes with their sign."""
    own = _terms(layout, locals_, log_spread, terms, one, sweeps=2)
    return common_information(layout, _with_terms(locals_, own), log_spread)


def _draws(
    layout: Layout,
    locals_: Mapping[str, Local],
    best: Array,
    covariance: Array,
    standard: Array,
) -> Array:
    """Draws of the logarithms of spreads from their posterior, (NUM_DRAWS, num_families).

    Args:
        locals_: Groups that teach, linearized.
        best: Most probable logarithms, (num_families,).
        covariance: Of the normal distribution that is tried, (num_families, num_families).
        standard: Standard normal numbers, (num_tried, num_families).
    """
    tried = best + standard @ np.linalg.cholesky(covariance).T
    level = np.array([_log_density(layout, locals_, t)[0] for t in tried])
    level += 0.5 * np.sum(standard**2, axis=1)
    share = np.cumsum(np.exp(level - level.max()))
    places = (np.arange(NUM_DRAWS) + 0.5) / NUM_DRAWS * share[-1]
    return np.asarray(tried[np.searchsorted(share, places)])


def best_spread(layout: Layout, locals_: Mapping[str, Local], start: Array) -> Array:
    """Most probable logarithms of the spreads over the stated ones, (num_families,)."""

    def down(t: Array) -> tuple[float, Array]:
        value, slope = log_posterior(layout, locals_, t)
        return -value, -slope

    found = minimize(down, start, method="BFGS", jac=True, options={"gtol": 1e-3})
    return np.asarray(found.x)


def log_posterior(
    layout: Layout, locals_: Mapping[str, Local], log_spread: Array
) -> tuple[float, Array]:
    """Logarithm of the posterior of spreads, up to a constant, and its slopes (num_families,).

    A spread e^t acts through the prior of what scatters only, so the slope along t is the mean of
    the prior's own slope, z^2 e^-2t - 1, over the posterior of z (Fisher's identity).
    """
    value, found = _log_density(layout, locals_, log_spread)
    square = _mean_squares(layout, locals_, log_spread, found)
    count = np.bincount(square.family, minlength=len(log_spread))
    total = np.bincount(square.family, square.value, minlength=len(log_spread))
    slope = total * np.exp(-2.0 * log_spread) - count - log_spread / FACTOR_SD**2
    return value, slope


def _log_density(
    layout: Layout, locals_: Mapping[str, Local], log_spread: Array
) -> tuple[float, Gaussian]:
    """Logarithm of the posterior of spreads, up to a constant, and the shared parameters there."""
    found = common_information(layout, locals_, log_spread)
    return found.nats - 0.5 * float(np.sum((log_spread / FACTOR_SD) ** 2)), found


class _Squares(NamedTuple):
    """Posterior mean of the square of each parameter with a spread, and its family."""

    value: Array
    family: IntArray


def _mean_squares(
    layout: Layout, locals_: Mapping[str, Local], log_spread: Array, of_common: Gaussian
) -> _Squares:
    common, mean, covariance = layout.shared, of_common.mean, of_common.covariance
    place = {i: k for k, i in enumerate(common)}
    family = layout.family[common]
    states = family >= 0
    values = [(mean**2 + np.diag(covariance))[states]]
    families = [family[states]]
    for local in locals_.values():
        scatter = np.array(local.scatter, dtype=int)
        at = [place[i] for i in local.common]
        own = _own_moments(layout, local, log_spread, mean[at], covariance[np.ix_(at, at)])
        values.append((own.mean**2 + own.variance)[: len(scatter)])
        families.append(layout.family[scatter])
    return _Squares(np.concatenate(values), np.concatenate(families))


class _Moments(NamedTuple):
    """Mean and variance of what a group has alone: its scatter, then its known sizes."""

    mean: Array
    variance: Array


def _own_moments(
    layout: Layout, local: Local, log_spread: Array, mean: Array, covariance: Array
) -> _Moments:
    """What a group has alone, given mean and covariance of its shared parameters."""
    num = len(local.common)
    inner = local.curvature[num:, num:] + np.diag(_scatter_prior(layout, local, log_spread))
    inverse = np.linalg.inv(inner)
    gain = inverse @ local.curvature[num:, :num]
    own = inverse @ local.slope[num:] - gain @ mean
    spread = np.diag(inverse) + np.sum((gain @ covariance) * gain, axis=1)
    return _Moments(np.asarray(own), np.asarray(spread))


def common_information(layout: Layout, locals_: Mapping[str, Local], log_spread: Array) -> Gaussian:
    """What groups say together of the shared parameters, their priors included."""
    common = layout.shared
    place = {i: k for k, i in enumerate(common)}
    prior = layout.shared_precision(log_spread)
    curvature, slope = np.diag(prior), np.zeros(len(common))
    level = 0.5 * float(np.log(prior).sum())
    for local in locals_.values():
        found = _of_common(layout, local, log_spread)
        at = [place[i] for i in local.common]
        curvature[np.ix_(at, at)] += found.curvature
        slope[at] += found.slope
        level += found.level
    return Gaussian(curvature, slope, level)


def _of_common(layout: Layout, local: Local, log_spread: Array) -> Gaussian:
    prior = _scatter_prior(layout, local, log_spread)
    gone = slice(len(local.common), len(local.slope))
    level = local.level - 0.5 * local.square
    known = Priors.of(np.diag(prior)[None], np.zeros((1, len(prior))))
    return without(local.curvature, local.slope, level, gone, known)[0]


def _scatter_prior(layout: Layout, local: Local | Rows, log_spread: Array) -> Array:
    """Prior precision of a group's scatter and known sizes."""
    scatter = _precision(layout, local, log_spread, 1.0)
    return np.concatenate([scatter, np.full(len(local.causes), KNOWN_PRECISION)])


def _precision(
    layout: Layout, local: Local | Rows, log_spread: Array, daily_factor: float
) -> Array:
    at = np.array(local.scatter, dtype=int)
    spread = np.exp(log_spread[layout.family[at]])
    return np.asarray((spread * np.where(layout.is_daily[at], daily_factor, 1.0)) ** -2)


def _solve_point(
    problem: Problem, layout: Layout, local: Local, common: Array, log_spread: Array
) -> Array:
    """Scaled coordinates of a group's problem at which scatter and known sizes fit best."""
    num = len(local.common)
    inner = local.curvature[num:, num:] + np.diag(_scatter_prior(layout, local, log_spread))
    pull = local.slope[num:] - local.curvature[num:, :num] @ common[list(local.common)]
    found = np.linalg.solve(inner, pull)
    point = np.zeros(len(problem.names))
    point[: len(common)] = common
    point[list(local.scatter)] = found[: len(local.scatter)]
    for effect in problem.effects:
        if effect.name in local.causes:
            size = found[len(local.scatter) + local.causes.index(effect.name)]
            point[problem.columns_of(effect)[0]] = size if effect.signed else max(size, 0.0)
    return point


def _curvature(layout: Layout, locals_: Mapping[str, Local], at: Array) -> Array:
    """Second derivatives of -log posterior by central differences of its slopes, made positive
    definite."""
    n, h = len(at), 0.05  # step of the logarithms of spreads
    rows = [
        log_posterior(layout, locals_, at - step)[1] - log_posterior(layout, locals_, at + step)[1]
        for step in h * np.eye(n)
    ]
    out = np.array(rows) / (2.0 * h)
    values, vectors = np.linalg.eigh(0.5 * (out + out.T))
    return np.asarray((vectors * np.maximum(values, FACTOR_SD**-2)) @ vectors.T)
