"""Laplace evidence of hypotheses, in nats, from one linearization of everything.

With W S ~ W S(x0) + A (u - u0) in scaled coordinates u (``Problem.scaled``: base parameters, prior
N(0, 1), and sizes, heavy-tailed), and an unknown cause H z with z ~ N(0, a^2), columns
B = [A_base, A_effects / sqrt(w), a H] and r = W (y - S(x0)) + A u0:

    E = -1/2 r' (1 + B B')^-1 r - 1/2 ln|1 + B'B| + sum_sizes ln(tilt)
        - (number of effects + unknown) ln(number of families) - unknown ln(number of unknowns)

N(0, 1 / w) stands for the prior of a size at the optimum (``sizes.precision_at``), and the tilt
puts the prior itself in its place (``optimum.log_tilt``), its sign included: exact for one size in
a problem that is linear in sizes, however large. Bounds of base parameters cost the share of the
normal beyond them. Where several bounds are active they cost together what the optimum within them
has lost, so no model is credited with a fit beyond its bounds. The amplitude a is averaged over
``AMPLITUDES``. Constants are left out: -N/2 ln(2 pi) + ln|W|, and the share of the base parameters'
prior within the bounds. An unknown cause is eliminated first: H'H = V L V' once, and an amplitude
then divides by 1 + a^2 L along the columns of V.

Candidates are screened by their score at the null fit: what could matter, how large, what mimics
what. With r, J = dWS/dtheta and G = dWS/dphi there:

    G~ = G - J (J'J + 1)^-1 J'G      what base parameters cannot absorb
    I = G'G~,  z = s / sqrt(I),  size = s / I,  smallest visible size = 6 / sqrt(I)
    confounding = cosine between G~_c and G~_d

A screen only: the refit decides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, special

from diffsim.core.memo import Aside, SpilledArray
from diffsim.diagnose.search.optimum import kept_definite, log_tilt, optimum, quadratic_optimum
from diffsim.identify import Fit
from diffsim.identify.effect import Effect, precision_at
from diffsim.identify.gaussian import Gaussian
from diffsim.identify.linearization import ROUNDING
from diffsim.identify.problem import PredictionError, Problem
from diffsim.identify.unknown import Unknown
from diffsim.identify.whitening import MIN_SPARSE, gram_of

Array = NDArray[np.float64]
# root mean square of the unknown's part of the record, in noise standard deviations; of a force on
# a free mass its slowest course has most, one of 4 Hz over 6 s a hundredth
AMPLITUDES = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
NOT_FINITE = "slopes or misfit left the range of numbers: the simulation there means nothing"
ROWS = 1 << 14  # of a record that are looked at at once
# Slopes say nothing of sizes far beyond those that were simulated, and the prior hardly holds them
# back: linear evidence reaches to thirty typical sizes, as scans do, or four times the center's.
REACH = 20.0  # scaled sizes
FARTHER = 4.0
NORMAL: Mapping[int, float] = MappingProxyType({})  # every base parameter by its data sheet
ALONE_NATS = 3.0  # lead over every rival that a set needs to be named alone
TWINS = 0.995  # confounding from which two effects are the same to these data
TIE_DIGITS = 6  # of nats: sets that agree so far rank alike, not as rounding has it


@dataclass(frozen=True)
class Hypothesis:
    """A set of effects and at most one unknown cause, by index."""

    effects: frozenset[int] = frozenset()
    unknown: int | None = None


@dataclass(frozen=True, eq=False)
class SetPosterior:
    """Evidence of a hypothesis and where its posterior lies."""

    nats: float  # logarithm of the Laplace evidence [nats]
    # standardized coordinates of the optimum within the bounds, (n,); zero for effects not in the
    # set
    x: Array
    # posterior standard deviation of the coordinates, (n,); zero for effects not in the set
    sd: Array
    chi2: float  # |r - B x|^2, after the unknown cause's part
    amplitude: float  # most probable amplitude of the unknown cause [noise sd]; 0 without
    # fit of a set that was refitted; None where linear evidence stands, as it does for sets with an
    # unknown cause
    fit: Fit | None = None


@dataclass(frozen=True, eq=False)
class Knots:
    """Knots of an unknown cause along the principal axes of what they do alone: there an amplitude
    is one factor per axis.

    Attributes:
        power: Of each axis, (m,).
        cross: With the slopes of all coordinates, (m, n).
        projection: With the record, (m,).
    """

    power: Array
    cross: Array
    projection: Array


@dataclass(frozen=True)
class Local:
    """Coordinates of single runs, such as their starts, at their best for any others: they are in
    every set, have a normal prior and no bounds, and may be hundreds.
    """

    own: NDArray[np.intp]  # these coordinates, (k,)
    best: Array  # where they are with all others at zero, (k,)
    follow: Array  # what one unit of each coordinate takes off that, (k, n)
    variance: Array  # with all others known, (k,)
    # gram, projection, power: the misfit left to the others, (n, n), (n,) and a number
    gram: Array
    projection: Array
    power: float
    log_det: float  # of their own precision

    @staticmethod
    def of(all_of: LaplaceEvidence, own: Sequence[int]) -> Local:
        """Of the coordinates ``own``, in the evidence of all."""
        cross, b = all_of.gram[own], all_of.projection[own]
        at = Gaussian(cross[:, own] + np.eye(len(own)), b)
        follow = at.solve(cross)
        return Local(
            np.array(own),
            at.mean,
            follow,
            np.diag(at.covariance),
            kept_definite(all_of.gram - cross.T @ follow),
            all_of.projection - cross.T @ at.mean,
            all_of.power - float(b @ at.mean),
            2.0 * at.half_log_det,
        )


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

    Raises:
        PredictionError: the linearization is not of finite numbers.
    """

    jacobian: Aside = Aside()

    def __init__(
        self,
        problem: Problem,
        x: Array,
        residual: Array,
        jacobian: Array,
        responses: Sequence[Array | SpilledArray],
        num_families: int,
        num_unknowns: int | None = None,
    ):
        self.num_unknowns = len(responses) if num_unknowns is None else num_unknowns
        self.problem, self.x0 = problem, x
        self.family_price = float(np.log(max(num_families, 1)))  # nats of one more family's choice
        self.scaled0 = problem.scaled(x)
        self.residual, self.jacobian = residual, jacobian
        slopes = jacobian / problem.stretch(x)
        right = residual + slopes @ problem.scaled(x)
        n = jacobian.shape[1]
        gram, self.projection = np.zeros((n, n)), np.zeros(n)
        parts = _parts(problem)
        with np.errstate(over="ignore", invalid="ignore"):
            for rows in parts:
                gram += gram_of(slopes[rows])
                self.projection += slopes[rows].T @ right[rows]
            self.power = float(right @ right)
        if not (np.isfinite(gram).all() and np.isfinite(self.power)):
            raise PredictionError(NOT_FINITE)
        self.gram = kept_definite(gram)
        self.knots = [_turn_knots(h, slopes, right, parts) for h in responses]
        self.columns = [problem.columns_of(e) for e in problem.effects]
        self.bounds = problem.bounds
        is_open = np.isneginf(self.bounds[0]) & np.isposinf(self.bounds[1])
        own = [i for i in range(problem.num_base) if is_open[i] and "@" in problem.names[i]]
        self.local = Local.of(self, own) if len(own) >= MIN_SPARSE else None

    def weigh(self, hypothesis: Hypothesis, wide: Mapping[int, float] = NORMAL) -> SetPosterior:
        """Evidence of a hypothesis and its optimum.

        Args:
            hypothesis: Effects, and an unknown cause.
            wide: How many times wider the prior of a base parameter is, by its index.
        """
        members = sorted(hypothesis.effects)
        choice = sum(self.family_price + self.problem.effects[i].price for i in members)
        free = list(range(self.problem.num_base)) + [c for i in members for c in self.columns[i]]
        if hypothesis.unknown is None:
            nats, x, sd, chi2 = self._gaussian(free, members, None, 0.0, wide)
            return SetPosterior(nats - choice, x, sd, chi2, 0.0)
        knots = self.knots[hypothesis.unknown]
        tried = [self._gaussian(free, members, knots, a, wide) for a in AMPLITUDES]
        evidences = np.array([t[0] for t in tried])
        best = int(np.argmax(evidences))
        mean = special.logsumexp(evidences) - np.log(len(AMPLITUDES))
        _, x, sd, chi2 = tried[best]
        # the unknown causes share what one more family may claim
        price_unknown = self.family_price + np.log(self.num_unknowns)
        return SetPosterior(mean - choice - price_unknown, x, sd, chi2, AMPLITUDES[best])

    def _gaussian(
        self,
        free: list[int],
        members: list[int],
        knots: Knots | None,
        amplitude: float,
        wide: Mapping[int, float],
    ) -> tuple[float, Array, Array, float]:
        local = self.local if knots is None and not wide else None
        if local is not None:
            free = np.setdiff1d(free, local.own).tolist()
        of = self if local is None else local
        count, is_size = len(free), np.array([i >= self.problem.num_base for i in free], dtype=bool)
        low, high = (bound[free] for bound in self.bounds)
        reach = np.where(is_size, np.maximum(REACH, FARTHER * np.abs(self.scaled0[free])), np.inf)
        b, gram, power = of.projection[free], of.gram[np.ix_(free, free)], of.power
        log_det = 0.0 if local is None else local.log_det
        if knots is not None:  # at their best, whatever the free coordinates are
            gained = amplitude**2 / (1.0 + amplitude**2 * knots.power)
            cross = knots.cross[:, free]
            b = b - cross.T @ (gained * knots.projection)
            gram = gram - cross.T @ (gained[:, None] * cross)
            power -= float(gained @ knots.projection**2)
            log_det = float(np.log1p(amplitude**2 * knots.power).sum())
        precision = np.ones(count)
        if is_size.any():
            near = np.maximum(low, -reach), np.minimum(high, reach)
            best = optimum(gram, b, *near, is_size, self.scaled0[free])
            precision[is_size] = precision_at(best[is_size])
        width = 1.0 / np.sqrt(precision)
        for j, factor_of_sd in wide.items():  # base parameters come first, all of them
            width[j] = factor_of_sd
        b, gram = width * b, gram * np.outer(width, width)
        low, high, reach = low / width, high / width, reach / width
        posterior = Gaussian(gram + np.eye(count), b, -0.5 * (power + log_det))
        mean, sd = posterior.mean, np.sqrt(np.diag(posterior.covariance))
        gained_by_bounds = _log_share(mean, sd, low, high)
        signed = [self.problem.effects[i].signed for i in members for _ in self.columns[i]]
        for k, is_signed in zip(np.flatnonzero(is_size), signed, strict=True):
            gained_by_bounds[k] = log_tilt(mean[k], sd[k], precision[k], is_signed)
        mean, lost = _within(mean, sd, gram, b, low, high, reach)
        chi2 = power - 2.0 * (b @ mean) + mean @ gram @ mean
        if knots is not None:  # without the prior of the knots
            left = knots.projection - cross @ (width * mean)
            chi2 -= float(np.sum((amplitude * left / (1.0 + amplitude**2 * knots.power)) ** 2))
        u, deviation = np.zeros(len(self.x0)), np.zeros(len(self.x0))
        u[free], deviation[free] = width * mean, width * sd
        if local is not None:
            follow = local.follow[:, free]
            u[local.own] = local.best - follow @ u[free]
            chi2 -= float(u[local.own] @ u[local.own])
            along = follow * width
            spread = (along @ posterior.covariance) * along
            deviation[local.own] = np.sqrt(local.variance + spread.sum(1))
        x = self.problem.standardized(u)
        deviation /= self.problem.stretch(x)
        nats = posterior.nats + float(gained_by_bounds.sum()) - lost
        return nats, x, deviation, float(chi2)


