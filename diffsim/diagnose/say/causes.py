"""A verdict on every cause: effects of the library, base parameters, unknown causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from diffsim.core.figures import figure
from diffsim.diagnose.judge.averaging import ModelAverage
from diffsim.diagnose.judge.data_sheet import pull_of
from diffsim.diagnose.judge.judge import Decision, Judgment
from diffsim.diagnose.judge.own_values import words_of
from diffsim.diagnose.judge.preconditions import SHARED
from diffsim.diagnose.judge.records import (
    CERTAIN,
    DATA_SHEET,
    EFFECT,
    HALF_LEVEL,
    HIDDEN,
    LIKELY,
    ONE_LAW,
    REFUTED,
    SURE,
    UNJUDGED,
    UNKNOWN,
    UNTOLD,
    BaseRow,
    CauseRow,
    Interval,
)
from diffsim.diagnose.judge.stand_ins import OWN_STEP
from diffsim.diagnose.search.evidence import VISIBLE, Hypothesis, Screen
from diffsim.diagnose.search.scan import least_tried
from diffsim.diagnose.search.simulations import NONE
from diffsim.identify import Fit
from diffsim.identify.effect import Effect
from diffsim.identify.effort import KEEP_NATS
from diffsim.identify.numerics import NumericalEffect

PROBABLE = 0.8  # probability over all sets; what is left to one is possible
SEEN = 1.5  # of the usual size: a smallest visible size up to which a cause would be seen
NOISE = "noise"
REST = "what else is missing"
ORDER = (CERTAIN, LIKELY, UNTOLD, REFUTED, HIDDEN, UNJUDGED)


def open_rivals(
    decision: Decision, about: ModelAverage, alone: frozenset[int]
) -> tuple[Hypothesis, ...]:
    """Sets that the choice is open to.

    Where some effects are singled out, those within reach and those that fit as well.
    """
    if not alone:
        return decision.rivals
    within = [h for h in about.reach if not h.effects >= decision.best]
    within += [h for h in decision.equal if h not in within]
    plain = Hypothesis(decision.best - set(decision.forms))
    return (plain, *within) if decision.forms and plain not in within else tuple(within)


@dataclass(frozen=True, eq=False)
class CauseEvidence:
    """What the rows of causes are made from."""

    judgment: Judgment  # the verdict and the search behind it
    about: ModelAverage | None  # probabilities and sizes over all sets; None: nothing was searched
    screened: Screen
    effects: Sequence[Effect]  # candidates, in the order of their indices
    members: frozenset[int]  # effects that the extended model holds, by index
    unmet: Mapping[str, str]  # what the study lacks for candidates that were left out, by name
    alone: frozenset[int] = frozenset()  # effects in whose place nothing else may act, by index
    rivals: tuple[Hypothesis, ...] = ()  # sets that the choice is open to
    undone: frozenset[int] = frozenset()  # effects that others of the best set undo, by index
    # why members of the best set are not certain, by index; none: they are
    doubts: Mapping[int, tuple[str, ...]] = field(default_factory=dict)
    doubts_of_names: tuple[str, ...] = ()  # why nothing that has a name is certain
    doubts_of_fit: tuple[str, ...] = ()  # why no unknown cause is
    wrong_gradients: frozenset[str] = frozenset()  # names of effects whose gradient check failed
    # what the extended model leaves, where that is much, else 1: sizes must show above it [noise
    # sd]
    left: float = 1.0

    @property
    def doubts_of_sheets(self) -> tuple[str, ...]:
        """Why no data sheet is certain: it is known beside the set's causes, not without them."""
        own = (why for i in sorted(self.members) for why in self.doubts.get(i, ()))
        return (*dict.fromkeys(filter(SHARED.match, own)), *self.doubts_of_names)

    def why_not_judged(self, i: int) -> str:
        """Why nothing tells what sizes of an effect, by index, would do; empty: something does.

        Slopes at zero tell nothing of one with a kink there: a fit must have held it where much is
        left, or its sizes must have been tried.
        """
        search, effect = self.judgment.search, self.effects[i]
        if search is None or any(i in members for members in search.fits):
            return ""
        made = search.simulations
        is_late = any(i in group for _, _, group in made.scans_late)
        if is_late and not any(i in group for _, group in made.scans):
            return "its sizes were not tried"
        if self.left > 1.0 and not effect.smooth and not isinstance(effect, NumericalEffect):
            return f"no fit held it, and what is left is {figure(self.left, 2)} times the noise"
        return ""


