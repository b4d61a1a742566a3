"""Every entry by every variable: what a smooth or periodic law there would explain.

A law is a sum of bumps over its variable, or of a sine and a cosine of one wave number, with
normally distributed factors of one amplitude, which is averaged over. All are slopes at one fit, so
that each costs a tangent and its evidence is that of an unknown cause. Runs that were left out say
whether it holds for more than what it was fitted to.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, permutations

import numpy as np
from scipy import linalg

from diffsim.core.arrays import Array, IntArray
from diffsim.core.errors import DiffsimError
from diffsim.diagnose.discover.follow import FollowedRecord, JointReach, Reach
from diffsim.diagnose.discover.forms import Curve, LawMisfit
from diffsim.diagnose.search.evidence import AMPLITUDES
from diffsim.diagnose.search.fit import Progress
from diffsim.identify import Fit, Problem
from diffsim.identify.effort import KEEP_NATS
from diffsim.identify.gaussian import Gaussian
from diffsim.identify.law import FEWEST_PERIODS, VALUE, Entry, Variable
from diffsim.identify.setup import LawPort

NUM_BUMPS = 11  # over the range of a variable, half overlapping
MOST_NUMBERS = 4000  # wave numbers that are tried
MOST_WORK = 1e9  # wave numbers by samples, over all variables at all entries: some twenty seconds
SLOW_QUANTILE = 0.25  # of the steps of a variable, which need two samples a period
PEAKS = 2  # wave numbers of a variable that are weighed
ONE_TURN = 1.0  # wave number of what an angle brings back after a turn, as weight on a lever
ROUNDING = 1e-9  # of the size of a variable, or of what the record tells best: less is none
LARGEST = 1e38  # range of a variable: its powers, eight at most, are numbers
NUM_POINTS = 81  # over the range of a variable, at which forms are held against the record
MOST_AGAIN = 100  # laws that are weighed again beside one that stands
MOST_SIMULATED = 24  # laws of a screen whose terms must be simulated: eleven tangents each
SMALL = 0.01  # of the usual magnitude at an entry: a term at which slopes are taken
MOST_PAIRS = 8  # laws of two variables that are weighed by what was left out, too
WITH_PAIRS = ("force", "rate", "input", "reading")  # a number multiplies as it is
PARTS = 4  # of a recording of less runs, that are left out one after the other


@dataclass(frozen=True)
class Basis:
    """Terms of a law before it has a form."""

    terms: tuple[str, ...]  # formulas of ``u``, one for each factor
    wave: float = 0.0  # wave number of a sine and a cosine; 0: none
    reach: tuple[float, float] = (0.0, 0.0)  # least and largest value of the variable, of others

    @property
    def tried(self) -> tuple[Basis, ...]:
        """What the law is weighed by: bumps by a trend of their range, too."""
        return (self,) if self.wave else (trend(*self.reach), self)

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
class AskedLaw:
    """What is asked of a law: where it enters, and on what it depends."""

    entry: Entry
    variable: Variable


@dataclass(frozen=True, eq=False)
class Candidate(AskedLaw):
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

    basis: Basis
    nats: float
    gained: float
    share: float
    typical: float

    @property
    def is_plain(self) -> bool:
        """Whether it is of one variable without a memory, and does not repeat."""
        return not (self.variable.memory or self.variable.times or self.basis.wave)

    @property
    def score(self) -> float:
        """Nats that hold for what it was fitted to and for what was left out."""
        return min(self.nats, self.gained)

    @property
    def rank(self) -> tuple[float, bool]:
        """Sorts laws, the best first; of a force and a fixed number that do the same, the force."""
        return -round(self.score, 1), self.entry.kind == "number"


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


@dataclass(frozen=True, eq=False)
class Screen:
    """Laws without a form that were weighed beside one model.

    Attributes:
        weigher: Evidence beside the model, and beside laws that stand already.
        found: The laws, the best first.
        courses: Each variable along the recordings, by its words and numbers.
        reaches: What terms at each entry do; None where they are simulated.
        simulated: Whitened response to bumps over a variable at such an entry, (num_valid, k).
    """

    followed: FollowedRecord
    weigher: Weigher
    found: tuple[Candidate, ...]
    courses: Mapping[int, Sequence[Array]]
    reaches: Mapping[Entry, Reach | JointReach | None]
    simulated: Mapping[tuple[Entry, int], Array]

    @cached_property
    def holding(self) -> tuple[Candidate, ...]:
        """The laws but for those at several places that explain no more than at one of them alone,
        be it of what they are fitted to or of what was left out: at the others such a law only
        follows what else is missing."""
        one = {(c.entry, c.variable.name, c.basis.wave): c for c in self.found}
        out = []
        for c in self.found:
            at = c.variable.at_parts(c.entry) if c.entry.parts else ()
            places = ((part, own.name, c.basis.wave) for part, own in at)
            alone = [one[place] for place in places if place in one]
            if all(min(c.nats - o.nats, c.gained - o.gained) > KEEP_NATS for o in alone):
                out.append(c)
        return tuple(out)

    def values(self, candidate: Candidate) -> Sequence[Array]:
        """A law's variable along the recordings, (num_samples,) for each run."""
        return self.courses[id(candidate.variable)]

    def columns_of(self, candidate: Candidate, terms: Callable[[Array], Array]) -> Array:
        """Whitened response to terms of a law's variable at its entry, (num_valid, num_terms)."""
        reach = self.reaches[candidate.entry]
        if reach is not None:
            return reach.columns(self._terms_along(candidate.variable, terms))
        return self.simulated[candidate.entry, id(candidate.variable)] @ _made_of_bumps(
            candidate.basis.reach, terms
        )

    def _terms_along(self, variable: Variable, terms: Callable[[Array], Array]) -> list[Array]:
        """Terms of a variable along the recordings, (num_samples, num_terms) for each run."""
        out = [terms(u) for u in self.courses[id(variable)]]
        if variable.times is None:
            return out
        by = self.courses[id(variable.times)]
        return [t * w[:, None] for t, w in zip(out, by, strict=True)]

    def with_pairs(self, entries: Iterable[Entry]) -> tuple[Screen, list[Candidate], int]:
        """The same with laws of one variable multiplied by another one.

        Args:
            entries: Where they may enter; a number multiplies as it is.

        Returns:
            The screen, the best of these laws, the best first, and how many were weighed.
        """
        courses, asked = dict(self.courses), list[Candidate]()
        screen, nats = replace(self, courses=courses), list[float]()
        for entry in entries:
            reach = self.reaches[entry]
            if entry.kind not in WITH_PAIRS or reach is None:
                continue
            plain = {
                c.variable.name: c
                for c in self.found
                # of alike places' own values none multiplies what all of them share
                if c.entry == entry and c.is_plain and not c.variable.parts
            }
            own = []
            for law, other in permutations(plain.values(), 2):
                pair = law.variable.with_factor(other.variable)
                courses[id(pair)] = courses[id(law.variable)]
                own.append(replace(law, variable=pair))
            asked += own
            nats += screen._nats_at(reach, own)
        best = [asked[k] for k in np.argsort(-np.array(nats), kind="stable")[:MOST_PAIRS]]
        weighed = sorted((screen.reweighed(c) for c in best), key=lambda c: c.rank)
        return screen, weighed, len(asked)

    def _nats_at(self, reach: Reach | JointReach, laws: Sequence[Candidate]) -> Iterator[float]:
        """Evidence of laws of one entry by their bases."""
        counts = [len(law.basis.terms) for law in laws]
        for part in _in_batches(counts):
            every = [self._terms_along(law.variable, law.basis.values) for law in laws[part]]
            columns = reach.columns([np.hstack(run) for run in zip(*every, strict=True)])
            for gain in self.weigher.gains(columns, counts[part]):
                yield -np.inf if gain is None else gain[0]

    def misfit_of(self, candidate: Candidate) -> LawMisfit:
        """What the record tells of a law over its variable, by straight lines between points."""
        every = np.concatenate(list(self.values(candidate)))
        points = np.linspace(float(np.nanmin(every)), float(np.nanmax(every)), NUM_POINTS)
        hats = np.eye(NUM_POINTS)
        columns = self.columns_of(
            candidate, lambda u: np.stack([np.interp(u, points, h) for h in hats], 1)
        )
        return LawMisfit(points, *self.weigher.misfit_of(columns), self._is_of_number(candidate))

    def misfit_at(self, ended: Fit, candidate: Candidate, curve: Curve) -> LawMisfit:
        """The same by the slopes of a fit with the law, which its factors are the last of."""
        count = len(curve.factors)
        j, r = ended.jacobian[:, :-count], ended.residual
        unit = ended.problem.size_units[-count:] * ended.problem.stretch(ended.x)[-count:]
        columns = ended.jacobian[:, -count:] / unit  # by its factors
        missing = r + j @ ended.x[:-count] + columns @ curve.factors
        weigher = Weigher.of_slopes(missing, j, self.weigher.folds)
        to_factors = linalg.pinv(curve.basis)  # of values at the curve's points
        told = weigher.misfit_of(columns @ to_factors)
        return LawMisfit(curve.u, *told, self._is_of_number(candidate))

    def _is_of_number(self, candidate: Candidate) -> bool:
        entry, names = candidate.entry, self.followed.fit.problem.names
        is_free = all(part.target in names for part in entry.parts or (entry,))
        return entry.kind == "number" and is_free

    def with_law(self, law: Candidate) -> Screen:
        """What laws would explain beside one that stands, of those that explain anything alone."""
        columns = self.columns_of(law, law.basis.values) * law.typical
        screen = replace(self, weigher=self.weigher.with_columns(columns))
        best: dict[tuple[Entry, int], Candidate] = {}
        for c in self.found:
            if c.nats > 0.0 and (c.entry, c.variable.name) != (law.entry, law.variable.name):
                best.setdefault((c.entry, id(c.variable)), c)
        # the best of every entry first: where one law has explained a place, others are asked for
        place: dict[Candidate, int] = {}
        at: dict[Entry, int] = {}
        for c in best.values():
            place[c] = at[c.entry] = at.get(c.entry, 0) + 1
        asked = sorted(best.values(), key=place.__getitem__)[:MOST_AGAIN]
        again = [screen.reweighed(c) for c in asked]
        return replace(screen, found=tuple(sorted(again, key=lambda c: c.rank)))

    def reweighed(self, candidate: Candidate) -> Candidate:
        """The same law by the evidence of this screen."""
        law = candidate.basis
        columns = np.hstack([self.columns_of(candidate, basis.values) for basis in law.tried])
        nothing = replace(candidate, nats=-np.inf, gained=-np.inf, share=0.0)
        return next(_weigh(self.weigher, [(candidate, law)], columns), nothing)