def _within(
    mean: Array, sd: Array, gram: Array, b: Array, low: Array, high: Array, reach: Array
) -> tuple[Array, float]:
    """The optimum within bounds and reach, and the nats lost beyond what each bound costs alone.

    Args:
        mean, sd: (n,) of the posterior without bounds.
        gram, b: Quadratic and linear part of the misfit; the prior is N(0, 1).
        low, high: Bounds of the coordinates, (n,).
        reach: Distance from zero up to which slopes are believed, (n,).
    """
    near = np.maximum(low, -reach), np.minimum(high, reach)
    if (np.clip(mean, *near) == mean).all():
        return mean, 0.0
    inside, hessian = np.clip(mean, low, high), gram + np.eye(len(b))
    x = quadratic_optimum(hessian, b, *near)
    # together the bounds cost what the optimum lost, not each one's share of it once more
    lost = 0.5 * float((x - mean) @ hessian @ (x - mean))
    return x, lost - 0.5 * float(np.sum(((mean - inside) / sd) ** 2))


def unrealized(fit: Fit, posterior: SetPosterior) -> float:
    """Nats that a Gauss-Newton step from a fit promises but the fit did not reach.

    The evidence from a linearization holds at its optimum; a fit that stopped elsewhere (a kink, a
    fold, too few steps) must not be credited with an optimum that was not simulated.
    """
    return 0.5 * (fit.chi2 + fit.prior - posterior.chi2 - float(posterior.x @ posterior.x))


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


