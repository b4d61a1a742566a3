"""Rows of the report's tables: candidates by evidence, weighed sets, and what cannot be seen."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.core.figures import figure, percent
from diffsim.diagnose.checks.numerics import numerical_shift
from diffsim.diagnose.judge.averaging import MODEL_FORM
from diffsim.diagnose.judge.gain import Gain
from diffsim.diagnose.judge.judge import Decision, Judgment
from diffsim.diagnose.judge.own_values import words_of
from diffsim.diagnose.say.wording import MOST_LISTED
from diffsim.diagnose.search.evidence import (
    TIE_DIGITS,
    VISIBLE,
    Hypothesis,
    Screen,
    SetPosterior,
    twins_of,
)
from diffsim.diagnose.search.fitted_sets import Search
from diffsim.identify import Fit
from diffsim.identify.effect import PRIOR_WIDTH, Effect, effect_coordinates
from diffsim.identify.unknown import Unknown

BLIND = 3.0  # smallest visible size over the typical one
FIRST_LOOK = "first look"  # stage of a diagnosis that says what stands out before any set is fitted


def first_look(screened: Screen, effects: Sequence[Effect], chi2: float) -> str:
    """What stands out at the plain fit, before any set of causes is fitted, in a sentence.

    Args:
        screened: Scores of all candidates there.
    """
    share = screened.block_z**2 / chi2
    first = [i for i in np.argsort(-share, kind="stable") if screened.block_z[i] >= VISIBLE]
    said = [f"{words_of(effects[i].name)} {percent(share[i])}" for i in first[:MOST_LISTED]]
    found = "no cause alone stands out of the noise"
    if said:
        found = f"each alone would take of the misfit: {', '.join(said)}"
    return f"A first look by slopes, no answer yet: {found}."


@checked(kinds_only=True)
@dataclass(frozen=True)
class EffectRow:
    """One candidate cause in the table.

    Attributes:
        effect, family, kind, unit: Name, family, kind and unit of the effect.
        status: "named", "rival", "mimic" (explains part of an unknown cause), "withdrawn" (the
            evidence asked for it, unseen runs refuted it), "screened", or "not judged".
        size: Size by component, in the effect's unit; from the refit where there was one, else from
            the screen.
        sd: Standard deviation of the sizes: statistical, numerical (shift under refined settings)
            and 1 % model form.
        nats: Evidence of the best hypothesis with this effect minus that of the best without it.
        z: Score over its standard deviation at the null fit, the length for a vector.
        smallest_visible: Smallest visible size by component, in the effect's unit: 6 /
            sqrt(information).
        gain: Gain on runs with use: select, or on fit runs left out, of having this effect in the
            best set; None if not computed.
        share: Share of the misfit, chi2_null - N, that this effect alone explains; None if it was
            not refitted alone.
        aliases: Physical causes that these data may not distinguish from it.
        note: Why it was not judged, or that its gain is not confirmed.
    """

    effect: str
    family: str
    kind: str
    unit: str
    status: str
    size: Mapping[str, float]
    sd: Mapping[str, float]
    nats: float | None
    z: float
    smallest_visible: Mapping[str, float]
    gain: Gain | None
    share: float | None
    aliases: tuple[str, ...]
    note: str = ""

    @checked
    def label(self, component: str) -> str:
        """Name of a component: the effect's own where it has only one."""
        return self.effect if len(self.size) == 1 else f"{self.effect}.{component}"


@checked(kinds_only=True)
@dataclass(frozen=True)
class HypothesisRow:
    """A set of effects, with or without a generic unknown cause.

    Attributes:
        effects: Names of the effects in the set.
        unknown: Name of the generic cause or wrong data sheet, or None.
        nats: Evidence relative to the plain model.
        chi2: |W (y - S)|^2, after the unknown cause's part.
        refitted: False: linear evidence of a set that is too far behind to be refitted.
    """

    effects: tuple[str, ...]
    unknown: str | None
    nats: float
    chi2: float
    refitted: bool = True


def effect_rows(
    effects: Sequence[Effect],
    judgment: Judgment,
    screened: Screen,
    changes: Mapping[str, Array],
    saved: Fit | None = None,
) -> tuple[EffectRow, ...]:
    """One row per effect, by evidence.

    Args:
        judgment: The verdict and the search behind it; no search: effects were only screened.
        changes: Change of the record by refining each numerical setting, (N,) each; it widens the
            intervals.
        saved: The extended model: sizes of its effects are those that it holds.
    """
    decision, search = judgment.decision, judgment.search
    in_rivals = {i for h in decision.rivals for i in h.effects}
    rows, k = [], 0
    for i, effect in enumerate(effects):
        c = slice(k, k + len(effect.components))
        k = c.stop
        size, sd = screened.size[c], np.full(len(effect.components), np.nan)
        nats = share = None
        if search is not None:
            nats = evidence_for(search, i)
            null, alone = search.fit_of(frozenset()), search.fits.get(frozenset({i}))
            missing = null.chi2 - null.num_samples
            if alone is not None and missing > 0.0:
                share = (null.chi2 - alone.chi2) / missing
            size, sd = _read_refit(search, decision, i, size, sd, changes)
        if saved is not None and effect in saved.problem.effects:
            size = np.array([saved.values[n] for n in effect_coordinates([effect])])
        gained = judgment.gains.get(i)
        note = "" if gained is None or gained.status == "confirmed" else gained.status
        twins = tuple(effects[k].name for k in twins_of(effects, screened, i))
        rows.append(
            EffectRow(
                effect=effect.name,
                family=effect.family,
                kind=effect.kind,
                unit=effect.unit,
                status=_status(i, decision, in_rivals, judgment.withdrawn),
                size=_by_component(effect, size),
                sd=_by_component(effect, np.hypot(sd, MODEL_FORM * size)),
                nats=nats,
                z=float(screened.block_z[i]),
                smallest_visible=_by_component(effect, screened.smallest_visible[c]),
                gain=gained,
                share=share,
                aliases=(*effect.also_looks_like, *twins),
                note="worse on unseen runs" if i in judgment.withdrawn else note,
            )
        )
    shown = [row.z if row.nats is None else row.nats for row in rows]
    order = sorted(range(len(rows)), key=lambda k: -round(shown[k], TIE_DIGITS))
    return tuple(rows[k] for k in order)


