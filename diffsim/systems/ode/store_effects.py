"""Causes at a store: leaks, outflow through a hole, spilling over, a flow that nobody recorded."""

from __future__ import annotations

import numpy as np

from diffsim.causes.catalogue import rows
from diffsim.causes.row import Row
from diffsim.core.expression import Expression, parse_expression
from diffsim.identify.effect import Effect
from diffsim.systems.ode.applying import by_formulas, symbol
from diffsim.systems.ode.keys import Store
from diffsim.systems.ode.library import SHARE_OF_USUAL, Library, StoreScale
from diffsim.systems.ode.network import Change, filled, named

SPILL_TIME_SHARE = 0.01  # of the time in which the usual rate fills the usual level
ROUND = 1e-3  # of the usual level: where the root is straightened
FLOWS_ON = ("root_outflow", "overflow")  # what the next store gains


def store_effects(library: Library) -> tuple[Effect, ...]:
    """Flows into and out of every store of a system."""
    out = []
    for store, scale in library.stores:
        ending = f"_of_{store.name}" if len(library.stores) > 1 or store.unit != "-" else ""
        out += [_add_flow(library, store, scale, row, ending) for row in rows("store").values()]
    return tuple(out)


def _add_flow(library: Library, store: Store, scale: StoreScale, row: Row, ending: str) -> Effect:
    name = row.name + ending
    share = None
    if row.name == "overflow" and store.spill_share is not None:
        share = named(spilled(store))
    gain = filled(parse_expression(row.said("law")), _list_letters(library, store, scale, name))
    rates = _move_content(library, store, gain, row.name in FLOWS_ON, share)
    unit = row.unit.replace("X", store.unit)
    if store.unit == "-":
        unit = {"X/s": "1/s", "(X)^0.5/s": "1/s"}.get(row.unit, unit)
    scales = {"flow": SHARE_OF_USUAL * scale.rate, "level": scale.level}
    apply = by_formulas(Change(rates=rates), symbol(name))
    return row.effect(apply, scales, ending=ending, unit=unit, masks=row.said("masks"))


def _list_letters(
    library: Library, store: Store, scale: StoreScale, name: str
) -> dict[str, Expression]:
    """What the letters of a store's law stand for."""
    # water stands over a rim by little; what is quicker than the samples would be stiff
    quickest = min(float(np.median(np.diff(run.time_s))) for run in library.study.runs)
    numbers = {
        "high": scale.high,
        "quick": min(scale.rate / scale.level / SPILL_TIME_SHARE, 1.0 / quickest),
        "straight": ROUND * scale.level,
    }
    level = {"h": named(store.level), "empty": parse_expression(repr(store.empty))}
    return {
        **level,
        "size": named(symbol(name)),
        "depth": filled(parse_expression("max(h - empty, 0)"), level),
        **{letter: parse_expression(repr(value)) for letter, value in numbers.items()},
    }


def spilled(store: Store) -> str:
    """Name of the share of what spills over that reaches the next store."""
    return f"spill_share_of_{store.name}"


def _move_content(
    library: Library,
    store: Store,
    gain: Expression,
    flows_on: bool,
    share: Expression | None = None,
) -> dict[str, Expression]:
    """Terms of rates from what a store gains; the store it flows into gets what this one loses, or
    a share of it."""
    areas = {"gain": gain, "own": parse_expression(store.area, library.system.known)}
    rates = {store.level: filled(parse_expression("gain/own"), areas)}
    into = next((s for s, _ in library.stores if s.name == store.into), None)
    if flows_on and into is not None:
        areas["other"] = parse_expression(into.area, library.system.known)
        passed = (
            parse_expression("-gain/other") if share is None else parse_expression("-k*gain/other")
        )
        rates[into.level] = filled(passed, areas | ({} if share is None else {"k": share}))
    return rates
