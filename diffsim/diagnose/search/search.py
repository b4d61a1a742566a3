"""Search over sets of effects, with or without an unknown cause, by Laplace evidence.

From the best set so far its neighbors (one more, one less, one swapped, a pair that masks each
other more) are ranked by linear evidence, those that could win are refitted, and the best refit
becomes the next center, until none is better. Sizes of effects with kinks are scanned before. A set
that is not refitted keeps its linear evidence, and cannot win; none that is refitted is worse than
its subsets.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from diffsim.core.errors import DiffsimError
from diffsim.diagnose.checks.gates import leaves_more
from diffsim.diagnose.checks.numerics import check_numerics_of_set
from diffsim.diagnose.search.evidence import (
    ALONE_NATS,
    TIE_DIGITS,
    Hypothesis,
    families,
    screen,
    twins_of,
)
from diffsim.diagnose.search.fit import HARD_START_CHI2, Null, grown
from diffsim.diagnose.search.fitted_sets import Search, weigh_unknowns
from diffsim.diagnose.search.from_prior import (
    FROM_PRIOR,
    LEAST_REFITS,
    center_at_prior,
    cooled,
    is_prior_too_dear,
    promising_sets,
)
from diffsim.diagnose.search.gauss_newton import (
    LEAST_RECORDS,
    LEAST_SLOPES,
    has_exact_slopes,
)
from diffsim.diagnose.search.scan import BORROWED
from diffsim.diagnose.search.simulations import NONE, Center, Members, Simulations
from diffsim.identify import Fit, Problem
from diffsim.identify.effect import Effect
from diffsim.identify.effort import FIT_NATS, FIT_RTOL, KEEP_NATS
from diffsim.identify.linearization import Linearization, linearization_at
from diffsim.identify.model import has_tangents, slopes_are_simulated
from diffsim.identify.ranges import SURE_SD

Array = NDArray[np.float64]
PLACE = re.compile(r"_(of|at)_\w+$")  # where a cause acts, as its name says
Begin = Callable[[Problem, Linearization], Linearization]
MAX_OVERTAKING = 2  # refits after the budget for them is spent
MAX_MENDED = 3  # fits of the best set, each with better slopes along weak directions
# of the plain model's misfit, that a cause takes by its slopes to be fitted alone
MOST_OF_PLAIN = 0.5
MAX_ALONE = 8  # of these
# shares of the runs that a leading set is fitted to first where whole runs are too hard: of 13
# profiles inside a drive, whose valley is 1 % wide, 13 so end at the noise, 11 by 1/4 and 1/2
SHARES = tuple(2.0 ** (-0.5 * k) for k in range(6, 0, -1))
LEFT_SHEET_SD = 5.0  # prior sd of a base parameter, from which a fit has left its data sheet


def begin(null: Null, simulations: Simulations) -> Search:
    """The plain model weighed, everything linearized there.

    Args:
        null: The plain model under its noise floor.
        simulations: Simulations made so far, those of an earlier noise floor included.
    """
    at, made = simulations.under(null).screen(NONE, None)
    num_families = families(null.wide.effects, null.case.unknowns)
    return Search(null, made, made.center(NONE, at, num_families)).with_fit(NONE, null.fit)


def begin_from(search: Search, members: Members, x: Array) -> Search:
    """The search with a set that an earlier one found best, under coarser numerical settings.

    Args:
        search: The plain model weighed.
        members: Effects of the set, by index.
        x: Its end there, standardized coordinates of its own problem, (n,).
    """
    made, names = search.simulations, (search.wide.effects[i].name for i in sorted(members))
    search.null.case.progress("search", 0.3, " + ".join(names).replace("_", " ") or "no effect")
    try:
        if members not in made.fitted:
            made = made.kept(members, linearization_at(made.narrow(members), x))
        fit, at = made.fitted_from(members, made.fitted[members], search.best_cost())
    except DiffsimError:  # a fit that begins elsewhere may not
        return search
    return replace(search, simulations=made.kept(members, at)).with_fit(members, fit)


def search_sets(search: Search) -> Search:
    """Weigh sets of effects until none of the best set's neighbors is better; then its rivals, and
    unknown causes beside it: they choose no set, and wait where a correction may still change."""
    until = search.null.case.searching + search.settings.refit_steps
    # it begins at what an earlier one found; else at the plain model or, if its fit has left the
    # data sheet, at the best set that was fitted from there
    if len(search.fits) == 1 and has_left_prior(search.fit_of(NONE)):
        search = _fit_from_prior(search)
    center, best = search.plain, _best_of(search)
    if best != NONE:
        center, search = _center(search, best, center)
    if center is search.plain:
        center, search = _scan_kinks(search, search.plain)
        search = replace(search, plain=center)
    for _ in range(search.settings.max_rounds):
        nats, search = _with_linear(search, center, search.neighbors(center.members))
        enough = search.nats(Hypothesis(center.members)) + KEEP_NATS
        enough -= search.linear_slack(center.members)
        ranked = sorted((s for s in nats if nats[s] > enough), key=lambda s: -nats[s])
        search = repaired(_refit_promising(search, center, ranked, until))
        best = _best_of(search)
        if best == center.members:
            break
        center, search = _center(search, best, center)
        if search.steps > until:  # the better sets that might follow are not known
            search = search.with_late()
            break
    else:  # nor are they where moves to a better set are used up
        search = search.with_late()
    search = _refit_rivals(search, center, until)
    most = max(search.null.case.settings.plain_steps, search.settings.refit_steps)
    search = replace(search, ends=search.steps + most)
    search = repaired(search)
    return search if search.null.case.correction is not None else weigh_unknowns(search, center)


def with_numerics(search: Search, members: Members) -> Search:
    """Check the numerical settings at the fit of a set, once; at that of the plain model they were
    checked before; those of corrected simulations are checked by their correction.

    Args:
        search: Sets that were weighed so far.
        members: Effects of the set, by index.
    """
    case = search.null.case
    if case.settings.accept_numerics or members == NONE or members in search.numerics:
        return search
    found = case.beyond
    if case.correction is None:
        record = search.simulations.fitted[members].record
        found = check_numerics_of_set(search.fit_of(members), record, case.settings)
    if found is None:
        return search
    return replace(search, numerics={**search.numerics, members: found})


def has_left_prior(fit: Fit) -> bool:
    """Whether a fit of the plain model took a base parameter far from its prior."""
    base = np.abs(fit.x[: fit.problem.num_base])
    return bool(base.max(initial=0.0) > LEFT_SHEET_SD)


def _best_of(search: Search) -> Members:
    """The set with the most evidence, without an unknown cause."""
    return max((h for h in search.posteriors if h.unknown is None), key=search.nats).effects


def _fit_from_prior(search: Search) -> Search:
    """Single causes and pairs that linear evidence promises at the data sheet, fitted from it."""
    settings = search.settings
    if is_prior_too_dear(search.simulations, settings):
        return search.with_late()
    at_prior, made = center_at_prior(search.simulations, settings, search.num_families)
    search = replace(search, simulations=made)
    if at_prior is None:
        return search
    until = search.null.case.searching + min(settings.scan_steps, FROM_PRIOR * settings.refit_steps)
    sets = promising_sets(at_prior, settings.max_effects)
    ranked, enough = [members for members, _ in sets], MOST_OF_PLAIN * at_prior.weigh(NONE).chi2
    # what one leaves of a large misfit because slopes are off, a second one takes by slopes
    alone = [members for members, at in sets if len(members) == 1 and at.chi2 < enough][:1]
    # backlash stands in for friction, an offset for a force: one other way is fitted whatever is
    # spent, unless the cause alone leaves noise
    others = [members for members in ranked[1:] if not members & ranked[0]]
    first = dict.fromkeys([*alone, *ranked[:1], *others[:1]])
    ranked = list(dict.fromkeys([*first, *ranked]))
    for k, members in enumerate(ranked[: max(settings.num_refits, LEAST_REFITS)]):
        # what an earlier round fitted begins at its own end and costs little
        is_late = k >= max(len(first), 2) and search.steps >= until and members not in made.fitted
        search = search.with_late() if is_late else refit(search, members, at_prior, begin=cooled)
        is_whole = members in alone and members in search.fits
        if is_whole and not leaves_more(search.fit_of(members)):
            break
    return search


def refit(
    search: Search,
    members: Members,
    near: Center | None = None,
    *,
    begin: Begin | None = None,
    point: Array | None = None,
) -> Search:
    """Fit a set and weigh it there, once; recorded under ``failed`` where it cannot be simulated.

    Args:
        search: Sets that were weighed so far.
        members: Effects of the set, by index.
        near: Center to start from; the plain model if None, or if it cannot be simulated from
            there.
        begin: Finds where a fit begins, from a start of its own.
        point: Where the fit begins, coordinates of all candidates; None: where linear evidence at
            the center has its optimum.
    """
    key = Hypothesis(members)
    if key in search.posteriors or key in search.failed:
        return search
    names = " + ".join(search.wide.effects[i].name for i in sorted(members))
    # how many refits it will take is not known before: each takes a tenth of what is left
    share = 0.85 - 0.6 * 0.9 ** len(search.posteriors)
    search.null.case.progress("search", share, names.replace("_", " ") or "no effect")
    near = near or search.plain
    posterior = near.weigh(members)
    promised = 0.5 * (posterior.chi2 + float(posterior.x @ posterior.x))
    message, best = "", None
    starts = _starts(search, members, near)
    begin = None if members in search.simulations.fitted else begin
    # as many as are fitted from the data sheet have their turn, however hopeless the first one is
    turn = FROM_PRIOR / LEAST_REFITS * search.settings.refit_steps
    most = max(turn, LEAST_RECORDS * search.wide.cost())
    narrow = search.simulations.narrow(members)
    if slopes_are_simulated(narrow.model):
        most = max(most, LEAST_SLOPES * narrow.cost_of_table(each=2.0))
    most = min(search.null.case.settings.plain_steps, most)
    for center in starts if begin is None else starts[:1]:
        try:
            if best is not None and best[0].ended == "budget":  # on from there, not anew
                start = search.simulations.kept(members, best[1]).fitted[members]
            else:
                x = center.evidence.weigh(key).x if point is None else point
                start = search.simulations.start(members, center.at, x)
            fit, at = search.simulations.fitted_from(
                members, start, search.best_cost(), begin, most
            )
        except DiffsimError as error:
            message = str(error)
            continue
        if best is None or fit.chi2 + fit.prior < best[0].chi2 + best[0].prior:
            best = fit, at
        if not _disappoints(search, best[0], promised):
            break
    if best is None:
        return search.with_failed(key, message)
    fit, case = best[0], search.null.case
    # it leads, and slopes lead nowhere, or promise little of much; a correction is of whole runs
    is_hard = fit.ended == "stalled" or fit.chi2 > HARD_START_CHI2 * fit.num_samples
    is_hard &= fit.ended != "budget" and leaves_more(fit)
    is_hard &= 0.5 * (fit.chi2 + fit.prior) <= search.best_cost()
    if is_hard and case.settings.windows and case.correction is None:
        grew = grown(narrow, fit.x, SHARES, search.steps + most, HARD_START_CHI2)
        if grew is not None and grew[0].chi2 + grew[0].prior < fit.chi2 + fit.prior:
            best = grew
    made = search.simulations.kept(members, best[1])
    return replace(search, simulations=made).with_fit(members, best[0])


def fitted_exactly(search: Search, members: Members) -> Search:
    """The search with a set fitted on from its end, where a budget had ended it, or slopes there
    are not exact: of a set that was far behind another one they need not be, and differences are
    not along weak directions; what the budget does not last for counts as late."""
    made, fit = search.simulations, search.fit_of(members)
    # all of its fits share one budget: of a servo's 13 runs three had taken 47 million steps of 16
    left = min(search.settings.refit_steps, search.ends - search.steps)
    at, until = made.fitted[members], search.steps + left
    is_exact = fit.ended != "budget"
    is_exact &= has_exact_slopes(at, max(fit.chi2 - fit.num_samples, 0.0))
    model = search.wide.model
    by_differences = bool(at.idx) and model.moves and not has_tangents(model)
    is_late = left <= 0.0 and (by_differences or not is_exact)
    for k in range(MAX_MENDED if left > 0.0 else 0):
        if not is_exact:
            after, end = made.fitted_from(members, at, np.inf, most=max(until - search.steps, 0.0))
            gained = 0.5 * (fit.chi2 + fit.prior - after.chi2 - after.prior)
            if k > 0 and after.ended == "stalled" and gained < FIT_NATS:
                break  # what these slopes promise is not there: they are no better
            fit, made = after, made.kept(members, end)
            at = made.fitted[members]
        has_time = search.wide.model.simulations.steps < until
        is_late |= k == 0 and by_differences and not has_time
        better = made.with_weak_slopes(members) if by_differences and has_time else at
        if better is at:
            break
        at, is_exact = better, False
    if by_differences and not slopes_are_simulated(model) and _leaves_sheets(fit):
        made, fit = _fitted_along_weak(made, members, fit, until)
    if made is not search.simulations:
        search = replace(search, simulations=made).with_fit(members, fit)
    if members in search.exact:
        return search
    return search.with_late() if is_late else replace(search, exact=search.exact | {members})


def _leaves_sheets(fit: Fit) -> bool:
    """Whether a fit would say that a data sheet is wrong."""
    base = zip(fit.problem.model.base, fit.x, strict=False)
    return any("@" not in p.name and abs(x) > SURE_SD for p, x in base)


def _fitted_along_weak(
    made: Simulations, members: Members, fit: Fit, until: float
) -> tuple[Simulations, Fit]:
    """A set fitted on by steps along weak directions: where all forces may be larger by one factor,
    slopes across edges, wrong by a percent, hold a fit far from its data sheets.

    Args:
        made: Simulations made so far, the set's fit among them.
        members: Effects of the set, by index.
        until: Count of weighted steps after which no further step is tried.
    """
    tally = made.wide.model.simulations
    for _ in range(MAX_MENDED):
        here, start = made.along_weak(members)
        if start is not None and tally.steps < until:
            after, end = made.fitted_from(members, start, np.inf, most=until - tally.steps)
            if after.chi2 + after.prior < fit.chi2 + fit.prior - 2.0 * FIT_NATS:
                made, fit = made.kept(members, end), after
                continue
        # right slopes say how little is known along such directions
        after, end = made.fitted_from(members, here, np.inf, most=max(until - tally.steps, 0.0))
        if after.chi2 + after.prior <= fit.chi2 + fit.prior + 2.0 * FIT_NATS:
            made, fit = made.kept(members, end), after
        break
    return made, fit


def fitted_to_end(search: Search, sets: Sequence[Members], whole: Members = NONE) -> Search:
    """The search with sets fitted on, whose fits a budget had ended, such as parts of the best one:
    a member gains by what its part lacks, not by what the part's fit has left. The best set first,
    as long as one more budget of a fit lasts.

    Args:
        search: Search that has fitted all of them.
        whole: Set whose parts they are; one that ended far above what slopes promise at the whole's
            end is fitted once more from there.
    """
    until = min(search.steps + search.null.case.settings.plain_steps, search.ends)
    made, near = search.simulations, None
    if whole:
        at = made.fitted[whole].joined(search.plain.at)
        near = made.center(whole, at, search.num_families)
    for members in sorted(sets, key=lambda p: -search.nats(Hypothesis(p))):
        made, fit = search.simulations, search.fit_of(members)
        most = until - search.steps
        promised = fit if near is None else near.evidence.weigh(Hypothesis(members))
        cost = 0.5 * (promised.chi2 + float(promised.x @ promised.x))
        falls_short = near is not None and _disappoints(search, fit, cost, is_part=True)
        if most <= 0.0 or not (falls_short or fit.ended == "budget"):
            continue
        start = made.fitted[members]
        try:
            if near is not None and falls_short:
                start = made.start(members, near.at, promised.x, anew=True)
            better, at = made.fitted_from(members, start, search.best_cost(), most=most)
        except DiffsimError as error:  # that end cannot be moved
            search = search.with_failed(Hypothesis(members), str(error))
            continue
        if better.chi2 + better.prior <= fit.chi2 + fit.prior:
            search = replace(search, simulations=made.kept(members, at)).with_fit(members, better)
    return search


def _starts(search: Search, members: Members, near: Center) -> list[Center]:
    """Centers to start from: scanned sizes, the center itself, the plain model; the first that
    lead to a good end are enough."""
    if members in search.simulations.fitted:  # from its own earlier end
        return [near]
    places = (near.towards(members), near, search.plain.towards(members), search.plain)
    return list(dict.fromkeys(places))[: search.settings.num_starts]


def _disappoints(search: Search, fit: Fit, promised: float, *, is_part: bool = False) -> bool:
    """Whether a fit ended far above what linear evidence promised, though that was of interest.

    What is promised to a part of the best set always is: what the part lacks, a member gains.
    """
    slack = search.settings.rival_nats
    if not is_part and promised > search.best_cost() + slack:
        return False
    misfit = 0.5 * max(fit.chi2 - fit.num_samples, 0.0)
    missed = 0.5 * (fit.chi2 + fit.prior) - promised
    return missed > slack + search.settings.linear_error * misfit


def repaired(search: Search) -> Search:
    """Sets that ended above one of their subsets are fitted again, from that one's optimum with the
    further sizes at zero."""
    for members in sorted(search.fits, key=len):
        subset = _better_subset(search, members)
        if subset is None:
            continue
        if search.steps >= search.ends:
            search = search.with_late()
            continue
        made = search.simulations
        try:
            slopes = made.screened.get(subset, search.plain.at)
            start = replace(made.fitted[subset].joined(slopes), slope_error=BORROWED)
            most = min(search.null.case.settings.plain_steps, search.ends - search.steps)
            fit, at = made.fitted_from(members, start, search.best_cost(), most=most)
        except DiffsimError as error:  # that end cannot be moved
            search = search.with_failed(Hypothesis(members), str(error))
            continue
        search = replace(search, simulations=made.kept(members, at)).with_fit(members, fit)
    return search


def _better_subset(search: Search, members: Members) -> Members | None:
    """The best fitted subset, if the set's own fit is worse by more than fits are exact to."""
    costs = {s: 0.5 * (f.chi2 + f.prior) for s, f in search.fits.items() if s < members}
    if not costs:
        return None
    best = min(costs, key=lambda s: costs[s])
    fit = search.fit_of(members)
    misfit = 0.5 * max(fit.chi2 - fit.num_samples, 0.0)
    exact = max(FIT_NATS, FIT_RTOL * misfit)
    return best if 0.5 * (fit.chi2 + fit.prior) > costs[best] + exact else None


