"""A verdict on every cause: effects of the library, base parameters, unknown causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from diffsim.diagnose.judge.averaging import HALF_90, ModelAverage
from diffsim.diagnose.judge.data_sheet import pull_of, words_of
from diffsim.diagnose.judge.judge import NAMES, Decision, Judgment
from diffsim.diagnose.judge.records import (
    CERTAIN,
    DATA_SHEET,
    EFFECT,
    HIDDEN,
    LIKELY,
    REFUTED,
    UNJUDGED,
    UNKNOWN,
    UNTOLD,
    BaseRow,
    CauseRow,
    Interval,
)
from diffsim.diagnose.search.evidence import ALONE_NATS, KEEP_NATS, VISIBLE, Hypothesis, Screen
from diffsim.diagnose.search.scan import least_tried
from diffsim.identify.effect import Effect

SURE, PROBABLE, POSSIBLE = 0.99, 0.8, 0.2  # probabilities over all sets
NOISE = "noise"
REST = "what else is missing"
ORDER = (CERTAIN, LIKELY, UNTOLD, REFUTED, HIDDEN, UNJUDGED)


def certain_of(decision: Decision, about: ModelAverage, judgment: Judgment) -> frozenset[int]:
    """Effects in every set within reach or that fits as well, with a probability of 99 %.

    None where an unknown cause beside the best set is a rival: the set explains too little then.
    Where larger sets were not fitted although they have the evidence, what they would hold must not
    be enough to replace the effect. Nor is an effect certain that only stands in for what the
    validation took away, that helps nothing on unseen parts, or whose size may as well be zero. A
    single recording makes nothing certain: no other one could contradict it.
    """
    case = about.search.null.case
    if decision.verdict not in NAMES or len(case.study.runs) + case.num_tests < 2:
        return frozenset()
    left_out = _left_out(decision, about)
    refused = vetoed(about, decision.best, judgment.withdrawn)
    # the interval lies at zero or below, although there is something to gain
    idle = {i for i, gain in judgment.gains.items() if gain.high <= 0.0 < gain.excess}
    if any(h.unknown is not None and h.effects >= decision.best for h in decision.rivals):
        return frozenset()
    return frozenset(
        i
        for i in decision.best
        if about.probability(i) >= SURE
        and not _may_be_replaced(about, i, left_out)
        and all(i in h.effects for h in (*about.reach, *decision.equal))
        and all(i in members for members in refused)
        and i not in idle
        and not _may_be_zero(about, i)
        and i not in decision.forms
    )


def vetoed(
    about: ModelAverage, best: frozenset[int], withdrawn: frozenset[int]
) -> list[frozenset[int]]:
    """The best sets with effects that the validation withdrew, where they have the evidence.

    The fit runs ask for them and unseen runs refuse them: something that the library has not got
    right acts there. What is named instead may stand in for it, unless these sets hold it as well.
    """
    by_set = {h: w.nats for h, w in about.search.posteriors.items() if h.unknown is None}
    taken = {h.effects: nats for h, nats in by_set.items() if h.effects & withdrawn}
    most = max(taken.values(), default=-np.inf)
    if most < by_set[Hypothesis(best)] + ALONE_NATS:
        return []
    return [members for members, nats in taken.items() if nats > most - ALONE_NATS]


def _may_be_zero(about: ModelAverage, i: int) -> bool:
    """Whether the widened intervals of all components of a size hold zero, together too."""
    sizes = about.size(i).values()
    if not sizes or not all(size.low <= 0.0 <= size.high for size in sizes):
        return False
    return len(sizes) == 1 or not about.differs_jointly(i)


def _left_out(decision: Decision, about: ModelAverage) -> float:
    """Most that one more cause would add to the largest set that is allowed [nats]."""
    search = about.search
    if len(decision.best) < search.settings.max_effects:
        return 0.0
    others = set(range(len(search.wide.effects))) - decision.best
    most = max((about.added(decision.best, i) for i in others), default=0.0)
    return most if most >= KEEP_NATS else 0.0


def _may_be_replaced(about: ModelAverage, i: int, left_out: float) -> bool:
    """Whether sets larger than were fitted could do without a member.

    Without it the evidence falls by so much that even twice what one more cause adds elsewhere does
    not make up for it: then it stands, whatever else acts.
    """
    if left_out == 0.0:
        return False
    nats = {h: w.nats for h, w in {**about.search.linear, **about.search.posteriors}.items()}
    without = max(n for h, n in nats.items() if i not in h.effects)
    return max(nats.values()) - without < 2.0 * left_out + ALONE_NATS


def open_rivals(
    decision: Decision, about: ModelAverage, certain: frozenset[int]
) -> tuple[Hypothesis, ...]:
    """Sets that the choice is open to.

    Where some effects are certain, those within reach and those that fit as well.
    """
    if not certain:
        return decision.rivals
    within = [h for h in about.reach if not h.effects >= decision.best]
    within += [h for h in decision.equal if h not in within]
    plain = Hypothesis(decision.best - set(decision.forms))
    return (plain, *within) if decision.forms and plain not in within else tuple(within)


@dataclass(frozen=True, eq=False)
class CauseEvidence:
    """What the rows of causes are made from.

    Attributes:
        judgment: The verdict and the search behind it.
        about: Probabilities and sizes over all sets; None: nothing was searched.
        screened: Scores at the plain model.
        effects: Candidates, in the order of their indices.
        members: Effects that the extended model holds, by index.
        unmet: What the study lacks for candidates that were left out, by name.
        certain: Effects that are certain, by index.
        rivals: Sets that the choice is open to.
        surest: Status of what no set within reach can do without. Likely in a first answer, as a
            further cause may take its place, and where it may stand in for what is unknown.
    """

    judgment: Judgment
    about: ModelAverage | None
    screened: Screen
    effects: Sequence[Effect]
    members: frozenset[int]
    unmet: Mapping[str, str]
    certain: frozenset[int] = frozenset()
    rivals: tuple[Hypothesis, ...] = ()
    surest: str = CERTAIN


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
    return tuple(sorted(rows, key=_rank))


def _rank(row: CauseRow) -> tuple[int, float, float]:
    """By status, by probability, and by what a cause explains."""
    gained = 0.0 if row.gain is None else row.gain.value * row.gain.excess
    return ORDER.index(row.status), -round(row.probability or 0.0, 3), -gained


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
        note=effect.form,
        shown_unit=effect.shown_unit,
        shown_times=effect.shown_times,
    )
    if about is None or decision.verdict == "unrepeatable":
        why = "repeats differ more than the noise" if about else "numerical settings come first"
        return replace(row, note=f"not judged: {why}")
    p = about.probability(i)
    status, rivals = _status(known, about, i, p)
    helps = i in known.members and status not in (CERTAIN, LIKELY)
    sizes = about.size(i) or row.size
    if status in (HIDDEN, REFUTED):  # nobody looked below
        least = least_tried(effect)
        sizes = {c: replace(s, high=max(s.high, least)) for c, s in sizes.items()}
    value = next(iter(sizes.values())).value if len(sizes) == 1 else 0.0
    words = effect.words(value) if effect.words is not None and value else row.words
    if effect.says is not None and value:
        words = effect.says(value, values)
    return replace(
        row,
        words=words,
        status=status,
        probability=p,
        size=sizes,
        rivals=rivals,
        helps=helps,
        factor=about.factor(i),
    )


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
    elif i in known.certain:
        return known.surest, ()
    elif i in decision.best or any(i in h.effects for h in known.rivals):
        rivals, is_best = _rivals_of(known, decision, i), i in decision.best
        is_named = is_best and (decision.verdict == "named" or p >= PROBABLE)
        return (LIKELY if is_named else UNTOLD), rivals
    if i in decision.forms and i not in decision.best:  # a wrong data sheet leads by far
        return REFUTED, (decision.forms[i],)
    if p >= POSSIBLE:
        return UNTOLD, (NOISE,)
    added = about.added(decision.best | known.members, i)
    if added >= KEEP_NATS:  # sets of so many causes were not fitted
        return UNTOLD, (REST,)
    visible = [s <= 1.5 * known.effects[i].typical for s in _smallest_visible(known, i).values()]
    return (REFUTED if added < -KEEP_NATS and any(visible) else HIDDEN), ()


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
    """Smallest visible size by component: at the plain model, or beside the best set if less.

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
    return {c: max(s, least_tried(effect)) for c, s in out.items()}


