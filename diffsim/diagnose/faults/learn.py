"""Common parameters and spreads, learned from groups whose faults are known.

The spreads maximize their posterior with all scatter integrated out (restricted maximum
likelihood, Patterson and Thompson, Biometrika 58 (1971) 545, with a prior on their logarithms).
Few groups leave them uncertain: later steps average over draws of them, so that a verdict has
the heavier tails of a Student distribution.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from diffsim.diagnose.faults.groups import Group
from diffsim.diagnose.faults.layout import Layout
from diffsim.diagnose.faults.local import Local, local_at, problem_of
from diffsim.diagnose.faults.marginal import Information, without
from diffsim.identify.problem import Problem

Array = NDArray[np.float64]
FACTOR_SD = 1.0  # sd of the logarithm of a spread about the stated one: a factor of e
KNOWN_PRECISION = 1.0 / 3.0**2  # of known sizes: up to about five typical sizes
NUM_DRAWS = 32  # of the spreads, in pairs about the best ones
MAX_ROUNDS = 5
CURVE_STEP = 0.05  # of the logarithms of spreads, for their curvature
SETTLED = 1e-3  # change of common parameters in prior sd, at which rounds end


@dataclass(frozen=True, eq=False)
class Learned:
    """What groups with known faults say of all others.

    Attributes:
        layout: Where the base parameters belong.
        problem: Model, all runs, noise and effects.
        locals: Groups that taught, linearized, by label.
        states: State of each that taught, by label; "" where states are not used.
        log_spread: Most probable logarithm of spread over stated spread, (num_families,).
        covariance: Its posterior covariance.
        draws: Draws of it, (NUM_DRAWS, num_families).
        mean, common_covariance: Of the common parameters for each draw, standardized,
            (NUM_DRAWS, num_common) and (NUM_DRAWS, num_common, num_common).
        point: Scaled base coordinates at the most probable spreads, scatter 0, (num_base,).
    """

    layout: Layout
    problem: Problem
    locals: Mapping[str, Local]
    states: Mapping[str, str]
    log_spread: Array
    covariance: Array
    draws: Array
    mean: Array
    common_covariance: Array
    point: Array

    def precision(self, local: Local, log_spread: Array, *, daily_factor: float = 1.0) -> Array:
        """Prior precision of a group's scatter, (num_scatter,).

        Args:
            local: The group.
            log_spread: Logarithms of spreads over stated ones.
            daily_factor: Factor on the spreads of groups, 1 for groups like those that taught.
        """
        return _precision(self.layout, local, log_spread, daily_factor)

    def of_shared(
        self, local: Local, draw: int, *, new_state: bool = False, factor: float = 1.0
    ) -> tuple[Array, Array]:
        """What is known of the shared parameters of a group for one draw: mean and covariance.

        Args:
            local: The group.
            draw: Number of the draw.
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

    def without(self, label: str) -> Learned:
        """What the other groups say."""
        if label not in self.locals:
            return self
        left = {k: v for k, v in self.locals.items() if k != label}
        states = {k: v for k, v in self.states.items() if k != label}
        return _learned(replace(self, states=states), left, self.log_spread)


