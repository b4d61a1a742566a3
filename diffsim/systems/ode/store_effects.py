"""Causes at a store: leaks, outflow through a hole, spilling over, a flow that nobody recorded."""

from __future__ import annotations

import numpy as np

from diffsim.core.expression import Expression, parse_expression
from diffsim.identify.effect import Effect
from diffsim.systems.ode.applying import by_formulas, symbol
from diffsim.systems.ode.keys import Store
from diffsim.systems.ode.library import Library, StoreScale
from diffsim.systems.ode.network import Change, filled, named

SHARE = 0.1  # of the usual rate that a cause may be without surprise
SPILL_TIME_SHARE = 0.01  # of the time in which the usual rate fills the usual level
ROUND = 1e-3  # of the usual level: where the root is straightened


def store_effects(library: Library) -> tuple[Effect, ...]:
    """Flows into and out of every store of a system."""
    out = []
    for store, scale in library.stores:
        tail = f"_of_{store.name}" if len(library.stores) > 1 or store.unit != "-" else ""
        out += _effects(library, store, scale, tail)
    return tuple(out)


def _effects(library: Library, store: Store, scale: StoreScale, tail: str) -> list[Effect]:
    level, flow = scale.level, SHARE * scale.rate
    unit = store.unit
    depth = f"max(h - {store.empty!r}, 0)"
    return [
        _flow(
            library,
            store,
            "linear_leak" + tail,
            f"-size*{depth}",
            form="Lost in proportion to the level, size per second.",
            unit="1/s",
            typical=flow / level,
            signed=False,
        ),
        _flow(
            library,
            store,
            "root_outflow" + tail,
            # a root that is straight close to zero, so that it has a slope there
            f"-size*{depth}/sqrt({depth} + {ROUND * level!r})",
            form="Lost through a hole: size times the root of the level.",
            unit="1/s" if unit == "-" else f"({unit})^0.5/s",
            typical=flow / level**0.5,
            signed=True,
            flows_on=True,
        ),
        _flow(
            library,
            store,
            "extra_inflow" + tail,
            "size",
            form="A flow of size that nobody recorded.",
            unit="1/s" if unit == "-" else f"{unit}/s",
            typical=flow,
            signed=True,
        ),
        _spill(library, store, scale, tail),
    ]


def _flow(
    library: Library,
    store: Store,
    name: str,
    flow: str,
    *,
    form: str,
    unit: str,
    typical: float,
    signed: bool,
    flows_on: bool = False,
) -> Effect:
    parts = {"h": named(store.level), "size": named(symbol(name))}
    gain = filled(parse_expression(flow), parts)
    return Effect(
        name=name,
        form=form,
        family="flow",
        kind="environment",
        unit=unit,
        typical=typical,
        signed=signed,
        also_looks_like=("gain of the pump, at one level",),
        apply=by_formulas(Change(rates=_moved(library, store, gain, flows_on)), symbol(name)),
    )


def _spill(library: Library, store: Store, scale: StoreScale, tail: str) -> Effect:
    name = "overflow" + tail
    # water stands over a rim by little; what is quicker than the samples would be stiff
    quickest = min(float(np.median(np.diff(run.time_s))) for run in library.study.runs)
    per_s = min(scale.rate / scale.level / SPILL_TIME_SHARE, 1.0 / quickest)
    parts = {
        "h": named(store.level),
        "size": named(symbol(name)),
        "high": parse_expression(repr(scale.high)),
        "quick": parse_expression(repr(per_s)),
    }
    gain = filled(parse_expression("-quick*max(h - (high - size), 0)*(size > 0)"), parts)
    share = named(spilled(store)) if store.spill_share is not None else None
    rates = _moved(library, store, gain, flows_on=True, share=share)
    return Effect(
        name=name,
        form="Spills over at a level that lies size below the highest of the plain model.",
        family="limit",
        kind="environment",
        unit=store.unit,
        typical=0.2 * scale.level,
        signed=False,
        smooth=False,
        masks=("overflow", "exponent", "sensor_curvature"),
        also_looks_like=("outflow that grows faster than the root", "limit of the sensor"),
        apply=by_formulas(Change(rates=rates), symbol(name)),
    )


def spilled(store: Store) -> str:
    """Name of the share of what spills over that reaches the next store."""
    return f"spill_share_of_{store.name}"


def _moved(
    library: Library,
    store: Store,
    gain: Expression,
    flows_on: bool,
    share: Expression | None = None,
) -> dict[str, Expression]:
    """Terms of rates from what a store gains; the store it flows into gets what this one loses, or
    a share of it."""
    areas = {"gain": gain, "own": parse_expression(store.area, library.known)}
    rates = {store.level: filled(parse_expression("gain/own"), areas)}
    into = next((s for s, _ in library.stores if s.name == store.into), None)
    if flows_on and into is not None:
        areas["other"] = parse_expression(into.area, library.known)
        passed = (
            parse_expression("-gain/other") if share is None else parse_expression("-k*gain/other")
        )
        rates[into.level] = filled(passed, areas | ({} if share is None else {"k": share}))
    return rates
