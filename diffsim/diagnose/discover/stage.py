"""The stage between "no cause of the library" and "unknown": laws, from the screen to formulas.

1. Every entry by every variable is weighed beside the plain model and beside the best set of causes
   (``screen``).
2. The best ones are fitted in the simulator, without a form yet, and so are the best pairs of a law
   and a cause of the library (``beside``).
3. Forms are fitted to what the record tells of them (``forms``).
4. The same again beside the best law, while that is worth its price.
5. The best forms become causes like any other, which the search weighs against the library. The
   choice among all that was tried has its price.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import NamedTuple

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.errors import DiffsimError
from diffsim.core.units import NO_UNIT, powers_of, to_si
from diffsim.diagnose.discover.beside import CauseAlong, best_pairs, causes_along
from diffsim.diagnose.discover.follow import follow
from diffsim.diagnose.discover.forms import FORM_PRIOR_SD, Curve, FittedForm, Form, fit_forms
from diffsim.diagnose.discover.screen import ONE_TURN, Candidate, Screen, screen_laws
from diffsim.diagnose.search.fit import Progress
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.diagnose.search.search import has_left_prior
from diffsim.diagnose.search.weak_slopes import SHARES
from diffsim.identify import Fit, Problem
from diffsim.identify.effect import PRIOR_WIDTH, Effect, coordinate_of
from diffsim.identify.effort import KEEP_NATS
from diffsim.identify.fitting import summary
from diffsim.identify.gaussian import Gaussian
from diffsim.identify.law import Entry, Law, Shape
from diffsim.identify.linearization import linearization_at, records_at
from diffsim.identify.setup import LawPort

KEPT = 0.5  # of the nats that slopes promise: below, they hold nowhere near
# simulations of all runs, by their weight, that a law's fit may take, or all that laws may cost: of
# two tanks, a law beside the cause that leaves least had not come half its way in 200
LAW_RECORDS = 200.0
NUM_JUDGING = 2  # laws of a screen whose fits tell whether its slopes hold
NUM_FITTED = 8  # laws of each screen that are fitted in the simulator
ALIKE = 2  # of them at one entry, or of one variable
NUM_PAIRS = 2  # laws of two variables of each round that are fitted in the simulator
TWIN_NATS = 0.01  # between laws that do the same
NUM_FORMS = 2  # of each of these, that the search weighs
SCREEN_SHARE = 0.5  # of what laws may cost, for terms that a screen must simulate
TABLE = "table"  # a form that is no formula
PRODUCT = "size*(u)"  # a form that is the variable itself, times another one where it has one
TABLE_PRICE = 3.0  # nats for each factor of a curve that stands for a formula
FORM_NATS = 12.0  # behind the best form, up to which the simulator decides
# of what a law explains: by so much slopes of bumps are wrong. A resistance over a temperature had
# its line further behind an exponential than those nats, and in the simulator they are one
SLOPES_SHARE = 0.01
NUM_POINTS = 101  # of a curve
BEHIND_NATS = 30.0  # behind the best fitted law: formulas of others are not weighed
MOST_LAWS = (6, 3)  # formulas of each round that the search weighs: so many laws act at once
TURN_SD = 0.02  # of a wave number that is one turn's: as well as scales of angles are known
NEXT_SHARE = 0.1  # of the first law's nats, that one beside it must explain


@dataclass(frozen=True, eq=False)
class FittedLaw:
    """A law without a form, fitted in the simulator."""

    candidate: Candidate  # entry, variable and basis
    fit: Fit  # fit with its factors
    curve: Curve  # the law over its variable
    nats: float  # evidence over the same model without it, at this fit
    forms: tuple[FittedForm, ...]  # forms that it may have, the best first
    left: float = 0.0  # nats that the law without a form leaves
    # name, variable and law of each run, as this run alone tells it
    by_run: tuple[tuple[str, Array, Array], ...] = ()
    num_pairs: int = 0  # laws of two variables, or beside a cause, that it was chosen from; 0: none
    # names of the causes of the library that were fitted with it
    beside: frozenset[str] = frozenset()

    @property
    def reach(self) -> float:
        """Evidence of all that is fitted, of the best form where slopes promise that it fits closer
        than bumps."""
        closer = self.left - self.forms[0].nats if self.forms else 0.0
        return self.fit.nats + max(closer, 0.0)


class Begin(NamedTuple):
    """Where a search begins; a parameter may have the name of an effect."""

    base: Mapping[str, float]  # standardized coordinates of base parameters, by name
    sizes: Mapping[str, float]  # those of the sizes of a set of effects, by name


@dataclass(frozen=True, eq=False)
class FoundLaws:
    """What the stage found."""

    # best law without a form of each entry and variable, the best first
    screened: tuple[Candidate, ...]
    fitted: tuple[FittedLaw, ...]  # the best of them, fitted in the simulator
    laws: tuple[Law, ...]  # formulas that the search shall weigh
    num_tried: int  # entries by variables by bases that were weighed
    # where that search begins: at the formulas of the best law, with the causes of the library
    # beside it, and at one formula of its variable at each other place
    begins: tuple[Begin, ...] = ()
    # names of the causes of the library that laws were fitted beside
    beside: frozenset[str] = frozenset()

    @property
    def most_nats(self) -> float:
        """Evidence of the best laws without a form that need no cause of the library beside them,
        less the price of their choice."""
        alone = (f.fit.nats for f in self.fitted if not f.beside)
        return max(alone, default=-np.inf) - _price(self.num_tried)


def at_data_sheet(plain: Fit) -> list[Fit]:
    """The plain model at its data sheet, where its fit has left that: what is missing has bent the
    model's numbers, so that slopes there promise laws nothing. None where it cannot be simulated.
    """
    problem = plain.problem
    if not has_left_prior(plain):
        return []
    x = np.clip(np.zeros(len(plain.x)), *problem.bounds)
    try:
        at = linearization_at(problem, x)
    except DiffsimError:
        return []
    missing = problem.residual_of(at.record)
    slopes = problem.whiten_all(at.columns) * problem.stretch(x)
    return [summary(problem, x, missing, slopes, "converged", "the data sheet, not fitted", 1)]


def find_laws(
    fits: Sequence[Fit],
    port: LawPort,
    progress: Progress,
    most_steps: float = np.inf,
    library: Sequence[Effect] = (),
) -> FoundLaws:
    """Laws that explain what fits leave.

    Args:
        fits: The plain model's fit, before it the model at its data sheet where the fit has left
            it, after it that of the best set of causes where there is one.
        most_steps: Weighted steps after which no further law is fitted in the simulator.
        library: Causes that may act beside a law.
    """
    tally = fits[0].problem.model.simulations
    begun = tally.steps

    def may_fit() -> bool:
        return tally.steps - begun <= most_steps

    every: list[Candidate] = []
    num_tried = 0
    rounds: list[list[FittedLaw]] = []
    for fit in fits:
        every_fit = (f for fitted in rounds for f in fitted)
        if any(f.fit.nats > fit.nats for f in every_fit if not f.beside):
            break  # laws explain more than the plain model or the best set of causes does
        if not may_fit():
            break
        screened = _screen(fit, port, progress, most_steps)
        num_tried += screened.num_tried
        every += screened.screen.found
        table = Table(library, most_steps)
        for k, fitted in enumerate(_rounds(screened, fit, port, may_fit, table)):
            rounds = [*rounds, []] if len(rounds) == k else rounds
            rounds[k] += fitted
    laws: list[Law] = []
    for most, fitted in zip(MOST_LAWS, rounds, strict=False):
        before = len(laws)
        for f in _near_best(fitted):
            laws += _laws_of(f, _price(num_tried + f.num_pairs))
        laws = _without_twins(laws)[: before + most]
    laws = [replace(law, name=_name(laws, k)) for k, law in enumerate(laws)]
    fitted = [f for of_round in rounds for f in of_round]
    first = sorted((f for of_round in rounds[:1] for f in of_round), key=lambda f: -f.fit.nats)
    best = max(fitted, key=lambda f: f.fit.nats, default=None)
    begins = _begins_at_each([best, *first], laws) if best is not None else ()
    beside = frozenset(name for f in fitted for name in f.beside)
    return FoundLaws(_best_of_each(every), tuple(fitted), tuple(laws), num_tried, begins, beside)


def _begins_at_each(fitted: Sequence[FittedLaw], laws: Sequence[Law]) -> tuple[Begin, ...]:
    """Where a search begins: at all formulas of the first law, and one of each other law of its
    variable: elsewhere it may do nearly the same, which slopes from afar do not show."""
    begins: dict[frozenset[str], Begin] = {}
    variables = [f.candidate.variable for f in fitted]
    names = [{part.name for part in v.parts or (v,)} for v in variables]
    of = [f for f, own in zip(fitted, names, strict=True) if own & names[0]]
    for k, f in enumerate(of):
        for begin_at in list(_begins_of(f, laws))[: 1 if k else None]:
            begins.setdefault(frozenset(begin_at.sizes), begin_at)
    return tuple(begins.values())


def _begins_of(fitted: FittedLaw, laws: Sequence[Law]) -> Iterator[Begin]:
    """Where a search with formulas of a fitted law and the causes beside it begins."""
    problem, of = fitted.fit.problem, fitted.candidate
    count, num_base = len(of.basis.terms), problem.num_base
    own = list(zip(problem.names[:-count], fitted.fit.x[:-count].tolist(), strict=True))
    for law in laws:
        if law.entry == of.entry and law.variable == of.variable:
            size = law.sign * float(coordinate_of(np.array(1.0 / PRIOR_WIDTH)))
            yield Begin(dict(own[:num_base]), {**dict(own[num_base:]), law.name: size})


def _price(num_tried: int) -> float:
    """What the choice among all that was tried costs [nats]."""
    return float(np.log(max(num_tried, 1)))


def _near_best(fitted: Sequence[FittedLaw]) -> list[FittedLaw]:
    """Laws about as good as the best by what the simulator says, or by what slopes promise of a
    form, and of a memory what it remembers, which a cause of the library may make as good; those
    first that are first by either."""
    by_fit = sorted(fitted, key=lambda f: -f.fit.nats)
    by_form = sorted(fitted, key=lambda f: -f.reach)
    near_by_fit = [f for f in by_fit if f.fit.nats > by_fit[0].fit.nats - BEHIND_NATS]
    near_by_form = [f for f in by_form if f.reach > by_form[0].reach - BEHIND_NATS]
    near = {id(f): f for f in (*near_by_fit, *near_by_form)}
    best = [f.candidate for f in near.values()]
    near |= {id(f): f for f in fitted if any(_is_plain_of(f.candidate, c) for c in best)}
    return sorted(near.values(), key=lambda f: (min(by_fit.index(f), by_form.index(f)), -f.reach))


@dataclass(frozen=True, eq=False)
class _ScreenWithFit:
    """A screen, and its best law fitted in the simulator: slopes promise, fits decide."""

    screen: Screen  # all laws weighed
    candidate: Candidate | None  # the best law that was fitted; None where none was
    law: FittedLaw | None  # its fit; None where it cannot be fitted
    num_tried: int  # entries by variables by bases that were weighed until this screen held
    kept: float = 0.0  # nats that the best law keeps in the simulator

    @property
    def keeps_promise(self) -> bool:
        """Whether they are about as many as slopes promise."""
        return self.candidate is None or self.kept >= KEPT * self.candidate.nats


def _screen(fit: Fit, port: LawPort, progress: Progress, most_steps: float) -> _ScreenWithFit:
    """All laws weighed along the recordings; where the best of them keeps little of what it
    promises there, along the simulations as fitted, too: the screen that keeps more."""
    most_of_screen = SCREEN_SHARE * most_steps
    screen = screen_laws(follow(fit, port), port, progress, most_of_screen)
    led = _with_best_fitted(screen, fit, port, most_steps)
    is_led = any(response.shape[1] for response in screen.followed.responses)
    if led.keeps_promise or not is_led:
        return led
    along_fit = screen_laws(follow(fit, port, max_steps=0), port, progress, most_of_screen)
    as_fitted = _with_best_fitted(along_fit, fit, port, most_steps)
    better = as_fitted if as_fitted.kept > led.kept else led
    return replace(better, num_tried=led.num_tried + as_fitted.num_tried)


def _with_best_fitted(screen: Screen, fit: Fit, port: LawPort, most_steps: float) -> _ScreenWithFit:
    """The screen with the first of its best laws that keeps what it promises, or the one that keeps
    most: slopes of one law may hold nowhere near, such as of a mass whose frequency is off."""
    tried = [_ScreenWithFit(screen, None, None, sum(len(c.basis.tried) for c in screen.found))]
    for candidate in _choose(screen.holding, KEEP_NATS)[:NUM_JUDGING]:
        law = _fit_law(screen, fit, candidate, port, (), most_steps)
        kept = 0.0 if law is None else law.nats
        tried.append(replace(tried[0], candidate=candidate, law=law, kept=kept))
        if tried[-1].keeps_promise:
            return tried[-1]
    return max(tried[1:] or tried, key=lambda one: one.kept)


def _rounds(
    screened: _ScreenWithFit,
    fit: Fit,
    port: LawPort,
    may_fit: Callable[[], bool],
    table: Table | None = None,
) -> Iterator[list[FittedLaw]]:
    """Fitted laws beside a fit, or beside it and a cause of the library; then beside the best of
    them, while that is worth its price."""
    screen = screened.screen
    standing: tuple[FittedLaw, ...] = ()
    first, most_steps = 0.0, np.inf if table is None else table.most_steps
    for _ in MOST_LAWS:
        fitted: list[FittedLaw] = []
        least = max(KEEP_NATS + float(np.log(max(len(screen.found), 1))), NEXT_SHARE * first)
        for candidate in _choose(screen.holding, least):
            # along the recordings nats are others than in the simulator: like is held against like
            best = max((min(f.nats, f.candidate.nats) for f in fitted), default=0.0)
            is_fitted = candidate is screened.candidate  # it costs nothing more
            if candidate.nats < KEPT * best or not (is_fitted or may_fit()):
                continue
            law = screened.law
            if not is_fitted:
                law = _fit_law(screen, fit, candidate, port, standing, most_steps)
            if law is not None and law.nats > least:
                fitted.append(law)
        beside = []
        if table is not None and not standing:  # what one law explains alone is no pair's
            left = min((fit, *(f.fit for f in fitted)), key=lambda f: f.chi2)
            price = _price(len(screen.found) * len(table.library))
            if 0.5 * (left.chi2 - left.num_samples) > KEEP_NATS + price:  # else no cause could pay
                beside = _fit_beside(screen, fit, port, table, may_fit)
        most = max((f.nats for f in fitted), default=0.0) + KEEP_NATS
        together = [law for law in beside if law.nats > most + _price(law.num_pairs)]
        if not fitted:
            if together:
                yield together
            return
        screen, pairs = _fit_pairs(screen, fit, fitted, port, standing, most_steps)
        fitted += pairs
        yield [*fitted, *together]
        law = max(fitted, key=lambda f: f.nats)
        first = first or law.nats
        standing, fit = (*standing, law), law.fit
        screen = screen.with_law(law.candidate)


def _fit_pairs(
    screen: Screen,
    fit: Fit,
    fitted: Sequence[FittedLaw],
    port: LawPort,
    standing: Sequence[FittedLaw],
    most_steps: float,
) -> tuple[Screen, list[FittedLaw]]:
    """Laws multiplied by another variable, where fitted laws or pushes enter, if two explain more
    than any of these by the price of the choice; none where one leaves noise: a line times a
    constant is a line, too, which bumps over the other variable may follow closer than those over
    its own."""
    best = max(fitted, key=lambda f: f.nats)
    if 0.5 * (best.fit.chi2 - best.fit.num_samples) < KEEP_NATS:
        return screen, []
    # a product pushes where none of its variables alone seems to
    pushed = (c.entry for c in screen.found if c.entry.kind in ("rate", "force"))
    entries = dict.fromkeys((*(f.candidate.entry for f in fitted), *pushed))
    screen, pairs, count = screen.with_pairs(entries)
    least = best.nats + KEEP_NATS + _price(count)
    promised = max(f.candidate.nats for f in fitted) + KEEP_NATS
    better: list[Candidate] = []
    for c in (c for c in pairs if c.nats > promised and c.gained > KEEP_NATS):
        # of variables that are lines of each other, such as a current and its torque, one is fitted
        if not any(abs(c.nats - other.nats) < TWIN_NATS for other in better):
            better.append(c)
    made = [_fit_law(screen, fit, c, port, standing, most_steps) for c in better[:NUM_PAIRS]]
    kept = [law for law in made if law is not None and law.nats > least]
    return screen, [replace(law, num_pairs=count) for law in kept]


@dataclass(frozen=True)
class Table:
    """Causes of the library that stand in one table with laws."""

    library: Sequence[Effect]
    most_steps: float  # weighted steps that laws may cost, their columns a share of it


def _fit_beside(
    screen: Screen, fit: Fit, port: LawPort, table: Table, may_fit: Callable[[], bool]
) -> list[FittedLaw]:
    """Laws beside a cause of the library, as one table of both ranks them, while steps are left."""
    if not may_fit():
        return []
    causes = causes_along(screen.followed, table.library, SCREEN_SHARE * table.most_steps)
    pairs, count = best_pairs(screen, causes)
    out = []
    for pair in takewhile(lambda _: may_fit(), pairs):
        law = _fit_law(screen, fit, pair.law, port, (), table.most_steps, pair.cause)
        if law is not None:
            out.append(replace(law, num_pairs=count))
    return out


def _name(laws: Sequence[Law], k: int) -> str:
    """A plain name such as "law_of_angle_at_shaft", numbered where several share it."""
    names = [f"law_of_{law.variable.name}_at_{law.entry.target}" for law in laws[: k + 1]]
    plain = [re.sub(r"\W+", "_", name).strip("_") for name in names]
    before = plain.count(plain[k]) - 1
    return plain[k] if before == 0 else f"{plain[k]}_{before + 1}"


def _without_twins(laws: Sequence[Law]) -> list[Law]:
    """Laws of different entries, variables or formulas: several fits may ask for one. A product of
    two variables stands for what multiplies the one by a law of the other, too."""
    first: dict[tuple[str, str, str, str], tuple[Law, frozenset[str]]] = {}
    products: dict[frozenset[str], str] = {}
    for law in laws:
        variable, times = law.variable, law.variable.times
        where = law.entry.kind, law.entry.target
        pair = frozenset([*where, variable.own_name, "" if times is None else times.name])
        kind = law.term if law.form != "periodic" else law.form
        first.setdefault((*where, variable.name, kind), (law, pair))
        if times is not None and law.term == PRODUCT:
            products.setdefault(pair, variable.name)
    return [law for law, pair in first.values() if products.get(pair) in (None, law.variable.name)]


def _best_of_each(every: Sequence[Candidate]) -> tuple[Candidate, ...]:
    best: dict[tuple[str, str, str], Candidate] = {}
    for c in sorted(every, key=lambda c: c.rank):
        best.setdefault((c.entry.kind, c.entry.target, c.variable.name), c)
    return tuple(best.values())


def _choose(found: Sequence[Candidate], least: float) -> list[Candidate]:
    """The best laws that hold for what was left out, of different entries and variables."""
    kept = [c for c in found if c.nats > least and c.gained > KEEP_NATS]
    plain: dict[Entry, float] = {}
    for c in kept:
        if not c.variable.memory:
            plain[c.entry] = max(plain.get(c.entry, 0.0), c.score)
    # a memory that lasts or is over at once is what it remembers
    kept = [
        c for c in kept if not c.variable.memory or c.score > plain.get(c.entry, 0.0) + KEEP_NATS
    ]
    chosen: list[Candidate] = []
    best = _best_of_each(kept)
    for c in best:
        at = sum(c.entry == other.entry for other in chosen)
        on = sum(c.variable.name == other.variable.name for other in chosen)
        # twins are one law to these recordings: of one variable, by entries in proportion; or at
        # one entry, of variables in proportion, such as a duty and its voltage
        alike = (o for o in chosen if abs(c.nats - o.nats) < TWIN_NATS)
        is_twin = any(
            (c.is_plain and o.is_plain)
            if c.entry == o.entry
            else (c.variable == o.variable and c.basis == o.basis)
            for o in alike
        )
        if at < ALIKE and on < ALIKE and not is_twin:
            told = [c, *(p for p in best if _is_plain_of(p, c))]
            same = {(one.entry, one.variable.name) for one in told}
            turns = [
                t for t in kept if t.basis.wave == ONE_TURN and (t.entry, t.variable.name) in same
            ]
            chosen += [one for one in dict.fromkeys((*told, *turns)) if one not in chosen]
    return chosen[:NUM_FITTED]


def _is_plain_of(plain: Candidate, c: Candidate) -> bool:
    """Whether a law is of what another one has the memory of: a memory may stand for it where
    bumps are too wide to tell."""
    is_memory = c.variable.memory == "relaxation" and not plain.variable.memory
    return is_memory and plain.entry == c.entry and plain.variable.name == c.variable.of


def _fit_law(
    screen: Screen,
    before: Fit,
    candidate: Candidate,
    port: LawPort,
    standing: Sequence[FittedLaw],
    most_steps: float,
    cause: CauseAlong | None = None,
) -> FittedLaw | None:
    """A law fitted in the simulator from what the recordings tell, beside a cause of the library
    where one is given; None where it cannot be."""
    variable = candidate.variable
    size = candidate.typical / PRIOR_WIDTH
    name = f"law {len(standing)}"
    effect = port.terms(candidate.entry, variable, candidate.basis.terms, name, size)
    beside = () if cause is None else (cause.effect,)
    problem = replace(before.problem, effects=(*before.problem.effects, *beside, effect))
    laws, followed = (*(f.candidate for f in standing), candidate), screen.followed
    try:
        *others, own = (screen.columns_of(c, c.basis.values) * c.typical for c in laws)
        others += [] if cause is None else [cause.columns]
        every = np.hstack([followed.jacobian, *others, own])
        right = followed.missing + followed.jacobian @ followed.fit.x
        asked = Gaussian.of(every, right).mean
        start = linearization_at(problem, _begin(problem, before, asked))
        most = max(LAW_RECORDS * problem.cost(), most_steps)
        until = problem.model.simulations.steps + most
        ended, _ = gauss_newton(problem, start, until=until)
    except DiffsimError:
        return None
    u = np.concatenate(list(screen.values(candidate)))
    curve = _curve(ended, candidate, u[np.isfinite(u)], len(effect.components))
    nats = ended.nats - before.nats
    by_run = tuple(_by_run(screen, candidate, every, right, asked))
    names = frozenset(e.name for e in problem.effects if e.family != "law")
    law = FittedLaw(candidate, ended, curve, nats, (), 0.0, by_run, beside=names)
    if candidate.basis.wave:
        return law
    told = screen.misfit_of(candidate)
    left = told.left_by(candidate.basis.values(told.u))
    forms = [] if cause is not None else fit_forms(told)
    # more than all that the fit leaves: such slopes do not lead there, nor do they know a cause;
    # where no formula is as good as the bumps by them, those at the fit are asked, too
    best = min((f.nats for f in forms), default=np.inf)
    if left > 0.5 * ended.chi2 or best - left > TABLE_PRICE * len(candidate.basis.terms):
        forms, left = fit_forms(screen.misfit_at(ended, candidate, curve)), 0.0
    return replace(law, forms=tuple(forms), left=left)


def _begin(problem: Problem, before: Fit, asked: Array) -> Array:
    """Where a fit with a law begins, in standardized coordinates: at the part of the way from the
    fit without it, to where slopes ask it to go, that lowers the cost most."""
    stays = np.concatenate([before.x, np.zeros(len(asked) - len(before.x))])
    way = asked - problem.scaled(stays)
    points = [problem.standardized(problem.scaled(stays) + part * way) for part in SHARES]
    points = np.clip([*points, stays], *problem.bounds)
    costs = []
    with np.errstate(over="ignore", invalid="ignore"):
        for x, record in zip(points, records_at(problem, points), strict=True):
            r = problem.residual_of(record)
            costs.append(float(r @ r + x @ x))
    return points[int(np.nanargmin(costs))]


def _by_run(
    screen: Screen, law: Candidate, every: Array, right: Array, asked: Array
) -> Iterator[tuple[str, Array, Array]]:
    """The last law as each run alone tells it beside all else that the recordings ask for."""
    count = len(law.basis.terms)
    left = right - every[:, :-count] @ asked[:-count]
    begins = 0
    for run, u in zip(screen.followed.fit.problem.runs, screen.values(law), strict=True):
        rows = slice(begins, begins := begins + int(np.isfinite(run.measured).sum()))
        factors = Gaussian.of(every[rows, -count:], left[rows]).mean
        points = np.linspace(float(np.nanmin(u)), float(np.nanmax(u)), NUM_POINTS)
        yield run.name, points, law.basis.values(points) @ factors * law.typical


def _curve(fit: Fit, candidate: Candidate, u: Array, count: int) -> Curve:
    low, high = float(u.min()), float(u.max())
    points = np.linspace(low, high, NUM_POINTS)
    basis = candidate.basis.values(points)
    unit = fit.problem.size_units[-count:] * fit.problem.stretch(fit.x)[-count:]
    names = list(fit.problem.names)[-count:]
    factors = np.array([fit.values[n] for n in names])
    covariance = fit.covariance[-count:, -count:] * np.outer(unit, unit)
    return Curve(points, basis @ factors, basis, factors, covariance)


def _laws_of(fitted: FittedLaw, price: float) -> list[Law]:
    c = fitted.candidate
    memory = {
        name: Shape(value, 0.7 * value, c.variable.number_units.get(name, "-"), lower=0.05 * value)
        for name, value in c.variable.numbers.items()
    }
    if c.basis.wave:
        return [_repeating(fitted, price, memory)]
    best = fitted.forms[0].nats if fitted.forms else np.inf
    # by slopes of bumps a form is told as closely as bumps follow it: there the simulator decides
    near = FORM_NATS if fitted.left > 0.0 else np.inf
    kept = [f for f in fitted.forms if f.nats - best < near][:NUM_FORMS]
    # slopes of bumps tell a line from a threshold by their own error: the simplest is weighed, too
    error = FORM_NATS + SLOPES_SHARE * max(fitted.nats, 0.0)
    close = (f for f in fitted.forms if f.nats - best < error)
    simplest = min(close, key=lambda f: (len(f.numbers), f.form.name != "line"), default=None)
    if simplest is not None and simplest not in kept:
        is_simpler = all(len(f.numbers) > len(simplest.numbers) for f in kept)
        is_close = is_simpler and simplest.nats - best < FORM_NATS
        kept[1 if is_close else NUM_FORMS :] = [simplest]
    laws = [_make_law(fitted, f, price + float(np.log(len(fitted.forms))), memory) for f in kept]
    if best - fitted.left <= TABLE_PRICE * len(c.basis.terms):
        return laws
    # no formula is nearly as good as the curve itself; but what else is missing bends that
    return [_make_table(fitted, price, memory), *laws]


def _make_table(fitted: FittedLaw, price: float, memory: dict[str, Shape]) -> Law:
    """The curve itself, whose height is fitted."""
    c, curve = fitted.candidate, fitted.curve
    height = float(np.abs(curve.values).max())
    parts = [
        f"{a / height:.6g}*{term}" for a, term in zip(curve.factors, c.basis.terms, strict=True)
    ]
    term = f"size*({' + '.join(parts)})"
    price += TABLE_PRICE * len(parts)
    return Law("law", c.entry, c.variable, TABLE, term, height, c.entry.unit, memory, price)


def _make_law(fitted: FittedLaw, form: FittedForm, price: float, memory: dict[str, Shape]) -> Law:
    c = fitted.candidate
    shapes = {
        name: Shape(value, max(FORM_PRIOR_SD * sd, 0.05 * abs(value) + 1e-12), "-")
        for name, (value, sd) in form.numbers.items()
    }
    return Law(
        "law",
        c.entry,
        c.variable,
        form.form.name,
        form.term,
        max(abs(form.size), 1e-300),
        _unit_of_size(c, form.form),
        {**shapes, **memory},
        price,
        form.form.signed,
        float(np.sign(form.size)) or 1.0,
    )


def _unit_of_size(c: Candidate, form: Form) -> str:
    """Unit of a form's size; that of the entry where an exponent is fitted, too."""
    if form.scales == ("-",):
        return c.entry.unit
    out = "1" if c.entry.unit == NO_UNIT else c.entry.unit
    times = () if c.variable.times is None else ((c.variable.times.unit, 1.0),)
    try:
        for unit, power in ((c.variable.unit, form.power), *times):
            for name, own in () if unit == NO_UNIT or not power else powers_of(unit).items():
                raised = "" if abs(own * power) == 1.0 else f"^{abs(own * power):g}"
                out += f"{'/' if own * power > 0.0 else ' '}{name}{raised}"
        return c.entry.unit if out in ("1", c.entry.unit) else to_si(out).unit
    except ValueError:  # a unit of the user's own, which nobody else can put together
        return c.entry.unit


def _repeating(fitted: FittedLaw, price: float, memory: dict[str, Shape]) -> Law:
    """A sine with its phase, about the wave number that the screen found."""
    c, (a, b) = fitted.candidate, fitted.curve.factors
    k, reach = c.basis.wave, float(fitted.curve.u[-1] - fitted.curve.u[0])
    phase = float(np.arctan2(b, a))
    sd = TURN_SD if k == ONE_TURN else np.pi / reach
    shapes = {
        "wave_number": Shape(k, sd),
        "phase": Shape(phase, 1.0, "rad"),
    }
    size = max(float(np.hypot(a, b)), 1e-300)
    term = "size*sin(wave_number*u + phase)"
    return Law(
        "law",
        c.entry,
        c.variable,
        "periodic",
        term,
        size,
        c.entry.unit,
        {**shapes, **memory},
        price,
    )