def learn(
    problem: Problem,
    layout: Layout,
    groups: Sequence[Group],
    *,
    seed: int,
    state: str | None = None,
) -> Learned:
    """Learn from the groups whose faults are known.

    Args:
        problem: Model, all runs, noise and effects.
        layout: Where the base parameters belong.
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
    own = {g.label: problem_of(problem, g) for g in teachers}
    points = {g.label: np.zeros(len(problem.names)) for g in teachers}
    effects = {e.name: e for e in problem.effects}
    log_spread = np.zeros(len(layout.families))
    rng = np.random.default_rng(seed)
    half = rng.standard_normal((NUM_DRAWS // 2, len(layout.families)))
    empty = np.zeros(0)
    states = {g.label: str(g.runs[0].setup.get(state or "", "")) for g in teachers}
    started = Learned(
        layout,
        problem,
        {},
        states,
        log_spread,
        empty,
        np.vstack([half, -half]),
        empty,
        empty,
        empty,
    )
    before = np.full(num_base, np.inf)
    for _ in range(MAX_ROUNDS):
        locals_ = {
            g.label: local_at(
                own[g.label], layout, points[g.label], [effects[c] for c in g.known or ()]
            )
            for g in teachers
        }
        log_spread = best_spread(layout, locals_, log_spread)
        common = common_information(layout, locals_, log_spread).mean
        place = np.zeros(num_base)
        place[layout.shared] = common
        for g in teachers:
            points[g.label] = _solved(own[g.label], layout, locals_[g.label], place, log_spread)
        if np.abs(place - before).max() < SETTLED:
            break
        before = place
    return _learned(started, locals_, log_spread)


def _learned(state: Learned, locals_: Mapping[str, Local], start: Array) -> Learned:
    """Posterior of spreads and common parameters; ``state`` gives layout and draws."""
    layout = state.layout
    best = best_spread(layout, locals_, start)
    covariance: Array = np.asarray(np.linalg.inv(_curvature(layout, locals_, best)))
    standard = state.draws if not state.locals else _standard(state)
    draws = best + standard @ np.linalg.cholesky(covariance).T
    found = [common_information(layout, locals_, d) for d in draws]
    point = np.zeros(len(layout.names))
    point[layout.shared] = common_information(layout, locals_, best).mean
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


def _standard(state: Learned) -> Array:
    """The draws of a state, standardized."""
    factor = np.linalg.cholesky(state.covariance)
    return np.asarray(np.linalg.solve(factor, (state.draws - state.log_spread).T).T)


def best_spread(layout: Layout, locals_: Mapping[str, Local], start: Array) -> Array:
    """Most probable logarithms of the spreads over the stated ones, (num_families,)."""
    found = minimize(
        lambda t: -log_posterior(layout, locals_, t), start, method="BFGS", options={"gtol": 1e-3}
    )
    return np.asarray(found.x)


def log_posterior(layout: Layout, locals_: Mapping[str, Local], log_spread: Array) -> float:
    """Logarithm of the posterior of spreads, up to a constant."""
    found = common_information(layout, locals_, log_spread)
    determinant = np.linalg.slogdet(found.curvature)[1]
    fit = found.level + 0.5 * found.slope @ found.mean - 0.5 * determinant
    return float(fit - 0.5 * np.sum((log_spread / FACTOR_SD) ** 2))


def common_information(
    layout: Layout, locals_: Mapping[str, Local], log_spread: Array
) -> Information:
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
    return Information(curvature, slope, level)


def _of_common(layout: Layout, local: Local, log_spread: Array) -> Information:
    prior = np.concatenate(
        [
            _precision(layout, local, log_spread, 1.0),
            np.full(len(local.causes), KNOWN_PRECISION),
        ]
    )
    gone = slice(len(local.common), len(local.slope))
    level = -0.5 * local.square
    return without(local.curvature, local.slope, level, gone, np.diag(prior), np.zeros(len(prior)))


def _precision(layout: Layout, local: Local, log_spread: Array, daily_factor: float) -> Array:
    at = np.array(local.scatter, dtype=int)
    spread = np.exp(log_spread[layout.family[at]])
    return np.asarray((spread * np.where(layout.is_daily[at], daily_factor, 1.0)) ** -2)


def _solved(
    problem: Problem, layout: Layout, local: Local, common: Array, log_spread: Array
) -> Array:
    """Scaled coordinates of a group's problem at which scatter and known sizes fit best."""
    num = len(local.common)
    precision = _precision(layout, local, log_spread, 1.0)
    prior = np.concatenate([precision, np.full(len(local.causes), KNOWN_PRECISION)])
    inner = local.curvature[num:, num:] + np.diag(prior)
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
    """Second derivatives of -log posterior by central differences, made positive definite."""
    n, h = len(at), CURVE_STEP
    step = h * np.eye(n)

    def f(t: Array) -> float:
        return -log_posterior(layout, locals_, t)

    out = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            out[i, j] = out[j, i] = (
                f(at + step[i] + step[j])
                - f(at + step[i] - step[j])
                - f(at - step[i] + step[j])
                + f(at - step[i] - step[j])
            ) / (4.0 * h * h)
    values, vectors = np.linalg.eigh(out)
    return np.asarray((vectors * np.maximum(values, FACTOR_SD**-2)) @ vectors.T)
