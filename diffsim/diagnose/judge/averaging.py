"""Bayesian model averaging: probability and size of a cause over all sets that were weighed.

A set of evidence E has the weight exp(E) over the sum of all; the price of the choice is in E
already. Sizes are mixtures, one normal per set that holds the cause, in scaled coordinates: where
an unknown force or drift has the evidence, its sets have the weight, so the sizes are those beside
it. Normals are widened to the spread over fits without a part of the runs (``widening``).

What the extended model holds is stated as it holds it: the value of its own fit, which predicts
unseen runs, inside of an interval over all sets. So what is named is what is saved and judged.
Where one other of its causes may be zero, the interval holds that of the set without that one, too,
whatever its evidence: sizes that only stand beside what may be absent are not known that well.
Where a budget ended a fit before its optimum, its intervals are wider by what is left of the way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import optimize, special

from diffsim.core.arrays import Array
from diffsim.core.memo import Memo, memo_field
from diffsim.diagnose.checks.numerics import numerical_shift
from diffsim.diagnose.judge.judge import Judgment
from diffsim.diagnose.judge.left_out import (
    Folds,
    blocks_of,
    determined,
    groups_of,
    known_alone,
    moved,
)
from diffsim.diagnose.judge.records import Interval
from diffsim.diagnose.search.evidence import ALONE_NATS, Hypothesis, LaplaceEvidence
from diffsim.diagnose.search.fitted_sets import Search
from diffsim.diagnose.search.simulations import NONE, Members
from diffsim.identify import Fit
from diffsim.identify.effect import Effect, is_of_run

MODEL_FORM = 0.01  # relative uncertainty of a size, beside the statistical one
POOLED_FREEDOM = 4.0  # degrees of freedom that the other parameters lend to a parameter's spread


@dataclass(frozen=True, eq=False)
class ModelAverage:
    """Weights of all sets in play."""

    search: Search  # sets that were weighed
    # weight of each set, unknown causes that repeats refuted left out; sums to one
    weights: Mapping[Hypothesis, float]
    # the same with them: sizes are not to depend on whether repeats are many enough
    sized: Mapping[Hypothesis, float]
    # how many times wider than noise makes them intervals are, by coordinate of the best fit
    factors: Mapping[str, float] = field(default_factory=dict)
    # standard deviation of these scaled coordinates by the jackknife
    spread: Mapping[str, float] = field(default_factory=dict)
    usual: float = 1.0  # factor of all other coordinates
    # change of the record by refining each numerical setting, (N,) each
    changes: Mapping[str, Array] = field(default_factory=dict)
    members: Members = NONE  # effects that the extended model holds, by index
    _posteriors: Memo[tuple[Array, Array]] = memo_field()
    _centers: Memo[LaplaceEvidence] = memo_field()

    @property
    def reach(self) -> tuple[Hypothesis, ...]:
        """Sets within 3 nats of the best one, best first."""
        least = max(self.weights.values()) * np.exp(-ALONE_NATS)
        found = [h for h, w in self.weights.items() if w >= least]
        return tuple(sorted(found, key=lambda h: -self.weights[h]))

    def probability(self, i: int) -> float:
        """Probability that an effect, by index, acts."""
        return float(sum(w for h, w in self.weights.items() if i in h.effects))

    def added(self, members: frozenset[int], i: int) -> float:
        """Nats that an effect adds to a set, by linear evidence at it; below zero: it costs.

        Beside the unknown cause of the best of all sets: what that takes up asks for no effect.
        """
        search, u = self.search, max(self.weights, key=lambda h: self.weights[h]).unknown
        made = search.simulations
        if (members, u) not in made.unknown_slopes:
            u = None
        without, both = Hypothesis(members, u), Hypothesis(members | {i}, u)
        known = {**search.linear, **search.posteriors}
        if both in known and without in known:
            return known[both].nats - known[without].nats
        if members not in made.screened:
            return 0.0
        evidence = self._centers((members, u), lambda: self._center(members, u))
        only = None if u is None else 0
        both, without = replace(both, unknown=only), replace(without, unknown=only)
        return evidence.weigh(both).nats - evidence.weigh(without).nats

    def _center(self, members: frozenset[int], u: int | None) -> LaplaceEvidence:
        """Linear evidence at a set, beside an unknown cause by index if there is one."""
        search, made = self.search, self.search.simulations
        families, at = search.num_families, made.screened[members]
        if u is None:
            return made.center(members, at, families).evidence
        return made.evidence_with_unknown(members, search.unknowns[u], u, families)

    def size(self, i: int) -> dict[str, Interval]:
        """Size of an effect by component; empty where no set with it was weighed."""
        return self._sizes(i, widened=True)

    def factor(self, i: int) -> float:
        """How many times wider than without leaving out parts the widest interval is."""
        pairs = zip(self.size(i).values(), self._sizes(i, widened=False).values(), strict=True)
        ratios = [(a.high - a.low) / (b.high - b.low) for a, b in pairs if b.high > b.low]
        return max([1.0, *ratios])

    def _sizes(self, i: int, *, widened: bool, alone: bool = False) -> dict[str, Interval]:
        """Sizes by component.

        Args:
            i: Index of the effect.
            widened: Whether intervals are as wide as parts of the runs spread.
            alone: Whether nothing beside it in the extended model is held to be absent.
        """
        wide = self.search.wide
        effect = wide.effects[i]
        holding = [h for h in self.sized if i in h.effects]
        weights = np.array([self.sized[h] for h in holding])
        if not len(weights) or not weights.sum() > 0.0:
            if i not in self.members:
                return {}
            holding, weights = [Hypothesis(self.members)], np.ones(1)
        columns = wide.columns_of(effect)
        names = [wide.names[c] for c in columns]
        widen = names if widened else None
        parts = [self._part(h, i, widen) for h in holding]
        held = [] if i not in self.members else [self.members] if alone else self._answers(i)
        answers = [self._part(Hypothesis(members), i, widen) for members in held]
        out = {}
        fitted = {f"@{run.name}" for run in wide.runs}
        for k, component in enumerate(effect.components):
            if is_of_run(component) and component not in fitted:
                continue  # of a run that nothing was fitted to
            unit = float(wide.size_units[columns[k] - wide.num_base])
            mean = unit * np.array([p[0][k] for p in parts])
            sd = np.hypot(unit * np.array([p[1][k] for p in parts]), MODEL_FORM * mean)
            size = _interval(weights, mean, sd, effect)
            for of, spread in reversed(answers):
                mean = unit * of[[k]]
                own = _interval(
                    np.ones(1), mean, np.hypot(unit * spread[[k]], MODEL_FORM * mean), effect
                )
                size = Interval(own.value, min(size.low, own.low), max(size.high, own.high))
            out[component] = size
        return out

    def _answers(self, i: int) -> list[Members]:
        """The set of the extended model, and that without the other cause that may be zero, where
        its fit has ended; where several may be, without one the others do what it did."""
        absent = [k for k in sorted(self.members - {i}) if self.may_be_zero(k, alone=True)]
        if len(absent) != 1:
            return [self.members]
        without = self.members - {absent[0]}
        fits = {h.effects: w.fit for h, w in self.search.posteriors.items() if h.unknown is None}
        is_ended = (fit := fits.get(without)) is not None and fit.converged
        return [self.members, without] if is_ended else [self.members]

    def may_be_zero(self, i: int, *, alone: bool = False) -> bool:
        """Whether the widened intervals of all components of a size hold zero, together too.

        A size for all and one for each propeller share what they say: of neither alone zero can be
        excluded, of their sum it can. By the heaviest set with a fit, at 90 %, widened as intervals
        are.

        Args:
            i: Index of the effect.
            alone: As of ``_sizes``.
        """
        sizes = self._sizes(i, widened=True, alone=alone)
        if not sizes or not all(size.low <= 0.0 <= size.high for size in sizes.values()):
            return False
        fits = {h: w.fit for h, w in self.search.posteriors.items() if i in h.effects}
        held = [h for h, fit in fits.items() if fit is not None and self.weights.get(h, 0.0) > 0.0]
        if len(sizes) == 1 or not held:
            return True
        fit = fits[max(held, key=lambda h: self.weights[h])]
        assert fit is not None
        own = fit.problem.columns_of(self.search.wide.effects[i])
        u, stretch = fit.problem.scaled(fit.x)[own], fit.problem.stretch(fit.x)[own]
        spread = fit.covariance[np.ix_(own, own)] * np.outer(stretch, stretch)
        widest = max(self.factors.get(fit.problem.names[c], self.usual) for c in own)
        away = float(u @ np.linalg.solve(spread, u)) / widest**2
        return away <= float(special.chdtri(len(own), 0.1))  # 90 % of chi squared

    def _part(self, h: Hypothesis, i: int, names: Sequence[str] | None) -> tuple[Array, Array]:
        """Mean and sd of an effect's scaled coordinates in a set.

        Args:
            h: Set with or without an unknown cause.
            i: Index of the effect.
            names: Coordinates to widen; None: the statistical sd alone.
        """
        effect = self.search.wide.effects[i]
        fit = (self.search.posteriors.get(h) or self.search.linear[h]).fit
        own = (self.search.wide if fit is None else fit.problem).columns_of(effect)
        known = self._posteriors(h, lambda: self._computed_posterior(h))
        mean, sd = (values[own] for values in known)
        if names is None:
            return mean, sd
        if h.unknown is None:
            return mean, sd * [self.factors.get(n, self.usual) for n in names]
        # the unknown cause takes up what makes fits differ: the spread is a floor, no factor
        return mean, np.maximum(sd, [self.spread.get(n, 0.0) for n in names])

    def _computed_posterior(self, h: Hypothesis) -> tuple[Array, Array]:
        """Mean and sd of all scaled coordinates of a set's problem; of a fit that its budget cut
        with how far its slopes still lead."""
        posterior = self.search.posteriors.get(h) or self.search.linear[h]
        fit = posterior.fit
        if fit is None:
            problem, x, sd = self.search.wide, posterior.x, posterior.sd
        else:
            problem, x = fit.problem, fit.x
            shift = numerical_shift(fit, self.changes)
            sd = np.hypot(np.sqrt(np.diag(fit.covariance)), shift)
        u, spread = problem.scaled(x), sd * problem.stretch(x)
        if fit is not None and fit.ended == "budget":
            spread = np.hypot(spread, problem.scaled(posterior.x) - u)
        return u, spread


def averaged(
    search: Search, judgment: Judgment, fit: Fit, changes: Mapping[str, Array]
) -> ModelAverage:
    """Weights of all sets and the widening of intervals.

    Args:
        search: Sets that were weighed.
        judgment: Sets with effects that it withdrew are out of play, unknown causes that repeats
            refuted have no weight; a wrong data sheet may have more evidence than a set's own.
        fit: Fit of the extended model, whose parts are left out one after the other.
        changes: Change of the record by refining each numerical setting.
    """
    nats = {h: w.nats for h, w in {**search.linear, **search.posteriors}.items()}
    nats = {h: e for h, e in nats.items() if not h.effects & judgment.withdrawn}
    nats |= {Hypothesis(members): e for members, (_, e) in judgment.decision.instead.items()}
    wider = widening(fit)
    kept = {h: e for h, e in nats.items() if h.unknown is None or h.unknown not in judgment.refuted}
    return ModelAverage(
        search,
        _weights(kept),
        _weights(nats),
        wider.factors,
        wider.spread,
        wider.usual,
        changes,
        frozenset(search.wide.effects.index(e) for e in fit.problem.effects),
    )


@dataclass(frozen=True, eq=False)
class Widening:
    """How fits without a part of the runs spread; fields as of ``ModelAverage``."""

    factors: Mapping[str, float] = field(default_factory=dict)
    spread: Mapping[str, float] = field(default_factory=dict)
    usual: float = 1.0


def widening(fit: Fit) -> Widening:
    """How many times wider than noise alone makes them intervals have to be, by coordinate.

    The spread of K linear refits, each without one part, gives the variance of the whole fit by the
    jackknife, (K - 1) / K sum (x_k - mean)^2, without any model of the noise. It has K - 1 degrees
    of freedom; where it is small, four more come from what is usual among the fit's parameters.
    Parts are groups of runs; blocks of time for what is known from one group alone. What a run has
    of its own stands beside what all share, which may be another in this run than in the mean of
    the parts: by the root of their number farther off than that mean is uncertain.

    Returns:
        Factors, at least 1.
    """
    known = determined(fit)
    groups, blocks = groups_of(fit.problem), blocks_of(fit.problem)
    alone = dict.fromkeys(known, True)
    if groups is not None:
        alone = dict(zip(known, known_alone(fit, groups).tolist(), strict=True))
    sd = np.sqrt(np.diag(fit.covariance)) * fit.problem.stretch(fit.x)
    factors: dict[str, float] = {}
    times: dict[str, float] = {}  # of the same, in a single run
    for folds, own, count in (
        (groups, [i for i in known if not alone[i]], 0 if groups is None else len(groups.parts)),
        (blocks, [i for i in known if alone[i]], 1),
    ):
        if folds is not None and own:
            found = dict(
                zip((fit.problem.names[i] for i in own), _factors(fit, folds, own), strict=True)
            )
            factors |= found
            times |= {n: float(np.sqrt(1.0 + count * (f**2 - 1.0))) for n, f in found.items()}
    usual = float(np.median(list(factors.values()))) if factors else 1.0
    place = {name: i for i, name in enumerate(fit.problem.names)}
    spread = {n: f * float(sd[place[n]]) for n, f in factors.items()}
    common, own = [place[n] for n in factors], [i for n, i in place.items() if "@" in n]
    if common and own:
        beside = fit.covariance[np.ix_(own, common)]
        among, each = fit.covariance[np.ix_(common, common)], np.array(list(times.values()))
        follows = np.linalg.solve(among, beside.T).T
        more = np.sum((follows @ (among * np.outer(each, each) - among)) * follows, axis=1)
        ratio = 1.0 + np.maximum(more, 0.0) / np.diag(fit.covariance)[own]
        factors |= {fit.problem.names[i]: f for i, f in zip(own, np.sqrt(ratio), strict=True)}
    return Widening(factors, spread, usual)


def _factors(fit: Fit, folds: Folds, own: Sequence[int]) -> list[float]:
    """Factors of some coordinates by leaving out parts."""
    problem, count = fit.problem, len(folds.parts)
    ends = np.array([problem.scaled(moved(fit, ~fold.rows))[own] for fold in folds.parts])
    variance = (count - 1) / count * np.sum((ends - ends.mean(axis=0)) ** 2, axis=0)
    sd = (np.sqrt(np.diag(fit.covariance)) * problem.stretch(fit.x))[own]
    ratio, freedom = variance / sd**2, count - 1.0
    usual = float(np.median(ratio)) / (float(special.chdtri(freedom, 0.5)) / freedom)
    pooled = (freedom * ratio + POOLED_FREEDOM * usual) / (freedom + POOLED_FREEDOM)
    # a spread of its own is never shrunk: a size may differ from run to run where others do not
    return np.sqrt(np.maximum(np.maximum(ratio, pooled), 1.0)).tolist()


def _weights(nats: Mapping[Hypothesis, float]) -> dict[Hypothesis, float]:
    values = np.array(list(nats.values()))
    total = special.logsumexp(values)
    return dict(zip(nats, np.exp(values - total).tolist(), strict=True))


def _interval(weights: Array, mean: Array, sd: Array, effect: Effect) -> Interval:
    """Mean and quantiles of a mixture of normals; unsigned sizes are cut at zero."""
    weights = weights / weights.sum()
    keep = weights > 1e-6
    weights, mean, sd = weights[keep], mean[keep], np.maximum(sd[keep], 1e-300)
    low, high = (float((mean - 9.0 * sd).min()), float((mean + 9.0 * sd).max()))

    def quantile(p: float) -> float:
        def above(q: float) -> float:
            return float(weights @ special.ndtr((q - mean) / sd)) - p

        return float(optimize.brentq(above, low, high, xtol=1e-9 * (high - low)))

    ends = [quantile(0.05), quantile(0.95)]
    value = float(weights @ mean) / float(weights.sum())
    if not effect.signed:
        value, ends = max(value, 0.0), [max(q, 0.0) for q in ends]
    return Interval(value, ends[0], ends[1])