def weigh_unknowns_beside(search: Search, members: Members) -> Search:
    """Weigh a fitted set with every unknown cause, if that was not done."""
    if not search.unknowns or Hypothesis(members, 0) in search.posteriors:
        return search
    center, search = _center(search, members, search.plain)
    return weigh_unknowns(search, center)


def _center(search: Search, members: Members, last: Center) -> tuple[Center, Search]:
    borrowed = search.borrowed
    try:
        at, made = search.simulations.screen(members, last.at)
    except DiffsimError as error:  # some effect cannot be moved there: slopes of before
        made = search.simulations
        at = made.fitted[members].joined(last.at)
        borrowed = {**borrowed, members: str(error)}
    center = made.center(members, at, search.num_families)
    return _scan_kinks(replace(search, simulations=made, borrowed=borrowed), center)


def _scan_kinks(search: Search, center: Center) -> tuple[Center, Search]:
    """A center with the scans of effects with kinks, where a misfit is left for them."""
    fit, settings = search.fit_of(center.members), search.settings
    if 0.5 * (fit.chi2 - fit.num_samples) < KEEP_NATS:
        return center, search
    center, made = search.simulations.scanned(center, settings, search.num_families)
    return center, replace(search, simulations=made)


def _with_linear(
    search: Search, center: Center, sets: Sequence[Members]
) -> tuple[dict[Members, float], Search]:
    """Linear evidence of sets at a center [nats], kept for the table."""
    entries = {s: center.weigh(s) for s in sets}
    new = {Hypothesis(s): w for s, w in entries.items() if Hypothesis(s) not in search.posteriors}
    nats = {s: round(w.nats, TIE_DIGITS) for s, w in entries.items()}
    return nats, replace(search, linear={**search.linear, **new})