def cause_rows(known: CauseEvidence, base: Sequence[BaseRow]) -> tuple[CauseRow, ...]:
    """One row per candidate, per data sheet that is contradicted, and per unknown cause in play.

    Args:
        known: Verdict, probabilities and candidates.
        base: Base parameters, findings among them.
    """
    values = {row.name: row.value for row in base}
    rows = [_effect_row(known, i, values) for i in range(len(known.effects))]
    rows += [
        CauseRow(name, words_of(name), EFFECT, UNJUDGED, None, {}, "-", note=why)
        for name, why in known.unmet.items()
    ]
    rows += [_finding_row(known, row) for row in base if row.finding]
    rows += _unknown_rows(known)
    return ranked(rows)


def ranked(rows: Sequence[CauseRow]) -> tuple[CauseRow, ...]:
    """Rows by status, then by what a cause removes, then by probability and gain."""
    return tuple(sorted(rows, key=_rank))


def _rank(row: CauseRow) -> tuple[int, float, float, float]:
    gained = 0.0 if row.gain is None else row.gain.value * row.gain.excess
    return (
        ORDER.index(row.status),
        -(row.removes or 0.0),
        -round(row.probability or 0.0, 3),
        -gained,
    )


def _effect_row(known: CauseEvidence, i: int, values: Mapping[str, float]) -> CauseRow:
    effect, about = known.effects[i], known.about
    decision, gains = known.judgment.decision, known.judgment.gains
    smallest = _smallest_visible(known, i)
    row = CauseRow(
        name=effect.name,
        words=words_of(effect.name),
        origin=EFFECT,
        status=UNJUDGED,
        probability=None,
        size=_screened_size(known, i),
        unit=effect.unit,
        smallest_visible=smallest,
        gain=gains.get(i),
        note="" if effect.family == "law" else effect.form.replace("``", ""),
        shown_unit=effect.shown_unit,
        shown_times=effect.shown_times,
        shown_power=effect.shown_power,
    )
    if about is None or decision.verdict == "unrepeatable":
        why = "repeats differ more than the noise" if about else "numerical settings come first"
        return replace(row, note=f"not judged: {why}")
    p = about.probability(i)
    status, rivals = _status(known, about, i, p)
    if status == REFUTED and (why := _why_not_refuted(known, i)):
        is_unknown = i in known.judgment.withdrawn or effect.name in known.wrong_gradients
        status = UNJUDGED if is_unknown else UNTOLD if rivals else HIDDEN
        row = replace(row, note=why if status == UNJUDGED else f"{row.note} Not refuted: {why}.")
    if status == HIDDEN and (why := known.why_not_judged(i)):
        status, row = UNJUDGED, replace(row, note=f"not judged: {why}")
    elif status == HIDDEN and known.left > 1.0:
        row = replace(
            row, note=f"{row.note} Of what is left, {figure(known.left, 2)} times the noise."
        )
    helps = i in known.members and status not in (CERTAIN, LIKELY)
    sizes = about.size(i) or row.size
    if status in (HIDDEN, REFUTED):  # nobody looked below
        least = least_tried(effect)
        sizes = {c: replace(s, high=max(s.high, least)) for c, s in sizes.items()}
    value = next(iter(sizes.values())).value if len(sizes) == 1 else 0.0
    words = effect.words(value) if effect.words is not None and value else row.words
    if effect.says is not None and value:
        words = effect.says(value, values)
    if status in (CERTAIN, LIKELY) and effect.also_looks_like:
        row = replace(row, note=f"{row.note} May as well be: {'; '.join(effect.also_looks_like)}.")
    return replace(
        row,
        words=words,
        status=status,
        probability=p,
        size=sizes,
        rivals=rivals,
        doubts=known.doubts.get(i, ()) if status == LIKELY else (),
        removes=_find_share(known, i),
        helps=helps,
        factor=about.factor(i),
    )


def _find_share(known: CauseEvidence, i: int) -> float | None:
    """Share of the misfit above the noise that is back without an effect of the extended model.

    By the fit of the set without it; by the slopes of the model's fit where nobody made one.
    """
    search = known.judgment.search
    if search is None or i not in known.members:
        return None
    plain, best = search.fit_of(NONE), search.fit_of(known.members)
    missing = plain.chi2 - plain.num_samples
    if missing <= 0.0:
        return None
    without = search.fits.get(known.members - {i})
    back = _rise_without(best, known.effects[i]) if without is None else without.chi2 - best.chi2
    return float(np.clip(back / missing, 0.0, 1.0))


def _rise_without(fit: Fit, effect: Effect) -> float:
    """Rise of chi2 and prior without an effect, by the slopes of a fit with it."""
    own = fit.problem.columns_of(effect)
    x = fit.x[own]
    return float(x @ np.linalg.solve(fit.covariance[np.ix_(own, own)], x))


