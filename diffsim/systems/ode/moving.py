"""Numbers that only systems that move ask for, and what their places, stores and events name."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from diffsim.core.check import did_you_mean
from diffsim.data.study import Study
from diffsim.systems.description import Quantity
from diffsim.systems.ode.described import DescribedMotion
from diffsim.systems.ode.event_effects import runs_of, timings
from diffsim.systems.ode.keys import FormulaKeys
from diffsim.systems.ode.names import Reader
from diffsim.systems.ode.place_effects import shapes
from diffsim.systems.ode.store_effects import spilled
from diffsim.systems.ode.swings import swing_quantities


def quantities_of_motion(motion: DescribedMotion, study: Study) -> dict[str, Quantity]:
    """Parameters of events, swings, stores and places."""
    given = dict[str, Quantity]()
    for events in motion.events:
        given |= timings(events, study)
    given |= swing_quantities(motion.swings)
    given |= {spilled(s): s.spill_share for s in motion.stores if s.spill_share is not None}
    for place in motion.places:
        given |= shapes(place)
    return given


def check_motion(
    motion: DescribedMotion,
    keys: FormulaKeys,
    inputs: Iterable[str],
    known: tuple[str, ...],
    reader: Reader,
) -> None:
    """Report places, stores, events and swings that name what is not there.

    Args:
        known: Names that formulas may use.
    """
    for key, kind, name, allowed in _list_references(motion, keys, tuple(inputs), reader.study):
        if name not in allowed:
            reader.report(key, f"no {kind} {name!r}{did_you_mean(name, allowed)}")
    for i, place in enumerate(motion.places):
        if place.position == place.velocity:
            reader.report(f"places[{i}].velocity", "is its position, too; name the other state")
        reader.parse(f"places[{i}].inertia", place.inertia, known)
    for i, store in enumerate(motion.stores):
        reader.parse(f"stores[{i}].area", store.area, known)
    for i, events in enumerate(motion.events):
        if not runs_of(events, reader.study):
            reader.report(f"events[{i}].where", "no run has these facts", "warning")


def _list_references(
    motion: DescribedMotion, keys: FormulaKeys, inputs: tuple[str, ...], study: Study
) -> Iterator[tuple[str, str, str, tuple[str, ...]]]:
    """Key, kind of what it must name, the name, and all names of that kind."""
    states = tuple(motion.states)
    for i, place in enumerate(motion.places):
        yield f"places[{i}].position", "state", place.position, states
        yield f"places[{i}].velocity", "state", place.velocity, states
        if place.force is not None:
            drives = (*keys.define, *inputs)
            yield f"places[{i}].force", "definition or input", place.force, drives
    for i, store in enumerate(motion.stores):
        yield f"stores[{i}].level", "state", store.level, states
        if store.into is not None:
            yield f"stores[{i}].into", "store", store.into, tuple(s.name for s in motion.stores)
    channels, places = (c.name for c in study.channels), (p.name for p in motion.places)
    entered = (*places, *inputs, *keys.define, *keys.tables, *channels)
    for i, events in enumerate(motion.events):
        for name in events.at:
            yield f"events[{i}].at", "place, input, definition or channel", name, entered
    for i, swing in enumerate(motion.swings):
        yield f"swings[{i}].of", "definition", swing.of, tuple(keys.define)