def _parts(problem: Problem) -> list[slice]:
    """Rows of one run, a part at a time: copies of all of a long record's would fill the memory."""
    edges = np.cumsum([0, *problem.num_valid]).tolist()
    return [
        slice(start, min(start + ROWS, stop))
        for first, stop in pairwise(edges)
        for start in range(first, stop, ROWS)
    ]


def _turn_knots(
    responses: Array | SpilledArray, slopes: Array, right: Array, parts: Sequence[slice]
) -> Knots:
    """Knots of an unknown cause along their principal axes; those of one command act in its runs
    only, and have nothing in common with others.

    Raises:
        PredictionError: responses are not of finite numbers.
    """
    m = responses.shape[1]
    alone, cross, acting = np.zeros((m, m)), np.zeros((m, slopes.shape[1] + 1)), list[slice]()
    for rows in parts:
        own = responses[rows]
        used = np.flatnonzero(own.any(0))
        if len(used):
            at = slice(int(used[0]), int(used[-1]) + 1)
            own = own[:, at]
            alone[at, at] += own.T @ own
            cross[at, :-1] += own.T @ slopes[rows]
            cross[at, -1] += own.T @ right[rows]
            acting.append(at)
    if not (np.isfinite(alone).all() and np.isfinite(cross).all()):
        raise PredictionError(NOT_FINITE)
    groups = list[slice]()
    for at in sorted(acting, key=lambda at: at.start):
        if groups and at.start < groups[-1].stop:
            at = slice(groups[-1].start, max(at.stop, groups.pop().stop))
        groups.append(at)
    # N(0, 1) coefficients move a sample by one noise sd, root mean square
    square = float(np.trace(alone)) / len(right) or 1.0
    turned = [linalg.eigh(kept_definite(alone[at, at] / square)) for at in groups]
    power = np.concatenate([np.zeros(0), *(values for values, _ in turned)])
    rows_along = [axes.T @ cross[at] for at, (_, axes) in zip(groups, turned, strict=True)]
    along = np.concatenate([cross[:0], *rows_along]) / np.sqrt(square)
    return Knots(np.maximum(power, 0.0), along[:, :-1], along[:, -1])