def _made_of_bumps(reach: tuple[float, float], terms: Callable[[Array], Array]) -> Array:
    """Factors of bumps over a range that come nearest to terms, (NUM_BUMPS, num_terms)."""
    points = np.linspace(*reach, NUM_POINTS)
    return np.asarray(linalg.lstsq(bumps(*reach).values(points), terms(points))[0])


def screen_laws(
    followed: FollowedRecord, port: LawPort, progress: Progress, most_steps: float = np.inf
) -> Screen:
    """All laws without a form, by their evidence.

    Args:
        most_steps: Weighted steps after which no further terms are simulated.
    """
    out: list[Candidate] = []
    entries = port.entries
    weigher = Weigher.of(followed)
    variables = port.variables()
    plain = [v for v in variables if not v.parts]
    along = followed.courses(port, plain)
    courses = {id(v): [course[:, i] for course in along] for i, v in enumerate(plain)}
    for v in (v for v in variables if v.parts):
        each = [courses[id(part)] for part in v.parts]
        courses[id(v)] = [np.concatenate(run) for run in zip(*each, strict=True)]
    most_work = MOST_WORK / max(len(entries) * sum(v.is_turn for v in variables), 1)
    reaches: dict[Entry, Reach | JointReach | None] = {}
    dear: list[tuple[Variable, _AtEntry]] = []
    for k, entry in enumerate(entries):
        progress("laws", 0.5 * k / len(entries), f"at {entry.words}")
        reaches[entry] = followed.reach(port, entry)
    at_one = {e: r for e, r in reaches.items() if isinstance(r, Reach) and e.kind != "input"}
    seen = {e: (r, weigher.seen_by(r)) for e, r in at_one.items()}
    waves = {
        id(v): _repeating(
            {e: s for e, s in seen.items() if v.may_be_at(e)}, courses[id(v)], most_work
        )
        for v in variables
        if v.is_turn
    }
    for k, entry in enumerate(entries):
        progress("laws", 0.5 + 0.5 * k / len(entries), f"at {entry.words}")
        at = _AtEntry(followed, weigher, port, entry, reaches[entry])
        own = [v for v in variables if v.may_be_at(entry)]
        if at.reach is None:
            dear += [(variable, at) for variable in own]
        else:
            numbers = {id(v): waves.get(id(v), {}).get(entry, []) for v in own}
            for has_parts in (False, True):  # values of each place below those of the others
                alike = [v for v in own if bool(v.parts) is has_parts]
                out += at.weigh(alike, courses, numbers)
    # what is there at once is tried before what lasts, its own past before that of others
    dear.sort(key=lambda d: (bool(d[0].memory), d[0].of not in ("", d[1].entry.target)))
    simulated: dict[tuple[Entry, int], Array] = {}
    tally = followed.fit.problem.model.simulations
    begun = tally.steps
    for k, (variable, at) in enumerate(dear[:MOST_SIMULATED]):
        if tally.steps - begun > most_steps:
            break
        progress("laws", k / len(dear), f"at {at.entry.words}")
        reach = range_of(np.concatenate(courses[id(variable)]))
        block = None if reach is None else at.simulate(variable, reach)
        if reach is not None and block is not None:
            simulated[at.entry, id(variable)] = block
            out += at.weigh_simulated(variable, reach, block)
    found = tuple(sorted(out, key=lambda c: c.rank))
    return Screen(followed, weigher, found, courses, reaches, simulated)