def _status(
    known: CauseEvidence, about: ModelAverage, i: int, p: float
) -> tuple[str, tuple[str, ...]]:
    """Status of an effect, and what it cannot be told from."""
    judgment, decision = known.judgment, known.judgment.decision
    if i in judgment.withdrawn:
        return REFUTED, ()
    if decision.verdict == "unknown":
        if i in decision.best or i in known.members:
            return UNTOLD, _unknown_names(known, decision)
    elif i in known.alone:
        return (LIKELY if known.doubts.get(i) else CERTAIN), ()
    elif i in decision.best or any(i in h.effects for h in known.rivals):
        rivals, is_best = _rivals_of(known, decision, i), i in decision.best
        is_named = is_best and (decision.verdict == "named" or p >= PROBABLE)
        is_named &= decision.forms.get(i) != OWN_STEP  # which is no cause at all
        if is_named and _is_hollow(judgment, about, i):
            return UNTOLD, rivals or (NOISE,)
        if i in known.undone:
            return UNTOLD, (*rivals, ONE_LAW)
        return (LIKELY if is_named else UNTOLD), rivals
    if i in decision.forms and i not in decision.best:  # a wrong data sheet leads by far
        return REFUTED, (decision.forms[i],)
    if i in judgment.as_good:
        return UNTOLD, tuple(known.effects[k].name for k in sorted(judgment.as_good[i]))
    if p >= 1.0 - PROBABLE:
        return UNTOLD, (NOISE,)
    added = about.added(decision.best | known.members, i)
    if added >= KEEP_NATS:  # sets of so many causes were not fitted
        return UNTOLD, (REST,)
    visible = [s <= SEEN * known.effects[i].typical for s in _smallest_visible(known, i).values()]
    return (REFUTED if added < -KEEP_NATS and any(visible) else HIDDEN), ()


def _is_hollow(judgment: Judgment, about: ModelAverage, i: int) -> bool:
    """Whether a member adds nothing that is sure to a set with others that do: its size may be
    zero, or it another one's form, and what it was not fitted to shows no gain by it. It may stand
    in for one of these, or for what the fit of another set did not reach."""
    decision = judgment.decision

    def is_idle(k: int) -> bool:
        gain = judgment.gains.get(k)
        is_open = about.may_be_zero(k) or k in decision.forms
        return gain is not None and not gain.has_fallen and is_open

    return is_idle(i) and not all(is_idle(k) for k in decision.best)


def _why_not_refuted(known: CauseEvidence, i: int) -> str:
    """Why nothing refutes an effect: no fit with it converged, or none that would have shown it;
    empty where one did."""
    search, effect = known.judgment.search, known.effects[i]
    assert search is not None  # statuses come of a search
    if effect.name in known.wrong_gradients:
        return "its derivative could not be confirmed"
    fits = [fit for members, fit in search.fits.items() if i in members]
    if not fits:
        return "no set with it was fitted"
    ended = [fit for fit in fits if fit.converged]
    if not ended:
        return "no fit of a set with it converged"
    names = [ended[0].problem.names[c] for c in ended[0].problem.columns_of(effect)]
    smallest = min(VISIBLE * fit.sd[name] for fit in ended for name in names)
    if i in known.judgment.withdrawn or i in known.judgment.decision.forms:
        return ""  # it was there, and made unseen runs worse or gave way
    smallest *= known.left
    return "" if smallest <= SEEN * effect.typical else "no fit with it would have shown it"


def _rivals_of(known: CauseEvidence, decision: Decision, i: int) -> tuple[str, ...]:
    """Causes that act in the place of an effect in rival sets."""
    names: dict[str, None] = {}
    if i in decision.forms:
        names[decision.forms[i]] = None
    for h in known.rivals:
        if i in h.effects and i in decision.best:
            continue
        if i in decision.best:
            others, unknown = h.effects - decision.best, h.unknown
        elif i in h.effects:
            others, unknown = decision.best - h.effects, None
        else:
            continue
        names |= dict.fromkeys(known.effects[k].name for k in sorted(others))
        if unknown is not None:
            names[_unknown_name(known, unknown)] = None
        if not others and unknown is None and i not in decision.forms:
            names[NOISE] = None
    return tuple(names)


def _unknown_names(known: CauseEvidence, decision: Decision) -> tuple[str, ...]:
    h = decision.unknown
    return () if h is None or h.unknown is None else (_unknown_name(known, h.unknown),)


def _unknown_name(known: CauseEvidence, u: int) -> str:
    search = known.judgment.search
    assert search is not None  # unknown causes are weighed in a search only
    return search.unknowns[u].name


