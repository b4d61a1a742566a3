"""The stage between "no cause of the library" and "unknown": laws, from the screen to formulas.

1. Every entry by every variable is weighed beside the plain model and beside the best set of causes
   (``screen``).
2. The best ones are fitted in the simulator, without a form yet.
3. Forms are fitted to what that tells (``forms``).
4. The best forms become causes like any other, which the search weighs against the library. The
   choice among all that was tried has its price.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from diffsim.core.errors import DiffsimError
from diffsim.diagnose.discover.follow import FollowedRecord, follow
from diffsim.diagnose.discover.forms import WIDE, Curve, FittedForm, fit_forms
from diffsim.diagnose.discover.screen import Candidate, bumps, screen_laws
from diffsim.diagnose.search.evidence import KEEP_NATS
from diffsim.diagnose.search.fit import Progress
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import Fit, Problem
from diffsim.identify.effect import PRIOR_WIDTH
from diffsim.identify.law import Entry, Law, Shape
from diffsim.identify.linearization import linearization_at
from diffsim.identify.setup import LawPort

Array = NDArray[np.float64]
NUM_FITTED = 8  # laws of each screen that are fitted in the simulator
ALIKE = 2  # of them at one entry, or of one variable
TWIN_NATS = 0.01  # between laws that do the same
NUM_FORMS = 2  # of each of these, that the search weighs
SCREEN_SHARE = 0.5  # of what laws may cost, for terms that a screen must simulate
TABLE = "table"  # a form that is no formula
TABLE_PRICE = 3.0  # nats for each factor of a curve that stands for a formula
FORM_NATS = 12.0  # behind the best form, up to which the simulator decides
NUM_POINTS = 101  # of a curve
BEHIND_NATS = 30.0  # behind the best fitted law: formulas of others are not weighed
MOST_LAWS = 8  # formulas that the search weighs


@dataclass(frozen=True, eq=False)
class FittedLaw:
    """A law without a form, fitted in the simulator.

    Attributes:
        candidate: Entry, variable and basis.
        fit: Fit with its factors.
        curve: The law over its variable.
        nats: Evidence over the same model without it, at this fit.
        forms: Forms that it may have, the best first.
    """

    candidate: Candidate
    fit: Fit
    curve: Curve
    nats: float
    forms: tuple[FittedForm, ...]


@dataclass(frozen=True, eq=False)
class FoundLaws:
    """What the stage found.

    Attributes:
        screened: Best law without a form of each entry and variable, the best first.
        fitted: The best of them, fitted in the simulator.
        laws: Formulas that the search shall weigh.
        num_tried: Entries by variables by bases that were weighed.
    """

    screened: tuple[Candidate, ...]
    fitted: tuple[FittedLaw, ...]
    laws: tuple[Law, ...]
    num_tried: int


def find_laws(
    fits: Sequence[Fit], port: LawPort, progress: Progress, most_steps: float = np.inf
) -> FoundLaws:
    """Laws that explain what fits leave.

    Args:
        fits: The plain model's fit, then that of the best set of causes where there is one.
        port: What the system offers to laws.
        progress: Receives stage, share done and message.
        most_steps: Weighted steps after which no further law is fitted in the simulator.
    """
    tally = fits[0].problem.model.simulations
    begun = tally.steps
    every: list[Candidate] = []
    fitted: list[FittedLaw] = []
    for fit in fits:
        if fitted and max(_nats(f.fit) for f in fitted) > _nats(fit):
            break  # a law explains more than the best set of causes
        if tally.steps - begun > most_steps:
            break
        followed = follow(fit, port)
        found = screen_laws(followed, port, progress, SCREEN_SHARE * most_steps)
        every += found
        for candidate in _choose(found):
            if fitted and tally.steps - begun > most_steps:
                break
            law = _fit_law(followed, candidate, port)
            if law is not None:
                fitted.append(law)
    num_tried = max(len(every), 1)
    price = float(np.log(num_tried))
    # of several fits: what is said of the record with all that stands beside the law
    fitted.sort(key=lambda f: -_nats(f.fit))
    near = [f for f in fitted if _nats(f.fit) > _nats(fitted[0].fit) - BEHIND_NATS]
    laws = _without_twins([law for f in near for law in _laws_of(f, price)])[:MOST_LAWS]
    laws = [replace(law, name=_name(laws, k)) for k, law in enumerate(laws)]
    return FoundLaws(_best_of_each(every), tuple(fitted), tuple(laws), num_tried)


def _name(laws: Sequence[Law], k: int) -> str:
    """A plain name such as "law_of_angle_at_shaft", numbered where several share it."""
    names = [f"law_of_{law.variable.name}_at_{law.entry.target}" for law in laws[: k + 1]]
    plain = [re.sub(r"\W+", "_", name).strip("_") for name in names]
    before = plain.count(plain[k]) - 1
    return plain[k] if before == 0 else f"{plain[k]}_{before + 1}"


def _without_twins(laws: Sequence[Law]) -> list[Law]:
    """Laws of different entries, variables or formulas: several fits may ask for one."""
    first: dict[tuple[str, str, str, str], Law] = {}
    for law in laws:
        kind = law.term if law.form != "periodic" else law.form
        first.setdefault((law.entry.kind, law.entry.target, law.variable.name, kind), law)
    return list(first.values())


def _best_of_each(every: Sequence[Candidate]) -> tuple[Candidate, ...]:
    best: dict[tuple[str, str, str], Candidate] = {}
    for c in sorted(every, key=lambda c: -c.score):
        best.setdefault((c.entry.kind, c.entry.target, c.variable.name), c)
    return tuple(best.values())


def _choose(found: Sequence[Candidate]) -> list[Candidate]:
    """The best laws that hold for what was left out, of different entries and variables."""
    price = float(np.log(max(len(found), 1)))
    kept = [c for c in found if c.nats > KEEP_NATS + price and c.gained > KEEP_NATS]
    plain: dict[Entry, float] = {}
    for c in kept:
        if not c.variable.memory:
            plain[c.entry] = max(plain.get(c.entry, 0.0), c.score)
    # a memory that lasts or is over at once is what it remembers
    kept = [
        c for c in kept if not c.variable.memory or c.score > plain.get(c.entry, 0.0) + KEEP_NATS
    ]
    chosen: list[Candidate] = []
    for c in _best_of_each(kept):
        at = sum(c.entry == other.entry for other in chosen)
        on = sum(c.variable.name == other.variable.name for other in chosen)
        if at < ALIKE and on < ALIKE and not any(_is_twin(c, other) for other in chosen):
            chosen.append(c)
    return chosen[:NUM_FITTED]


def _is_twin(c: Candidate, other: Candidate) -> bool:
    """Whether two laws are one to these recordings: of one variable, by entries in proportion."""
    is_close = abs(c.nats - other.nats) < TWIN_NATS
    return c.variable == other.variable and c.basis == other.basis and is_close


def _fit_law(followed: FollowedRecord, candidate: Candidate, port: LawPort) -> FittedLaw | None:
    """A law fitted in the simulator from what the recordings tell; None where it cannot be."""
    fit = followed.fit
    variable = candidate.variable
    if not candidate.basis.wave:  # a trend says where, not how
        candidate = replace(candidate, basis=bumps(*candidate.basis.reach))
    effect = port.terms(
        candidate.entry, variable, candidate.basis.terms, "law", candidate.typical / PRIOR_WIDTH
    )
    problem = replace(fit.problem, effects=(*fit.problem.effects, effect))
    try:
        start = _start(followed, candidate, port, problem)
        ended, _ = gauss_newton(problem, linearization_at(problem, start))
        u = np.concatenate(port.courses(problem, ended.x, [variable]))[:, 0]
    except DiffsimError:
        return None
    curve = _curve(ended, candidate, u[np.isfinite(u)], len(effect.components))
    nats = _nats(ended) - _nats(fit)
    told = _with_free_level(curve) if candidate.entry.kind == "number" else curve
    forms = () if candidate.basis.wave else tuple(fit_forms(told))
    return FittedLaw(candidate, ended, curve, nats, forms)


def _start(
    followed: FollowedRecord, candidate: Candidate, port: LawPort, problem: Problem
) -> Array:
    """Coordinates that the recordings ask for, by the slopes along them."""
    j, x = followed.jacobian, followed.fit.x
    gains = followed.gains(port, candidate.entry)
    if gains is None:
        columns = followed.simulated(problem.effects[-1])
    else:
        u = [c[:, 0] for c in followed.courses(port, [candidate.variable])]
        columns = followed.columns_of(gains, [candidate.basis.values(v) for v in u])
    every = np.hstack([j, columns * candidate.typical])
    right = followed.missing + j @ x
    found = linalg.solve(every.T @ every + np.eye(every.shape[1]), every.T @ right, assume_a="pos")
    low, high = problem.bounds
    return np.clip(problem.standardized(found), low, high)


def _nats(fit: Fit) -> float:
    """Laplace evidence of a fit."""
    gram = fit.jacobian.T @ fit.jacobian + np.eye(fit.jacobian.shape[1])
    return -0.5 * (fit.chi2 + fit.prior) - 0.5 * float(np.linalg.slogdet(gram)[1])


def _curve(fit: Fit, candidate: Candidate, u: Array, count: int) -> Curve:
    low, high = float(u.min()), float(u.max())
    points = np.linspace(low, high, NUM_POINTS)
    basis = candidate.basis.values(points)
    unit = fit.problem.size_units[-count:] * fit.problem.stretch(fit.x)[-count:]
    names = list(fit.problem.names)[-count:]
    factors = np.array([fit.values[n] for n in names])
    covariance = fit.covariance[-count:, -count:] * np.outer(unit, unit)
    return Curve(points, basis @ factors, basis, factors, covariance)


def _with_free_level(curve: Curve) -> Curve:
    """A curve whose level says nothing: the number's own value holds it, whatever it is."""
    level = linalg.pinv(curve.basis) @ np.ones(len(curve.u))
    return replace(curve, covariance=curve.covariance + np.outer(level, level))


