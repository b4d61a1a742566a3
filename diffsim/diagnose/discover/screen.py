"""Every entry by every variable: what a smooth or periodic law there would explain.

A law is a sum of bumps over its variable, or of a sine and a cosine of one wave number, with
normally distributed factors of one amplitude, which is averaged over. All are slopes at one fit, so
that each costs a tangent and its evidence is that of an unknown cause. Runs that were left out say
whether it holds for more than what it was fitted to.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, special

from diffsim.core.errors import DiffsimError
from diffsim.diagnose.discover.follow import FollowedRecord
from diffsim.diagnose.search.evidence import AMPLITUDES
from diffsim.diagnose.search.fit import Progress
from diffsim.identify import Problem
from diffsim.identify.law import VALUE, Entry, Gains, Variable
from diffsim.identify.setup import LawPort

Array = NDArray[np.float64]
NUM_BUMPS = 11  # over the range of a variable, half overlapping
FEWEST_PERIODS = 2.0  # over the range: fewer are no repetition, bumps follow them
MOST_NUMBERS = 4000  # wave numbers that are tried
MOST_WORK = 2.5e9  # wave numbers by knots and samples, for a variable at an entry: a second or two
SLOW_QUANTILE = 0.25  # of the steps of a variable, which need two samples a period
CHUNK = 200  # wave numbers at once
PEAKS = 2  # wave numbers of a variable that are weighed
FLAT = 1e-9  # of its size, below which a variable rests
MOST_SIMULATED = 24  # laws of a screen whose terms must be simulated: eleven tangents each
SMALL = 0.01  # of the usual magnitude at an entry: a term at which slopes are taken
NUM_TREND = 101  # points at which bumps are made a trend
PARTS = 4  # of a recording of less runs, that are left out one after the other


@dataclass(frozen=True)
class Basis:
    """Terms of a law before it has a form.

    Attributes:
        terms: Formulas of ``u``, one for each factor.
        wave: Wave number of a sine and a cosine; 0: none.
        reach: Least and largest value of the variable, of others.
    """

    terms: tuple[str, ...]
    wave: float = 0.0
    reach: tuple[float, float] = (0.0, 0.0)

    def values(self, u: Array) -> Array:
        """The terms at values of the variable, (len(u), num_terms)."""
        if self.wave:
            return np.stack([np.sin(self.wave * u), np.cos(self.wave * u)], 1)
        low, high = self.reach
        if len(self.terms) < NUM_BUMPS:
            z = (2.0 * u - low - high) / (high - low)
            return np.stack([z, z**2], 1)
        centers = np.linspace(low, high, NUM_BUMPS)
        return np.asarray(np.exp(-0.5 * ((u[:, None] - centers) / (centers[1] - centers[0])) ** 2))


@dataclass(frozen=True, eq=False)
class Candidate:
    """A law without a form: an entry, a variable, a basis, and what it explains at a fit.

    Attributes:
        entry: Where it enters.
        variable: On what it depends.
        basis: Its terms.
        nats: Evidence over the same model without it.
        gained: Nats that it gains on parts of the record that were left out.
        share: Share of the misfit of these that it takes away.
        typical: Standard deviation of its factors, at the most probable amplitude.
    """

    entry: Entry
    variable: Variable
    basis: Basis
    nats: float
    gained: float
    share: float
    typical: float

    @property
    def score(self) -> float:
        """Nats that hold for what it was fitted to and for what was left out."""
        return min(self.nats, self.gained)


def bumps(low: float, high: float) -> Basis:
    """Bumps over a range."""
    centers = np.linspace(low, high, NUM_BUMPS)
    width = float(centers[1] - centers[0])
    terms = tuple(f"exp(-0.5*(({VALUE} - {c:.9g})/{width:.9g})**2)" for c in centers.tolist())
    return Basis(terms, reach=(low, high))


def trend(low: float, high: float) -> Basis:
    """A line and a parabola over a range: what holds for runs that reach farther, too."""
    z = f"((2*{VALUE} - {low + high!r})/{high - low!r})"
    return Basis((z, f"{z}**2"), reach=(low, high))


def _wave(k: float) -> Basis:
    return Basis((f"sin({k!r}*{VALUE})", f"cos({k!r}*{VALUE})"), k)


def screen_laws(
    followed: FollowedRecord, port: LawPort, progress: Progress, most_steps: float = np.inf
) -> list[Candidate]:
    """All laws without a form, by their evidence, the best first.

    Args:
        followed: Simulations that lie on the recordings.
        port: What the system offers to laws.
        progress: Receives stage, share done and message.
        most_steps: Weighted steps after which no further terms are simulated.
    """
    out: list[Candidate] = []
    entries = port.entries
    weigher = Weigher.of(followed)
    variables = port.variables()
    courses = followed.courses(port, variables)
    dear: list[tuple[Variable, _AtEntry, list[Array]]] = []
    for k, entry in enumerate(entries):
        progress("laws", k / len(entries), f"laws at {entry.words}")
        screen = _AtEntry(followed, weigher, port, entry, followed.gains(port, entry))
        for i, variable in enumerate(variables):
            if not variable.may_be_at(entry):
                continue
            u = [course[:, i] for course in courses]
            if screen.gains is None:
                dear.append((variable, screen, u))
            else:
                out += screen.weigh(variable, u)
    # what is there at once is tried before what lasts, its own past before that of others
    dear.sort(key=lambda d: (bool(d[0].memory), d[0].of not in ("", d[1].entry.target)))
    tally = followed.fit.problem.model.simulations
    begun = tally.steps
    for k, (variable, screen, u) in enumerate(dear[:MOST_SIMULATED]):
        if tally.steps - begun > most_steps:
            break
        progress("laws", k / len(dear), f"laws at {screen.entry.words}")
        out += screen.weigh_simulated(variable, u)
    return sorted(out, key=lambda c: -c.score)


@dataclass(frozen=True, eq=False)
class _AtEntry:
    """Laws at one entry."""

    followed: FollowedRecord
    weigher: Weigher
    port: LawPort
    entry: Entry
    gains: Sequence[Gains] | None

    def weigh(self, variable: Variable, u: Sequence[Array]) -> Iterator[Candidate]:
        """Laws of one variable with bumps, and with the waves that repeat best."""
        found = _range_of(np.concatenate(u))
        if found is None:
            return
        tried = [trend(*found), bumps(*found)]
        if variable.is_turn and self.entry.kind != "input":
            tried += [_wave(k) for k in self._repeating(u)]
        assert self.gains is not None
        for basis in tried:
            block = self.followed.columns_of(self.gains, [basis.values(v) for v in u])
            yield from self._weigh(variable, basis, block)

    def weigh_simulated(self, variable: Variable, u: Sequence[Array]) -> Iterator[Candidate]:
        """The same where every term is simulated: a trend is a sum of bumps."""
        found = _range_of(np.concatenate(u))
        if found is None:
            return
        wide, slim = bumps(*found), trend(*found)
        effect = self.port.terms(self.entry, variable, wide.terms, "law", SMALL * self.entry.scale)
        try:
            block = self.followed.simulated(effect)
        except DiffsimError:  # it cannot be simulated a small step away
            return
        points = np.linspace(*found, NUM_TREND)
        made_of = linalg.lstsq(wide.values(points), slim.values(points))[0]
        yield from self._weigh(variable, slim, block @ made_of)
        yield from self._weigh(variable, wide, block)

    def _weigh(self, variable: Variable, basis: Basis, block: Array) -> Iterator[Candidate]:
        power = float(np.sqrt(np.sum(block**2) / len(block)))
        if not (power > 0.0 and np.isfinite(power)):
            return
        nats, amplitude = self.weigher.gain(block / power)
        gained, share = self.weigher.left_out(block / power * amplitude)
        yield Candidate(self.entry, variable, basis, nats, gained, share, amplitude / power)

    def _repeating(self, u: Sequence[Array]) -> list[float]:
        """Wave numbers with which a law of a variable would repeat, the best ones."""
        every = np.concatenate(u)
        reach = float(every.max() - every.min())
        steps = np.concatenate([np.abs(np.diff(v)) for v in u])
        fastest = float(np.quantile(steps, SLOW_QUANTILE)) if len(steps) else 0.0
        if not fastest > 0.0:
            return []
        # a quarter of a period more over the range tells two numbers apart
        spacing = 0.5 * np.pi / reach
        work = sum(r.size for r in self.followed.responses) + len(every)
        highest = min(np.pi / fastest, spacing * min(MOST_NUMBERS, MOST_WORK / work))
        numbers = np.arange(2.0 * np.pi * FEWEST_PERIODS / reach, highest, spacing)
        if len(numbers) < 3:
            return []
        scores = np.concatenate(
            [self._scores(u, part) for part in np.array_split(numbers, len(numbers) // CHUNK + 1)]
        )
        inner = (scores[1:-1] >= scores[:-2]) & (scores[1:-1] >= scores[2:])
        tops = np.flatnonzero(np.concatenate([[True], inner, [True]]))
        return [float(numbers[i]) for i in tops[np.argsort(-scores[tops])][:PEAKS]]

    def _scores(self, u: Sequence[Array], numbers: Array) -> Array:
        """Misfit that each wave would take away at once."""
        terms = []
        for v in u:
            phase = np.outer(v, numbers)
            terms.append(np.concatenate([np.sin(phase), np.cos(phase)], 1))
        assert self.gains is not None
        return self.weigher.scores(self.followed.columns_of(self.gains, terms))


def _range_of(u: Array) -> tuple[float, float] | None:
    """Least and largest value of a variable; None where it rests."""
    seen = u[np.isfinite(u)]
    low, high = (float(seen.min()), float(seen.max())) if len(seen) else (0.0, 0.0)
    is_flat = high - low <= FLAT * max(abs(low), abs(high), 1e-300)
    return None if is_flat or not np.isfinite(high - low) else (low, high)


@dataclass(frozen=True, eq=False)
class Weigher:
    """Evidence of further columns beside those of a fit.

    Attributes:
        missing: Whitened record less the simulation at the prior's center, by the slopes, (N,).
        jacobian: Slopes by coordinates that are N(0, 1), (N, n).
        factor: Cholesky factor of J'J + 1.
        folds: Part that each sample belongs to, (N,).
    """

    missing: Array
    jacobian: Array
    factor: tuple[Array, bool]
    folds: Array

    @classmethod
    def of(cls, followed: FollowedRecord) -> Weigher:
        """Of simulations that lie on the recordings."""
        j, fit = followed.jacobian, followed.fit
        factor = linalg.cho_factor(j.T @ j + np.eye(j.shape[1]), lower=True)
        return cls(followed.missing + j @ fit.x, j, factor, _folds(fit.problem))

    def gain(self, columns: Array) -> tuple[float, float]:
        """Nats by which a law is better than none, averaged over its amplitude; the best one.

        Args:
            columns: Slopes by its factors, (N, k); of root mean square one.
        """
        j = self.jacobian
        mixed = j.T @ columns
        solved = linalg.cho_solve(self.factor, mixed)
        gram = columns.T @ columns - mixed.T @ solved
        right = columns.T @ self.missing - solved.T @ (j.T @ self.missing)
        values, vectors = linalg.eigh(gram)
        values, along = np.maximum(values, 0.0), (vectors.T @ right) ** 2
        squares = np.array(AMPLITUDES)[:, None] ** 2
        nats = 0.5 * np.sum(
            squares * along / (1.0 + squares * values) - np.log1p(squares * values), axis=1
        )
        mean = float(special.logsumexp(nats)) - float(np.log(len(nats)))
        return mean, AMPLITUDES[int(np.argmax(nats))]

    def scores(self, columns: Array) -> Array:
        """Misfit that pairs of columns take away, those of a half with those of the other.

        Args:
            columns: Slopes, (N, 2 m).

        Returns:
            (m,).
        """
        j = self.jacobian
        left = columns - j @ linalg.cho_solve(self.factor, j.T @ columns)
        right = left.T @ self.missing
        a, b = np.split(left, 2, axis=1)
        p, q = np.split(right, 2)
        aa, bb, ab = (np.sum(x * y, 0) for x, y in ((a, a), (b, b), (a, b)))
        det = np.maximum(aa * bb - ab**2, 1e-12 * aa * bb + 1e-300)
        return np.asarray((bb * p**2 - 2.0 * ab * p * q + aa * q**2) / det)

    def left_out(self, columns: Array) -> tuple[float, float]:
        """Nats that a law gains on parts of the record it was not fitted to; the share of their
        misfit above the noise.

        What only one part tells, such as its start, is fitted to it with and without the law.

        Args:
            columns: Slopes by factors that are N(0, 1), (N, k).
        """
        n, k = self.jacobian.shape[1], columns.shape[1]
        grams = [self._gram_of(self.folds == i, columns) for i in np.unique(self.folds)]
        total = np.sum(grams, 0)
        before = after = 0.0
        for gram in grams:
            before += _misfit(gram, total - gram, np.arange(n))
            after += _misfit(gram, total - gram, np.arange(n + k))
        # where the stated noise is too large, what it takes away is all that was missing
        missing = max(before - len(self.missing), before - after, 1.0)
        return 0.5 * (before - after), (before - after) / missing

    def _gram_of(self, rows: NDArray[np.bool_], columns: Array) -> Array:
        """Gram matrix of [J, H, missing] in some rows, their own parameters fitted."""
        j = self.jacobian
        inside = np.column_stack([j[rows], columns[rows], self.missing[rows]])
        gram = inside.T @ inside
        is_own = ~(j[~rows] != 0.0).any(0) & (j[rows] != 0.0).any(0)
        own = np.flatnonzero(is_own)
        if len(own):
            inner = gram[np.ix_(own, own)] + np.eye(len(own))
            gram = gram - gram[:, own] @ linalg.solve(inner, gram[own], assume_a="pos")
            gram[own] = gram[:, own] = 0.0  # they are fitted: nobody fits them again
        return np.asarray(gram)


def _folds(problem: Problem) -> Array:
    """Number of the part that each whitened sample belongs to: its run, or a stretch of it."""
    counts = [int(np.isfinite(run.measured).sum()) for run in problem.runs]
    if len(counts) >= PARTS:
        return np.repeat(np.arange(len(counts)), counts)
    parts = [np.arange(n) * PARTS // max(n, 1) + PARTS * k for k, n in enumerate(counts)]
    return np.concatenate(parts)


def _misfit(gram: Array, rest: Array, idx: NDArray[np.int64]) -> float:
    """Misfit of a part with what the rest tells of coordinates."""
    inner = rest[np.ix_(idx, idx)] + np.eye(len(idx))
    d = linalg.solve(inner, rest[idx, -1], assume_a="pos")
    return float(gram[-1, -1] - 2.0 * d @ gram[idx, -1] + d @ gram[np.ix_(idx, idx)] @ d)