def _smallest_visible(known: CauseEvidence, i: int) -> dict[str, float]:
    """Smallest visible size by component: at the plain model, or beside the best set if less; in
    the noise that is left.

    What was named with a size has been seen: it is not listed as invisible above that.
    """
    effect, k = known.effects[i], sum(len(e.components) for e in known.effects[:i])
    screened = known.screened.smallest_visible[k : k + len(effect.components)]
    out = dict(zip(effect.components, (float(s) for s in screened), strict=True))
    search = known.judgment.search
    for h, w in ({} if search is None else search.posteriors).items():
        if i in h.effects and w.fit is not None and w.fit.converged:
            own = w.fit.problem.columns_of(effect)
            names = [w.fit.problem.names[c] for c in own]
            for component, name in zip(effect.components, names, strict=True):
                out[component] = min(out[component], VISIBLE * w.fit.sd[name])
    left = 1.0 if i in known.members else known.left
    return {c: max(left * s, least_tried(effect)) for c, s in out.items()}


def _screened_size(known: CauseEvidence, i: int) -> dict[str, Interval]:
    """Size as the plain model's scores ask for it; no fit was made."""
    effect, k = known.effects[i], sum(len(e.components) for e in known.effects[:i])
    out = {}
    for c, component in enumerate(effect.components, start=k):
        value = float(known.screened.size[c])
        half = HALF_LEVEL * float(known.screened.smallest_visible[c]) / VISIBLE
        if np.isfinite([value, half]).all():
            low = value - half if effect.signed else max(value - half, 0.0)
            out[component] = Interval(value, low, max(value + half, 0.0))
    return out


def _finding_row(known: CauseEvidence, row: BaseRow) -> CauseRow:
    """A base parameter that the recordings pull off its data sheet."""
    decision, about = known.judgment.decision, known.about
    rivals: tuple[str, ...] = ()
    if decision.verdict == "unknown":
        status, rivals = UNTOLD, _unknown_names(known, decision)
    else:
        half = HALF_LEVEL * row.sd / row.prior_sd if row.prior_sd else 0.0
        is_sure = abs(row.pull) - half > row.limit and not known.doubts_of_sheets
        status = CERTAIN if is_sure else LIKELY
        others = _sets_without_pull(known, about, row)
        if others:
            status, rivals = UNTOLD, others
    read = row.as_read()
    return CauseRow(
        name=row.name,
        words=row.words,
        origin=DATA_SHEET,
        status=status,
        probability=None,
        size={"size": Interval(row.value, row.low, row.high)},
        unit=row.unit,
        rivals=rivals,
        doubts=known.doubts_of_sheets if status == LIKELY else (),
        note=f"data sheet: {figure(read.prior_value, 4)} +- {figure(read.prior_sd, 2)} "
        "(one standard deviation)",
        shown_unit=read.unit,
    )


def _sets_without_pull(
    known: CauseEvidence, about: ModelAverage | None, row: BaseRow
) -> tuple[str, ...]:
    """Causes of the sets within reach in which the parameter stays near its data sheet."""
    names: dict[str, None] = {}
    forms = known.judgment.decision.forms
    for h in () if about is None else about.reach:
        if h.effects & set(forms):  # the data sheet was weighed against these
            continue
        fit = about.search.posteriors[h].fit if about and h in about.search.posteriors else None
        if fit is None:
            continue
        own = [
            i
            for i, n in enumerate(fit.problem.names)
            if n == row.name or n.startswith(f"{row.name}@")
        ]
        if own and abs(pull_of(fit.x[own].tolist())) <= row.limit:
            more = h.effects - known.judgment.decision.best
            names |= dict.fromkeys(known.effects[k].name for k in sorted(more))
    return tuple(names)


def _unknown_rows(known: CauseEvidence) -> list[CauseRow]:
    """Unknown causes behind the verdict, or with a probability that counts."""
    about, search = known.about, known.judgment.search
    if about is None or search is None or known.judgment.decision.verdict == "unrepeatable":
        return []
    decision, rows = known.judgment.decision, []
    shown = {h.unknown for h in (decision.unknown, decision.beside, *decision.rivals) if h}
    for u, cause in enumerate(search.unknowns):
        p = float(sum(w for h, w in about.weights.items() if h.unknown == u))
        if u in shown or (p >= PROBABLE and u not in known.judgment.refuted):
            is_verdict = decision.unknown is not None and decision.unknown.unknown == u
            is_sure = is_verdict and p >= SURE and not known.doubts_of_fit
            status = CERTAIN if is_sure else LIKELY if p >= PROBABLE else UNTOLD
            named = tuple(known.effects[i].name for i in sorted(decision.best))
            rivals = named if status == UNTOLD else ()
            row = CauseRow(
                cause.name, words_of(cause.name), UNKNOWN, status, p, {}, "-", rivals=rivals
            )
            why = known.doubts_of_fit if is_verdict and status == LIKELY else ()
            rows.append(replace(row, doubts=why))
    return rows