def _laws_of(fitted: FittedLaw, price: float) -> list[Law]:
    c = fitted.candidate
    memory = {
        name: Shape(value, 0.7 * value, c.variable.number_units.get(name, "-"), lower=0.05 * value)
        for name, value in c.variable.numbers.items()
    }
    if c.basis.wave:
        return [_repeating(fitted, price, memory)]
    best = fitted.forms[0].nats if fitted.forms else 0.0
    kept = [f for f in fitted.forms if f.nats - best < FORM_NATS][:NUM_FORMS]
    laws = [_make_law(fitted, f, price + float(np.log(len(fitted.forms))), memory) for f in kept]
    if best <= TABLE_PRICE * len(c.basis.terms):
        return laws
    # no formula is nearly as good as the curve itself; but a memory of another length bends that
    return [_make_table(fitted, price, memory), *(laws if memory else ())]


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
        name: Shape(value, max(WIDE * sd, 0.05 * abs(value) + 1e-12), "-")
        for name, (value, sd) in form.numbers.items()
    }
    return Law(
        "law",
        c.entry,
        c.variable,
        form.form.name,
        form.term,
        max(abs(form.size), 1e-300),
        c.entry.unit,
        {**shapes, **memory},
        price,
    )


def _repeating(fitted: FittedLaw, price: float, memory: dict[str, Shape]) -> Law:
    """A sine with its phase, about the wave number that the screen found."""
    c, (a, b) = fitted.candidate, fitted.curve.factors
    k, reach = c.basis.wave, float(fitted.curve.u[-1] - fitted.curve.u[0])
    phase = float(np.arctan2(b, a))
    shapes = {
        "wave_number": Shape(k, np.pi / reach),
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