VISIBLE = 6.0


@dataclass(frozen=True, eq=False)
class Screen:
    """Scores of all components, in the order of ``names``."""

    names: tuple[str, ...]  # components of the effects, "wind.x" for vectors
    z: Array  # score of each component over its standard deviation, (m,)
    size: Array  # expected size of each component, (m,) [unit]
    # six standard deviations of the size, (m,) [unit]; infinite where the data do not move at all
    smallest_visible: Array
    # length of an effect's score, sqrt(s' I^-1 s), (num_effects,); |z| for one component
    block_z: Array
    confounding: Array  # cosines between what the base parameters cannot absorb, (m, m)
    information: Array  # G'G~ in standardized sizes, (m, m)


def screen(linear: LaplaceEvidence) -> Screen:
    """Scores of all candidates from a linearization at the null fit, where sizes are zero."""
    problem, residual, n = linear.problem, linear.residual, linear.problem.num_base
    j, g = linear.jacobian[:, :n], linear.jacobian[:, n:]
    # the slope vanishes at the exact optimum; so written, an inexact one does no harm
    at = Gaussian.of(j, residual, linear.x0[:n])
    cross = j.T @ g
    information, score = at.left_to(cross, g.T @ g, g.T @ residual)
    diagonal = np.clip(np.diag(information), 0.0, None)
    # a column that the base parameters absorb up to rounding, or that is rounding, tells nothing
    moved = np.sum(g**2, axis=0)
    blind = (diagonal <= 1e-12 * moved) | (moved <= ROUNDING**2)
    root = np.where(blind, np.inf, np.sqrt(diagonal))
    unit = problem.size_units  # at sizes of zero, where slopes by size and by coordinate agree
    tilde = np.where(blind, 0.0, g - j @ at.solve(cross))
    length = np.linalg.norm(tilde, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = np.nan_to_num((tilde.T @ tilde) / np.outer(length, length))
    blocks = []
    for effect in problem.effects:
        c = [i - n for i in problem.columns_of(effect)]
        seen = [i for i in c if not blind[i]]
        s, sub = score[seen], information[np.ix_(seen, seen)]
        blocks.append(np.sqrt(max(float(s @ np.linalg.pinv(sub) @ s), 0.0)) if seen else 0.0)
    with np.errstate(divide="ignore"):
        smallest = np.where(blind, np.inf, VISIBLE / root) * unit
    return Screen(
        names=problem.names[n:],
        z=score / root,
        size=score / root**2 * unit,
        smallest_visible=smallest,
        block_z=np.array(blocks),
        confounding=cosine,
        information=information,
    )


def twins_of(effects: Sequence[Effect], screened: Screen, i: int) -> tuple[int, ...]:
    """Other effects of the library, by index, that do to these data what effect ``i`` does."""
    owner = [k for k, e in enumerate(effects) for _ in e.components]
    own = [c for c, k in enumerate(owner) if k == i]
    close = np.abs(screened.confounding[own]).max(axis=0) > TWINS
    return tuple(dict.fromkeys(owner[c] for c in np.flatnonzero(close) if owner[c] != i))
