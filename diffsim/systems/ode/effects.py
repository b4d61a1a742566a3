"""What a described system that moves tells of itself, and its candidate causes in their order."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from diffsim.causes.listing import list_causes
from diffsim.causes.plant import IN_TIME, LATE_RECORD, Place, Plant, Store
from diffsim.causes.readings import usual_sample
from diffsim.causes.row import Row
from diffsim.identify.effect import Apply, Effect
from diffsim.systems.ode import keys
from diffsim.systems.ode.differences import differences
from diffsim.systems.ode.event_effects import event_effects
from diffsim.systems.ode.input_effects import (
    between_samples,
    come_slowly,
    drift_in_order,
    follow_profile,
    input_ways,
)
from diffsim.systems.ode.joint_effects import (
    away_from_center,
    closed_loops,
    coupling_in_words,
    current_of,
    elastic_coupling,
    has_linear_drive,
    late_inside,
    limited_inside,
    loses_by_sign,
    made_larger,
    pose_of,
    without_gain,
)
from diffsim.systems.ode.law_effects import law_effects
from diffsim.systems.ode.library import SHARE_OF_USUAL, Library
from diffsim.systems.ode.place_effects import (
    add_inertia,
    magnitudes_at,
    push_at,
    pushed_by_inputs,
    stop_in_words,
)
from diffsim.systems.ode.refresh_effects import refresh_effects
from diffsim.systems.ode.slack_effects import slack_inside, unit_apart, usual_apart
from diffsim.systems.ode.store_effects import FLOWS_ON, flow_of

COUPLING = "elastic_coupling"
LIMIT, SLACK = "limit_inside", "slack_inside"
ODE = "ode"  # the kind of system, and its table


def ode_effects(library: Library, periods: Mapping[str, float]) -> tuple[Effect, ...]:
    """Causes by rule, then those of clocks, in time, of laws, and the user's own.

    Args:
        periods: Period of each channel's own clock [s]; 0 where there is none.
    """
    return (
        *(_say_well(effect, library) for effect in list_causes(plant_of(library))),
        *refresh_effects(library, periods),
        *event_effects(library),
        *law_effects(library),
        *library.system.own,
    )


def _say_well(effect: Effect, library: Library) -> Effect:
    """An elastic coupling and stops with words for their size, a limit and slack as what they are;
    other causes as they are."""
    for at, scale in library.places:
        for name, end, inward in (("stop_above", scale.high, -1.0), ("stop_below", scale.low, 1.0)):
            if effect.name in (name, f"{name}_at_{at.name}"):
                words = partial(stop_in_words, name, end, inward, at.position_unit)
                return replace(effect, words=words)
    if effect.name.startswith(f"{LIMIT}_"):
        of = effect.name.removeprefix(f"{LIMIT}_")
        # of a definition that is no place's force, such as a goal of a speed, nobody states a unit
        units = {place.unit for place, _ in library.places if place.force == of}
        unit = units.pop() if len(units) == 1 else "-"
        return replace(effect, shown_unit=unit, shown_times=library.usual[of], shown_power=-1)
    if effect.name.startswith(f"{SLACK}_"):
        of = effect.name.removeprefix(f"{SLACK}_")
        unit, times = unit_apart(library, of), usual_apart(library, of)
        return replace(effect, shown_unit=unit, shown_times=times)
    if not effect.name.startswith(COUPLING) or effect.members:
        return effect
    place = next(
        s for p, s in library.places if effect.name in (COUPLING, f"{COUPLING}_at_{p.name}")
    )
    said = partial(coupling_in_words, place.inertia, effect.name)
    return replace(effect, says=said)


def plant_of(library: Library) -> Plant:
    """What a system of formulas tells of itself."""
    system = library.system
    places = {place.name: (place, scale) for place, scale in library.places}
    stores = {store.name: (store, scale) for store, scale in library.stores}

    def push(row: Row, name: str) -> Apply:
        return push_at(library, *places[name], row)

    def flow(row: Row, name: str) -> Apply:
        return flow_of(library, *stores[name], row, row.name.startswith(FLOWS_ON))

    def inertia(place: str, name: str) -> Apply:
        return add_inertia(library, places[place][0], name)

    def coupling(place: str, name: str) -> Apply:
        return elastic_coupling(library, places[place][0], name)

    numbers = tuple(system.base.quantities)
    current, pose = current_of(library.study.channels), pose_of(library.study.channels)
    functions: dict[str, Any] = {
        "extra_inertia": inertia,
        COUPLING: coupling,
        "delay_inside": partial(late_inside, library),
        "gain_inside": partial(made_larger, library),
        LIMIT: partial(limited_inside, library),
        SLACK: partial(slack_inside, library),
        "slow_share": come_slowly,
        "held_between_samples": partial(between_samples, held=True),
        "straight_between_samples": partial(between_samples, held=False),
        "gain_drift": drift_in_order,
        # a command on its way, but one that is not held afterwards
        "acceleration_limit": partial(follow_profile, held=system.held),
    }
    if current is not None:
        found = partial(loses_by_sign, library=library, channel=current)
        functions["inverter_dead_time"] = found
    if pose is not None:
        functions["marker_offset"] = away_from_center(system.network, pose, "marker_offset")
    return Plant(
        kind=ODE,
        scales=library.scales,
        channels=library.study.channels,
        commands={name: "held" if held else "straight" for name, held in system.held.items()},
        ways=input_ways(library),
        numbers=numbers,
        places=_list_places(library),
        stores=_list_stores(library),
        facts={
            IN_TIME: True,
            LATE_RECORD: library.scales.facts["begins_moving"] or not system.held,
        },
        parts={
            "definition": {name: name for name in closed_loops(system.network)},
            "drive": {name: name for name in without_gain(system.network, numbers)},
            "difference": {name: name for name in differences(system.network)},
        },
        functions=functions,
        magnitudes={"runs": float(max(len({r.order for r in library.study.fit_runs}), 1))},
        clocks=frozenset(system.clocks.values()),
        sample_s=usual_sample(library.study.runs),
        push=push,
        flow=flow,
    )


def _list_places(library: Library) -> dict[str, Place]:
    found, network = {}, library.system.network
    for place, scale in library.places:
        # what drives it, and has an inertia of its own, may be apart from what moves there
        has_inertia = place.force in network.definitions and place.inertia != "1"
        is_driven = place.force is None or (has_inertia and has_linear_drive(network, place))
        pushed = place.force or pushed_by_inputs(library.system, place)
        is_plain = place.unit in ("N", "m/s^2") and place.position_unit == "m"
        is_plain &= len(library.places) == 1
        found[place.name] = Place(
            magnitudes_at(scale),
            # where a force is stated, other rates hold the inertia, too
            (
                *("distance", "speed"),
                *(("inertia",) if place.force is None else ()),
                *(("load",) if pushed else ()),
                *(("drive",) if is_driven else ()),
            ),
            place.unit,
            place.position_unit,
            "" if is_plain else f"_at_{place.name}",
        )
    return found


def _list_stores(library: Library) -> dict[str, Store]:
    found = {}
    for store, scale in library.stores:
        is_named = len(library.stores) > 1 or store.unit != "-"
        usual = {"flow": SHARE_OF_USUAL * scale.rate * scale.area, "level": scale.level}
        ending = f"_of_{store.name}" if is_named else ""
        found[store.name] = Store(usual, store.unit, ending, _unit_of_area(store))
    return found


def _unit_of_area(store: keys.Store) -> str | None:
    """Unit of what a flow is divided by; None: nothing is, "-": nobody says it."""
    if store.area.strip() == "1":
        return None
    return store.area_unit or ("m^2" if store.unit == "m" else "-")