def _refit_promising(
    search: Search, center: Center, ranked: Sequence[Members], until: float
) -> Search:
    """Refit the first of the ranked neighbors, and as many more as are asked for; where they leave
    more than noise, single causes that take most of the misfit by the plain model's slopes, before
    sets grow from the first of them.

    Several find their size step by step, each a little: where the misfit is large, slopes rank one
    that does it all behind them, though its own fit would lead there: a spring between two masses
    behind four that are late.

    Args:
        search: Sets that were weighed so far.
        center: The best set.
        ranked: Its neighbors, best first.
        until: Weighted steps after which the rest keeps its linear evidence. Where no refit so far
            stayed near the data sheet, linear evidence was no guide, and a few more are made.
    """
    wanted = search.settings.num_refits
    most = wanted if np.isinf(until) else max(wanted, LEAST_REFITS)
    for k, members in enumerate(ranked[:most]):
        is_within = k == 0 or (k < wanted and search.steps < until)
        tried = (search.fits[s] for s in ranked[:k] if s in search.fits)
        if not is_within and not all(map(has_left_prior, tried)):
            break
        search = refit(search, members, center)
    plain, best = search.fit_of(NONE), search.fit_of(_best_of(search))
    if 0.5 * (best.chi2 - best.num_samples) < KEEP_NATS:
        return search
    enough = MOST_OF_PLAIN * 0.5 * max(plain.chi2 - plain.num_samples, 0.0)
    enough += search.nats(Hypothesis())
    alone = [frozenset({i}) for i in range(len(search.wide.effects))]
    nats = {s: round(search.plain.weigh(s).nats, TIE_DIGITS) for s in alone}
    leading = sorted((s for s in alone if nats[s] > enough), key=lambda s: -nats[s])
    for members in leading[:MAX_ALONE]:
        if search.steps < until:
            search = refit(search, members)
    return search