def evidence_for(search: Search, i: int) -> float:
    """Best evidence with an effect minus the best without it.

    Linear evidence stands for an effect that no refitted set holds.
    """
    plain = {h: w.nats for h, w in search.posteriors.items() if h.unknown is None}
    linear = {h: w.nats for h, w in search.linear.items() if i in h.effects}
    with_it = [n for h, n in plain.items() if i in h.effects] or list(linear.values())
    return max(with_it) - max(n for h, n in plain.items() if i not in h.effects)


def hypothesis_rows(
    search: Search | None,
    effects: Sequence[Effect],
    unknowns: Sequence[Unknown],
    instead: Mapping[frozenset[int], tuple[str, float]] | None = None,
) -> tuple[HypothesisRow, ...]:
    """Rows of all weighed sets: refitted ones best first, then the rest.

    Args:
        search: Sets that were weighed; None: nothing was searched.
        effects: Candidates, in the order of their indices.
        unknowns: Generic causes, in theirs.
        instead: Sets beside a wrong data sheet: its words and the evidence [nats].
    """
    if search is None:
        return ()
    base = search.nats(Hypothesis())

    def row(h: Hypothesis, posterior: SetPosterior, refitted: bool) -> HypothesisRow:
        return HypothesisRow(
            effects=tuple(effects[i].name for i in sorted(h.effects)),
            unknown=None if h.unknown is None else unknowns[h.unknown].name,
            nats=posterior.nats - base,
            chi2=posterior.chi2,
            refitted=refitted,
        )

    rows = [row(h, w, True) for h, w in search.posteriors.items()]
    rows += [row(h, w, False) for h, w in search.linear.items()]
    for members, (words, nats) in (instead or {}).items():
        plain = row(Hypothesis(members), search.posteriors[Hypothesis(members)], True)
        rows.append(replace(plain, unknown=words, nats=nats - base))
    return tuple(sorted(rows, key=lambda r: (not r.refitted, -round(r.nats, TIE_DIGITS))))


def cannot_see(
    effects: Sequence[Effect],
    screened: Screen,
    unmet: Mapping[str, str],
    rows: Sequence[EffectRow] = (),
) -> dict[str, str]:
    """Effects that these data could not show, and why.

    Args:
        unmet: What the study lacks for candidates that were left out, by name.
        rows: Candidates by evidence; those that were considered with a size have been seen.
    """
    seen = {row.effect for row in rows if row.status in ("named", "rival", "mimic", "withdrawn")}
    out = {name: f"not judged: {why}" for name, why in unmet.items()}
    names = effect_coordinates(effects)
    units = [(e.unit, e.typical) for e in effects for _ in e.components]
    owners = [e.name for e in effects for _ in e.components]
    for name, owner, (unit, typical), smallest in zip(
        names, owners, units, screened.smallest_visible, strict=True
    ):
        if owner in seen:
            continue
        if not np.isfinite(smallest):
            out[name] = "leaves no trace that the base parameters could not absorb"
        elif smallest > BLIND * typical:
            size = figure(smallest) if unit == "-" else f"{figure(smallest)} {unit}"
            out[name] = f"below {size} ({figure(smallest / typical)} times a usual size)"
    return out


def set_names(
    h: Hypothesis, effects: Sequence[Effect], unknowns: Sequence[Unknown]
) -> tuple[str, ...]:
    """Names of the effects in a hypothesis."""
    names = tuple(effects[i].name for i in sorted(h.effects))
    return names if h.unknown is None else (*names, unknowns[h.unknown].name)


def _read_refit(
    search: Search,
    decision: Decision,
    i: int,
    size: Array,
    sd: Array,
    changes: Mapping[str, Array],
) -> tuple[Array, Array]:
    """Size and sd from the best refit that holds the effect; the decision's set comes first."""
    holding = [h for h in search.posteriors if h.unknown is None and i in h.effects]
    if not holding:
        return size, sd
    best = max(holding, key=lambda h: (h.effects == decision.best, search.nats(h)))
    fit = search.fit_of(best.effects)
    effect = search.wide.effects[i]
    names = effect_coordinates([effect])
    own = fit.problem.columns_of(effect)
    stretch = PRIOR_WIDTH * effect.typical * fit.problem.stretch(fit.x)[own]
    statistical = np.array([fit.sd[n] for n in names])
    fitted = np.array([fit.values[n] for n in names])
    return fitted, np.hypot(statistical, stretch * numerical_shift(fit, changes)[own])


def _status(i: int, decision: Decision, in_rivals: set[int], withdrawn: Set[int]) -> str:
    if i in withdrawn:
        return "withdrawn"
    if i in decision.best:
        return {"unknown": "mimic", "unrepeatable": "mimic"}.get(decision.verdict, "named")
    return "rival" if i in in_rivals else "screened"


def _by_component(effect: Effect, values: Iterable[float]) -> dict[str, float]:
    return {c: float(v) for c, v in zip(effect.components, values, strict=True)}