def _weigh(
    weigher: Weigher, laws: Sequence[tuple[AskedLaw, Basis]], columns: Array
) -> Iterator[Candidate]:
    """Laws by their columns, whose factors have the most probable amplitude; those that do nothing
    are left out.

    Args:
        weigher: Evidence beside a model.
        columns: Of all that each is weighed by, side by side, (num_valid, num_columns).
    """
    tried = [basis for _, law in laws for basis in law.tried]
    weighed = iter(weigher.weighed(columns, [len(basis.terms) for basis in tried]))
    for of, law in laws:
        each = [(basis, next(weighed)) for basis in law.tried]
        made = [Candidate(of.entry, of.variable, b, *told) for b, told in each if told is not None]
        if made:
            yield _together(made)


def _in_batches(sizes: Sequence[int]) -> Iterator[slice]:
    """Consecutive parts of about 400 columns."""
    edges = np.cumsum([0, *sizes])
    number = max(int(np.ceil(edges[-1] / 400)), 1)
    cuts = np.searchsorted(edges, np.linspace(0, edges[-1], number + 1)[1:-1])
    for first, end in pairwise([0, *cuts.tolist(), len(sizes)]):
        if end > first:
            yield slice(first, end)


def _together(made: Sequence[Candidate]) -> Candidate:
    """One law by several bases: bumps say most of where the runs went, a trend holds for what they
    did not reach."""
    held = max(made, key=lambda c: c.gained)
    nats = max(c.nats for c in made)
    return replace(made[-1], nats=nats, gained=held.gained, share=held.share)