def _refit_rivals(search: Search, center: Center, until: float) -> Search:
    """Refit what could be a rival of the best set, or show that a member is not needed.

    Args:
        search: Sets that were weighed so far.
        until: Weighted steps after which the rest keeps its linear evidence, subsets apart, and the
            first that promise to be better than the best set.
    """
    slack = search.linear_slack(center.members)
    plain, best = search.nats(Hypothesis()), search.nats(Hypothesis(center.members))
    neighbors, num_overtaking = search.neighbors(center.members), 0
    nats, search = _with_linear(search, center, neighbors)
    if np.isfinite(until):  # what could decide most comes first
        neighbors.sort(key=lambda s: (not s < center.members, -nats[s]))
    for members in neighbors:
        enough = best + KEEP_NATS if members > center.members else best - ALONE_NATS
        if members < center.members:
            enough = best - KEEP_NATS
        elif not members > center.members:
            enough = max(enough, plain + KEEP_NATS)
        if nats[members] > enough - slack:
            is_late = search.steps > until and not members < center.members
            overtakes = nats[members] > best + KEEP_NATS and num_overtaking < MAX_OVERTAKING
            if is_late and not overtakes:
                search = search.with_late()
                continue
            num_overtaking += is_late
            search = refit(search, members, center)
    return _refit_siblings(search, center, until)