def _screened_size(known: CauseEvidence, i: int) -> dict[str, Interval]:
    """Size as the plain model's scores ask for it; no fit was made."""
    effect, k = known.effects[i], sum(len(e.components) for e in known.effects[:i])
    out = {}
    for c, component in enumerate(effect.components, start=k):
        value = float(known.screened.size[c])
        half = HALF_90 * float(known.screened.smallest_visible[c]) / VISIBLE
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
        half = HALF_90 * row.sd / row.prior_sd if row.prior_sd else 0.0
        status = known.surest if abs(row.pull) - half > row.limit else LIKELY
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
        note=f"data sheet: {read.prior_value:.4g} +- {read.prior_sd:.2g} (one standard deviation)",
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
        p = about.unknown_probability(u)
        if u in shown or (p >= PROBABLE and u not in known.judgment.refuted):
            is_verdict = decision.unknown is not None and decision.unknown.unknown == u
            status = CERTAIN if is_verdict and p >= SURE else LIKELY if p >= PROBABLE else UNTOLD
            named = tuple(known.effects[i].name for i in sorted(decision.best))
            rivals = named if status == UNTOLD else ()
            rows.append(
                CauseRow(cause.name, cause.name, UNKNOWN, status, p, {}, "-", rivals=rivals)
            )
    return rows