@dataclass(frozen=True, eq=False)
class _AtEntry:
    followed: FollowedRecord
    weigher: Weigher
    port: LawPort
    entry: Entry
    reach: Reach | JointReach | None

    def weigh(
        self,
        variables: Sequence[Variable],
        courses: Mapping[int, Sequence[Array]],
        waves: Mapping[int, Sequence[float]],
    ) -> Iterator[Candidate]:
        """Laws of each variable.

        Args:
            variables: On what they depend.
            courses: Each variable along each run, (num_samples,), by its ``id``.
            waves: Wave numbers that repeat best, by the same.
        """
        reach, entry = self.reach, self.entry
        assert reach is not None
        laws = [
            (AskedLaw(entry, v), law)
            for v in variables
            for law in self._list_bases(v, courses[id(v)], waves[id(v)])
        ]
        for part in _in_batches([sum(len(b.terms) for b in law.tried) for _, law in laws]):
            own = laws[part]
            terms = [
                np.hstack(
                    [b.values(courses[id(of.variable)][k]) for of, law in own for b in law.tried]
                )
                for k in range(len(reach.runs))
            ]
            yield from _weigh(self.weigher, own, reach.columns(terms))

    def _list_bases(
        self, variable: Variable, u: Sequence[Array], waves: Sequence[float]
    ) -> list[Basis]:
        """Bumps, the waves that repeat best, and, of an angle, that of one turn: known beforehand,
        it holds where bumps have no samples. None of a variable that rests."""
        found = range_of(np.concatenate(u))
        if found is None:
            return []
        is_angle = variable.is_turn and variable.unit == "rad"
        every = [*waves, ONE_TURN] if is_angle else waves
        turning = [Basis((f"sin({k!r}*{VALUE})", f"cos({k!r}*{VALUE})"), k) for k in every]
        return [bumps(*found), *turning]

    def simulate(self, variable: Variable, reach: tuple[float, float]) -> Array | None:
        """Whitened response to bumps of a variable, a tangent for each; None where there is none
        a small step away."""
        terms, small = bumps(*reach).terms, SMALL * self.entry.scale
        try:
            return self.followed.simulated(
                self.port.terms(self.entry, variable, terms, "law", small)
            )
        except DiffsimError:
            return None

    def weigh_simulated(
        self, variable: Variable, reach: tuple[float, float], block: Array
    ) -> Iterator[Candidate]:
        """The law of one variable whose bumps were simulated."""
        law = bumps(*reach)
        columns = [block @ _made_of_bumps(reach, basis.values) for basis in law.tried]
        yield from _weigh(self.weigher, [(AskedLaw(self.entry, variable), law)], np.hstack(columns))