def _refit_siblings(search: Search, center: Center, until: float) -> Search:
    """Refit sets that do the same as the best ones, where linear evidence is no guide: by another
    kink, or by a twin, whose size may be far from where slopes are."""
    best, effects = _best_of(search), search.wide.effects
    least = search.nats(Hypothesis(best)) - ALONE_NATS
    several = [s for s in search.fits if 1 < len(s) <= len(best)]  # one is scanned where it is
    near = [s for s in several if search.nats(Hypothesis(s)) >= least]
    siblings: dict[Members, Array | None] = {}
    if best == center.members:
        seen, open_ = screen(center.evidence), set(search.neighbors(best))
        pairs = [(i, k) for i in sorted(best) for k in twins_of(effects, seen, i) if k not in best]
        pairs = [(i, k) for i, k in pairs if (best - {i}) | {k} in open_]
        siblings = {(best - {i}) | {k}: _with_twin(search, center, i, k) for i, k in pairs}
    for members in near:
        siblings = dict.fromkeys(_kinked_siblings(effects, members)) | siblings
    for members in sorted(siblings.keys() - search.fits.keys(), key=sorted):
        is_late, point = search.steps > until, siblings[members]
        at = search.plain if point is None else center
        search = search.with_late() if is_late else refit(search, members, at, point=point)
    return search


def _with_twin(search: Search, center: Center, i: int, twin: int) -> Array:
    """Coordinates of a center with another effect in a member's place, as large as it takes to do
    to the plain model, by its slopes, what the member does."""
    wide, plain = search.wide, search.plain.at
    own, others = (wide.columns_of(wide.effects[k]) for k in (i, twin))
    scaled = wide.scaled(center.at.x)
    done = wide.whiten_all(plain.slopes(own) @ scaled[own])
    scaled[others] = np.linalg.lstsq(wide.whiten_all(plain.slopes(others)), done)[0]
    scaled[own] = 0.0
    return wide.standardized(scaled)


def _kinked_siblings(effects: Sequence[Effect], members: Members) -> set[Members]:
    """The set with a member that has a kink replaced by another one of its family and place.

    Where others have moved beside the first one, slopes tell nothing of the second: a valve's dead
    band with an offset is slack with another offset.
    """
    kinked = {i: PLACE.search(e.name) for i, e in enumerate(effects) if not e.smooth}
    place = {i: found and found[0] for i, found in kinked.items()}
    return {
        (members - {i}) | {j}
        for i in members.intersection(place)
        for j in place
        if j not in members and effects[j].family == effects[i].family
        if place[j] == place[i]
    }
