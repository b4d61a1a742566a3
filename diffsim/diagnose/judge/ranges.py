"""Intervals of all that an extended model holds, for its file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from diffsim.data.study import Run
from diffsim.diagnose.judge.averaging import MODEL_FORM, widening
from diffsim.diagnose.judge.data_sheet import base_rows
from diffsim.diagnose.judge.records import EFFECT, HALF_LEVEL, BaseRow, CauseRow, Interval
from diffsim.identify import Fit
from diffsim.identify.effect import Effect, effect_coordinates
from diffsim.identify.ranges import Range


def ranges_of_answer(
    fit: Fit, base: Sequence[BaseRow], causes: Sequence[CauseRow]
) -> dict[str, Range]:
    """Intervals as an answer states them, by name of parameter or component, each in its unit.

    Args:
        fit: Fit of the extended model.
        base: Its base parameters.
        causes: All causes.
    """
    return _ranges(fit, base, {row.name: row.size for row in causes if row.origin == EFFECT})


def _ranges(
    fit: Fit, base: Sequence[BaseRow], sizes: Mapping[str, Mapping[str, Interval]]
) -> dict[str, Range]:
    """Intervals by name, of sizes by name of the cause and of its component."""
    stated: dict[str, BaseRow | Interval] = {row.name: row for row in base}
    for effect in fit.problem.effects:
        own = sizes.get(effect.name, {})
        names = effect_coordinates([effect])
        stated |= {n: own[c] for n, c in zip(names, effect.components, strict=True) if c in own}
    return {
        name: _around(fit.values[name], stated[name].low, stated[name].high)
        for name in fit.values
        if name in stated
    }


def ranges_of_fit(fit: Fit, runs: Sequence[Run]) -> dict[str, Range]:
    """Intervals of one fit, widened to the spread over fits without a part of the runs.

    Args:
        fit: Fit of the extended model, whose causes were chosen before.
        runs: Runs that were fitted.
    """
    wider = widening(fit)
    rows = base_rows(fit, runs, wider, judged=False)
    sizes = {e.name: _sizes(fit, e, wider.factors, wider.usual) for e in fit.problem.effects}
    return _ranges(fit, rows, sizes)


def _sizes(
    fit: Fit, effect: Effect, factors: Mapping[str, float], usual: float
) -> dict[str, Interval]:
    """Sizes of an effect by component, their normals widened."""
    out = {}
    for name, component in zip(effect_coordinates([effect]), effect.components, strict=True):
        value = fit.values[name]
        half = HALF_LEVEL * np.hypot(fit.sd[name] * factors.get(name, usual), MODEL_FORM * value)
        low = value - half if effect.signed else max(value - half, 0.0)
        out[component] = Interval(value, float(low), float(value + half))
    return out


def _around(value: float, low: float, high: float) -> Range:
    return Range(value, min(low, value), max(high, value))