def _repeating(
    seen: Mapping[Entry, tuple[Reach, SeenThere]], u: Sequence[Array], most_work: float
) -> dict[Entry, list[float]]:
    """Wave numbers with which laws of a variable would repeat, the best ones of each entry.

    Args:
        seen: What terms do at entries, and what matters of it.
        u: The variable along each run, (num_samples,).
        most_work: Wave numbers by samples.
    """
    every = np.concatenate(u)
    if not seen or range_of(every) is None:
        return {}
    reach = float(every.max() - every.min())
    steps = np.concatenate([np.abs(np.diff(v)) for v in u])
    fastest = float(np.quantile(steps, SLOW_QUANTILE)) if len(steps) else 0.0
    if not fastest > 0.0:
        return {}
    # a quarter of a period more over the range tells two numbers apart
    spacing = 0.5 * np.pi / reach
    most = min(MOST_NUMBERS, most_work / len(every))
    highest = min(np.pi / fastest, spacing * most)
    numbers = np.arange(2.0 * np.pi * FEWEST_PERIODS / reach, highest, spacing)
    if len(numbers) < 3:
        return {}
    scores: dict[Entry, list[Array]] = {entry: [] for entry in seen}
    for part in np.array_split(numbers, len(numbers) // 200 + 1):  # at once
        waves = _waves(u, part, spacing)
        for entry, (there, known) in seen.items():
            scores[entry].append(known.scores(there.coordinates(waves)))
    best: dict[Entry, list[float]] = {}
    for entry, parts in scores.items():
        score = np.concatenate(parts)
        inner = (score[1:-1] >= score[:-2]) & (score[1:-1] >= score[2:])
        tops = np.flatnonzero(np.concatenate([[True], inner, [True]]))
        best[entry] = [float(numbers[i]) for i in tops[np.argsort(-score[tops])][:PEAKS]]
    return best


def _waves(u: Sequence[Array], numbers: Array, spacing: float) -> list[Array]:
    """Sines of evenly spaced wave numbers, then their cosines, (num_samples, 2 m) for each run."""
    # a product of two exponentials for each, of a coarse and of a fine step
    side = int(np.ceil(np.sqrt(len(numbers))))
    coarse, fine = numbers[0] + spacing * side * np.arange(side), spacing * np.arange(side)
    out = []
    for v in u:
        made = (
            np.exp(1j * np.outer(v, coarse))[:, :, None] * np.exp(1j * np.outer(v, fine))[:, None]
        )
        waves = made.reshape(len(v), -1)[:, : len(numbers)]
        out.append(np.concatenate([waves.imag, waves.real], 1))
    return out


def range_of(u: Array) -> tuple[float, float] | None:
    """Least and largest value of a variable; None where it rests, or has diverged."""
    seen = u[np.isfinite(u)]
    low, high = (float(seen.min()), float(seen.max())) if len(seen) else (0.0, 0.0)
    is_flat = high - low <= ROUNDING * max(abs(low), abs(high), 1e-300)
    return (low, high) if not is_flat and high - low < LARGEST else None


@dataclass(frozen=True, eq=False)
class Weigher:
    """Evidence of further columns beside those of a fit."""

    missing: Array  # whitened record less the simulation at the prior's center, by the slopes, (N,)
    jacobian: Array  # slopes by coordinates that are N(0, 1), (N, n)
    known: Gaussian  # what the recordings tell of these coordinates
    folds: Array  # part that each sample belongs to, (N,)

    @classmethod
    def of(cls, followed: FollowedRecord) -> Weigher:
        """Of simulations that lie on the recordings."""
        j, fit = followed.jacobian, followed.fit
        return cls.of_slopes(followed.missing + j @ fit.x, j, _folds(fit.problem))

    @classmethod
    def of_slopes(cls, missing: Array, j: Array, folds: Array) -> Weigher:
        """Of slopes anywhere; arguments as of the attributes."""
        return cls(missing, j, Gaussian.of(j, missing), folds)

    def gains(self, columns: Array, counts: Sequence[int]) -> Iterator[tuple[float, float] | None]:
        """Nats by which each of several laws is better than none, and the size of its factors.

        Args:
            columns: Slopes by the factors of each, side by side, (N, sum of ``counts``).
            counts: Number of factors of each.

        Yields:
            Nats, and the most probable amplitude; None of a law that does nothing.
        """
        mixed = self.jacobian.T @ columns
        solved = self.known.solve(mixed)
        right = columns.T @ self.missing - solved.T @ self.known.slope
        for first, end in pairwise(np.cumsum([0, *counts]).tolist()):
            own = columns[:, first:end]
            gram = own.T @ own
            power = float(np.sqrt(np.trace(gram) / len(own)))
            if not 0.0 < power < np.inf:
                yield None
                continue
            gram -= mixed[:, first:end].T @ solved[:, first:end]
            nats, amplitude = _average(gram / power**2, right[first:end] / power)
            yield nats, amplitude / power

    def weighed(
        self, columns: Array, counts: Sequence[int]
    ) -> Iterator[tuple[float, float, float, float] | None]:
        """Nats of each law, ``left_out`` of it, and the size of its factors; as ``gains``."""
        parts, before = self._parts
        seen, edges = parts.seen(columns), np.cumsum([0, *counts]).tolist()
        for (first, end), gain in zip(pairwise(edges), self.gains(columns, counts), strict=True):
            if gain is None:
                yield None
                continue
            nats, typical = gain
            grams = parts.grams_of(columns[:, first:end] * typical)
            after = parts.misfit_of([part[:, first:end] * typical for part in seen], grams)
            yield nats, *self._share_out(before, after), typical

    def reduced(self, columns: Array) -> tuple[Array, Array]:
        """Parabola of the misfit over factors of columns, whatever the model's numbers are."""
        cross = self.jacobian.T @ columns
        return self.known.left_to(cross, columns.T @ columns, columns.T @ self.missing)

    def misfit_of(self, columns: Array) -> tuple[Array, Array]:
        """Root and target of what the record tells of factors: |target - root f|^2.

        Args:
            columns: Slopes by factors, (N, k).
        """
        gram, right = self.reduced(columns)
        values, vectors = linalg.eigh(gram)
        kept = values > ROUNDING * values[-1]
        size = np.sqrt(values[kept])
        return size[:, None] * vectors[:, kept].T, (vectors[:, kept].T @ right) / size

    def with_columns(self, columns: Array) -> Weigher:
        """The same beside a law that stands.

        Args:
            columns: Slopes by its factors, which are N(0, 1), (N, k).
        """
        return Weigher.of_slopes(self.missing, np.hstack([self.jacobian, columns]), self.folds)

    def seen_by(self, entry: Reach) -> SeenThere:
        """What matters of it to terms at an entry."""
        root = self.known.whitened(entry.seen(self.jacobian).T)
        told = self.known.whitened(self.known.slope)
        return SeenThere(root, entry.seen(self.missing) - root.T @ told)

    def left_out(self, columns: Array) -> tuple[float, float]:
        """Nats that a law gains on parts of the record it was not fitted to; the share of their
        misfit above the noise.

        What only one part tells, such as its start, is fitted to it with and without the law.

        Args:
            columns: Slopes by factors that are N(0, 1), (N, k).
        """
        parts, before = self._parts
        return self._share_out(
            before, parts.misfit_of(parts.seen(columns), parts.grams_of(columns))
        )

    def _share_out(self, before: float, after: float) -> tuple[float, float]:
        """What ``left_out`` says of misfits without a law and with it."""
        # where the stated noise is too large, what it takes away is all that was missing
        missing = max(before - len(self.missing), before - after, 1.0)
        return 0.5 * (before - after), (before - after) / missing

    @cached_property
    def _parts(self) -> tuple[_Parts, float]:
        """The parts of the record, and their misfit without a law."""
        parts = _Parts.of(self.jacobian, self.missing, self.folds)
        none = np.zeros((len(self.missing), 0))
        return parts, parts.misfit_of(parts.seen(none), parts.grams_of(none))


@dataclass(frozen=True, eq=False)
class _Parts:
    """Parts of the record, each left out in turn: all that is the same for every law.

    Of a part p, G_p = [J, missing, H]' P_p [J, missing, H], where P_p takes out what the parameters
    that only this part tells would follow; no other part fits them. What the rest tells of the
    others and of a law's factors H solves (sum G - G_p + 1) d = (sum G - G_p)[:, missing].
    """

    begins: IntArray  # first row of each part, and the end of the last, (P + 1,)
    # P_p [J, missing] of each part, then the root of what P_p takes out, (n + 1 + num_own,
    # num_rows) each
    known: Sequence[Array]
    grams: Array  # of P_p [J, missing], (P, n + 1, n + 1)
    roots: Array  # inverse Cholesky factors of the rest's gram matrix of J and 1, (P, n, n)

    @classmethod
    def of(cls, jacobian: Array, missing: Array, folds: Array) -> _Parts:
        """Parts of whitened slopes, (N, n), and of what is missing, (N,), by their number, (N,)."""
        begins = np.append(np.flatnonzero(np.diff(folds, prepend=-1)), len(folds))
        count = jacobian.shape[1]
        known, grams = [], []
        for low, high in pairwise(begins.tolist()):
            j = jacobian[low:high]
            others = np.concatenate([jacobian[:low], jacobian[high:]])
            own = ~(others != 0.0).any(0) & (j != 0.0).any(0)
            left = np.column_stack([np.where(own, 0.0, j), missing[low:high]])
            out = Gaussian.of(j[:, own], missing[low:high]).whitened(j[:, own].T)
            taken = out @ left
            grams.append(left.T @ left - taken.T @ taken)
            known.append(np.vstack([left.T - taken.T @ out, out]))
        every = np.array(grams)
        rest = (every.sum(0) - every)[:, :count, :count] + np.eye(count)
        return cls(begins, known, every, np.linalg.inv(np.linalg.cholesky(rest)))

    def seen(self, columns: Array) -> list[Array]:
        """What each part sees of columns (N, K), (n + 1 + num_own, K) each."""
        rows = pairwise(self.begins.tolist())
        return [
            known @ columns[low:high] for known, (low, high) in zip(self.known, rows, strict=True)
        ]

    def grams_of(self, columns: Array) -> Array:
        """Their products in each part, (P, K, K)."""
        rows = pairwise(self.begins.tolist())
        return np.array([columns[low:high].T @ columns[low:high] for low, high in rows])

    def misfit_of(self, seen: Sequence[Array], grams: Array) -> float:
        """Misfit of all parts, each with what the rest tells.

        Args:
            seen: What parts see of the columns of a law, as of ``seen``.
            grams: Their products, as of ``grams_of``.
        """
        n, k = self.roots.shape[1], grams.shape[2]
        mixed = np.array([part[: n + 1] for part in seen])
        own = grams - np.array([part[n + 1 :].T @ part[n + 1 :] for part in seen])
        rest = self.grams.sum(0) - self.grams
        beside = mixed.sum(0) - mixed
        # block elimination of the model's own numbers, which are the same for every law
        u, right = self.roots @ beside[:, :n], self.roots @ rest[:, :n, n:]
        inner = own.sum(0) - own + np.eye(k) - u.transpose(0, 2, 1) @ u
        h = np.linalg.solve(inner, beside[:, n, :, None] - u.transpose(0, 2, 1) @ right)
        d = self.roots.transpose(0, 2, 1) @ (right - u @ h)
        linear = d.transpose(0, 2, 1) @ self.grams[:, :n, n:] + mixed[:, n : n + 1] @ h
        square = d.transpose(0, 2, 1) @ (self.grams[:, :n, :n] @ d + 2.0 * mixed[:, :n] @ h)
        square = square + h.transpose(0, 2, 1) @ own @ h
        return float(np.sum(self.grams[:, n, n] + (square - 2.0 * linear)[:, 0, 0]))


def _average(gram: Array, right: Array) -> tuple[float, float]:
    """Nats of factors by their parabola, averaged over their amplitude; the best one."""
    values, vectors = linalg.eigh(gram)
    values, along = np.maximum(values, 0.0), (vectors.T @ right) ** 2
    squares = np.array(AMPLITUDES)[:, None] ** 2
    nats = 0.5 * np.sum(
        squares * along / (1.0 + squares * values) - np.log1p(squares * values), axis=1
    )
    most = float(nats.max())
    return most + float(np.log(np.mean(np.exp(nats - most)))), AMPLITUDES[int(np.argmax(nats))]


@dataclass(frozen=True, eq=False)
class SeenThere:
    """What terms at one entry can take away, whatever the model's numbers are."""

    root: Array  # takes out what those numbers would follow, (n, num_coordinates)
    missing: Array  # what is missing there, without that, (num_coordinates,)

    def scores(self, terms: Array) -> Array:
        """Misfit that pairs of terms take away, those of a half with those of the other.

        Args:
            terms: Coordinates, (num_coordinates, 2 m).

        Returns:
            (m,).
        """
        (a, b), (c, d) = (np.split(part, 2, axis=1) for part in (terms, self.root @ terms))
        p, q = np.split(terms.T @ self.missing, 2)
        aa, bb, ab = (
            np.einsum("ij,ij->j", x, y) - np.einsum("ij,ij->j", v, w)
            for x, y, v, w in ((a, a, c, c), (b, b, d, d), (a, b, c, d))
        )
        det = np.maximum(aa * bb - ab**2, 1e-12 * aa * bb + 1e-300)
        return np.asarray((bb * p**2 - 2.0 * ab * p * q + aa * q**2) / det)


def _folds(problem: Problem) -> Array:
    """Number of the part that each whitened sample belongs to: its run, or a stretch of it."""
    counts = [int(np.isfinite(run.measured).sum()) for run in problem.runs]
    if len(counts) >= PARTS:
        return np.repeat(np.arange(len(counts)), counts)
    parts = [np.arange(n) * PARTS // max(n, 1) + PARTS * k for k, n in enumerate(counts)]
    return np.concatenate(parts)
