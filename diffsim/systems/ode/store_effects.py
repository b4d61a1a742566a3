"""Causes at a store: leaks, outflow through a hole, spilling over, a flow that nobody recorded."""

from __future__ import annotations

import numpy as np

from diffsim.causes.row import Row
from diffsim.core.expression import Expression, parse_expression
from diffsim.identify.effect import Apply
from diffsim.systems.ode.applying import by_formulas, symbol
from diffsim.systems.ode.keys import Store
from diffsim.systems.ode.library import Library, StoreScale
from diffsim.systems.ode.network import Change, filled, named

SPILL_TIME_SHARE = 0.01  # of the time in which the usual rate fills the usual level
ROUND = 1e-3  # of the usual level: where the root is straightened
OVERFLOW = "overflow"
FLOWS_ON = ("root_outflow", OVERFLOW)  # what the next store gains


def flow_of(library: Library, store: Store, scale: StoreScale, row: Row, flows_on: bool) -> Apply:
    """How what a store gains enters the formulas.

    Args:
        store: What fills and empties.
        scale: Its usual magnitudes.
        row: Cause with ``at: store``, of the effect's name.
        flows_on: Whether the next store gains it.
    """
    share = None
    if row.name.startswith(OVERFLOW) and store.spill_share is not None:
        share = named(spilled(store))
    gain = filled(parse_expression(row.said("law")), _list_letters(library, store, scale, row.name))
    rates = _move_content(library, store, gain, flows_on, share)
    return by_formulas(Change(rates=rates), symbol(row.name))


def _list_letters(
    library: Library, store: Store, scale: StoreScale, name: str
) -> dict[str, Expression]:
    """What the letters of a store's law stand for."""
    # water stands over a rim by little; what is quicker than the samples would be stiff
    quickest = min(float(np.median(np.diff(run.time_s))) for run in library.study.runs)
    numbers = {
        "high": scale.high,
        "quick": scale.area * min(scale.rate / scale.level / SPILL_TIME_SHARE, 1.0 / quickest),
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
