"""What may stand in place of a named cause: the form of a stronger one, or a wrong data sheet.

No law is exact. Dry friction that is right to a few percent leaves a misfit of that size, and
whatever else acts there takes it up, with any evidence that long records lend it. So a weak cause
is certain only where it stands out of what a strong one's form may be wrong by: within a family,
whose members are laws of one thing, as a whole; in another family where it moves no sample by more
than the noise. Where numerical settings could not be refined as far as the answer asks, it must
stand out of what they change, too.

Data sheets have normal priors. Seven standard deviations cost 25 nats, with which any cause is
credited that takes them up: of a tube with a narrow bore a leak behind it is named. So each set
without one of its members is weighed once more with the prior of one pulled parameter ten times as
wide, at the price of one more family. Where several causes stand in for one tube together, none of
them can be left out alone: the plain model is weighed so, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.errors import DiffsimError
from diffsim.diagnose.checks.numerics import (
    NUMERICS_LAMBDA,
    could_be,
    left_over,
    length,
    moved_by,
    others_of,
)
from diffsim.diagnose.judge.data_sheet import WRONG_SHEET_SD, pull_limit
from diffsim.diagnose.judge.judge import NAMES, Decision
from diffsim.diagnose.judge.own_values import words_of
from diffsim.diagnose.judge.records import WRONG_DATA_SHEET
from diffsim.diagnose.search.evidence import ALONE_NATS, Hypothesis, LaplaceEvidence, unrealized
from diffsim.diagnose.search.fitted_sets import Search
from diffsim.diagnose.search.simulations import Members
from diffsim.identify import Fit
from diffsim.identify.effort import KEEP_NATS

OWN_STEP = "the model's own time step"
SLOPES_REACH = 1.64  # posterior sd: within the 90 % interval slopes tell what is without a member
FORM = 0.05  # share of what a cause does to the record that its form may be wrong by


def without_forms(
    decision: Decision,
    fit: Fit,
    unrefined: Mapping[str, Array] | None = None,
    stepped: Mapping[int, str] | None = None,
    parts: Mapping[Members, Fit] | None = None,
) -> Decision:
    """The decision with the set that leaves out what may be another cause's form as a rival.

    Args:
        fit: Fit of its best set; its effects are those of the set, by ascending index.
        unrefined: Change of the record by refining numerical settings for which the gate failed at
            that fit, (N,) each by its name.
        stepped: Members that the model's own steps may be, as of ``own_steps``.
        parts: Fits of other sets, those without one of its members among them.
    """
    if decision.verdict not in NAMES:
        return decision
    changes = {name: fit.problem.whiten_all(raw) for name, raw in (unrefined or {}).items()}
    index = sorted(decision.best)
    # what a budget had cut lacks more than the set can tell
    known = {of: at for of, at in (parts or {}).items() if at.ended != "budget"}
    without = {k: known[p] for k, i in enumerate(index) if (p := decision.best - {i}) in known}
    found = form_of(fit, changes, without)
    forms = {index[i]: what for i, what in found.items()} | dict(stepped or {})
    if not forms:
        return decision
    rest = Hypothesis(decision.best - set(forms))
    rivals = (rest, *(h for h in decision.rivals if h != rest))
    return replace(decision, verdict="ambiguous", rivals=rivals, forms=forms)


def own_steps(search: Search, best: Members) -> dict[int, str]:
    """Members of the best set that the model's own time step may be, where finer steps correct it.

    A recording that the same simulator made, as when one simulation is to follow another, holds
    the error of its steps: half a step of an implicit Euler method is a sensor that is too early.
    Without the correction a set without such a member has the evidence, too.

    Args:
        search: Sets that were weighed, of corrected simulations; those without one member of the
            best are fitted.
        best: The set that the evidence asks for.
    """
    least, found = search.nats(Hypothesis(best)) - KEEP_NATS, dict[int, str]()
    for i in sorted(best):
        part = best - {i}
        if (fit := search.fits.get(part)) is None or search.nats(Hypothesis(part)) > least:
            continue
        plain = replace(fit.problem, correction=None)
        try:
            step = plain.record(fit.x) - fit.problem.record(fit.x)
        except DiffsimError:  # nothing is known there
            continue
        if search.nats_moved(part, step) > least:
            found[i] = OWN_STEP
    return found


def form_of(
    fit: Fit, changes: Mapping[str, Array], without: Mapping[int, Fit] | None = None
) -> dict[int, str]:
    """Effects that may be something else, each with what that is, by place in the problem.

    Compared are misfits in noise standard deviations: what the record would lack without the weak
    one, all else refitted, and what the strong one does, base parameters refitted. Within a family
    by their lengths; else by their mean squares where the weak one acts. By slopes, unless these
    would have to reach far, and a fit without it lacks more: let friction go to zero with masses
    and gains, and the record stays the same, but no motor is left.

    Args:
        changes: Whitened changes by refining numerical settings that the answer leaves too coarse.
    """
    effects = fit.problem.effects
    base = fit.jacobian[:, : fit.problem.num_base]
    does = [left_over(moved_by(fit, i), base) for i in range(len(effects))]
    others_at = [others_of(fit, i) for i in range(len(effects))]
    lacking = [left_over(moved_by(fit, i), fit.jacobian[:, o]) for i, o in enumerate(others_at)]
    for i, part in (without or {}).items():
        if length(lacking[i]) > SLOPES_REACH:
            moved = [part.residual - fit.residual, part.x - fit.x[others_at[i]]]
            lacking[i] = max(lacking[i], np.concatenate(moved), key=length)
            does[i] = max(does[i], lacking[i], key=length)
    found = {}
    for i, effect in enumerate(effects):
        lacks = lacking[i]
        others = {j: does[j] for j in range(len(effects)) if j != i}
        family = [j for j in others if effects[j].family == effect.family]
        law = max(family, key=lambda j: length(does[j]), default=i)
        coarse = [name for name, c in changes.items() if could_be(fit, i, c) >= NUMERICS_LAMBDA]
        if family and length(lacks) < FORM * length(does[law]):
            found[i] = f"another form of {words_of(effects[law].name)}"
        elif (first := _strongest(lacks, others, len(fit.jacobian))) is not None:
            found[i] = f"another form of {words_of(effects[first].name)}"
        elif coarse:
            found[i] = f"too coarse a {coarse[0].replace('_', ' ')}"
    return found


def _strongest(lacks: Array, does: Mapping[int, Array], num_samples: int) -> int | None:
    """The cause that does most where a weak one acts, if the latter stays below the noise and
    below what the form of the former may be wrong by."""
    power = lacks[:num_samples] ** 2
    if not does or not power.any():
        return None
    there = {j: float(power @ d[:num_samples] ** 2 / power.sum()) for j, d in does.items()}
    first = max(there, key=lambda j: there[j])
    usual = float(power @ power / power.sum())
    return first if usual < min(1.0, FORM**2 * there[first]) else None


def without_wrong_data_sheets(decision: Decision, search: Search) -> Decision:
    """The decision with wrong data sheets beside the causes that may stand in for them.

    Where the record holds more than the library does, nothing is changed: pulls of data sheets are
    part of what is left then. A single cause gives way to a data sheet that leads by 3 nats and
    explains the records better: priors alone say which is likelier, not which it is. Several causes
    give way to a single data sheet that leads by as much and explains the records no worse.

    Args:
        search: Sets that were weighed; those without one member of the best are fitted.
    """
    if decision.verdict not in NAMES or decision.beside is not None or decision.unknown is not None:
        return decision
    own = search.nats(Hypothesis(decision.best))
    if len(decision.best) > 1 and (one := _one_for_all(search, decision.best)):
        return _gives_way(decision, dict.fromkeys(decision.best, one), own)
    stand_ins = {i: _find_stand_in(search, decision.best, frozenset({i})) for i in decision.best}
    found = {i: sheet for i, sheet in stand_ins.items() if sheet}
    if not found:
        return decision
    forms = {**decision.forms, **{i: wrong_data_sheet(sheet.name) for i, sheet in found.items()}}
    instead = {
        decision.best - {i}: (wrong_data_sheet(sheet.name), own + sheet.nats)
        for i, sheet in found.items()
    }
    fits_better = all(
        _gains(search, decision.best, sheet) >= ALONE_NATS for sheet in found.values()
    )
    leads = all(sheet.nats >= ALONE_NATS for sheet in found.values())
    if len(decision.best) == 1 and leads and fits_better:
        return _gives_way(decision, found, own)
    rest = Hypothesis(decision.best - set(forms))
    rivals = (rest, *(h for h in decision.rivals if h != rest))
    return replace(decision, verdict="ambiguous", rivals=rivals, forms=forms, instead=instead)


def _gives_way(decision: Decision, found: Mapping[int, _DataSheet], own: float) -> Decision:
    """The decision for the plain model with the data sheet that explains what all members do."""
    at = {sheet.name: (sheet.x, sheet.sd) for sheet in found.values()}
    instead = {
        frozenset[int](): (wrong_data_sheet(sheet.name), own + sheet.nats)
        for sheet in found.values()
    }
    forms = {**decision.forms, **{i: wrong_data_sheet(sheet.name) for i, sheet in found.items()}}
    alone = replace(decision, verdict="none", best=frozenset(), rivals=(), equal=())
    return replace(alone, forms=forms, data_sheets=at, instead=instead)


def wrong_data_sheet(name: str) -> str:
    """What stands in for a cause, in words."""
    return f"{WRONG_DATA_SHEET}{words_of(name)}"


@dataclass(frozen=True)
class _DataSheet:
    """A data sheet that may be wrong."""

    name: str  # of the parameter
    nats: float  # evidence, or its lead over the set with the cause
    # x, sd: where the parameter lies with the wide prior [sd of the data sheet]
    x: float
    sd: float
    chi2: float  # misfit there


def _gains(search: Search, best: frozenset[int], sheet: _DataSheet) -> float:
    """By how much less a data sheet leaves of the records than the causes in its place [nats]."""
    return 0.5 * (search.posteriors[Hypothesis(best)].chi2 - sheet.chi2)


def _one_for_all(search: Search, best: frozenset[int]) -> _DataSheet | None:
    """The data sheet that alone explains what all members do, if it leads and fits as well."""
    sheet = _find_stand_in(search, best, best)
    if sheet is None or sheet.nats < ALONE_NATS or _gains(search, best, sheet) < -ALONE_NATS:
        return None
    return sheet


def _find_stand_in(
    search: Search, best: frozenset[int], members: frozenset[int]
) -> _DataSheet | None:
    """The data sheet that explains best what members do, if it can stand in their place."""
    rest = search.posteriors.get(Hypothesis(best - members))
    if rest is None or rest.fit is None:
        return None
    tried = list(_wrong_data_sheets(rest.fit, search.num_families))
    if not tried:
        return None
    sheet = max(tried, key=lambda s: s.nats)
    lead = sheet.nats - search.nats(Hypothesis(best))
    return replace(sheet, nats=lead) if lead > -ALONE_NATS else None


def _wrong_data_sheets(fit: Fit, num_families: int) -> Iterator[_DataSheet]:
    """Evidence of a set with the prior of one pulled parameter wide."""
    problem = fit.problem
    evidence = LaplaceEvidence(problem, fit.x, fit.residual, fit.jacobian, [], num_families)
    members = Hypothesis(frozenset(range(len(problem.effects))))
    lost = unrealized(fit, evidence.weigh(members))
    limit = pull_limit(problem.model.base)
    for j, p in enumerate(problem.model.base):
        if "@" not in p.name and abs(fit.x[j]) > limit:
            posterior = evidence.weigh(members, wide={j: WRONG_SHEET_SD})
            nats = posterior.nats - lost - evidence.family_price
            x, sd = float(posterior.x[j]), float(posterior.sd[j])
            yield _DataSheet(p.name, nats, x, sd, posterior.chi2)
