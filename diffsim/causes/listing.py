"""Which causes of the library a system has: one rule for all kinds, by what its plant tells.

A row is offered where the plant has what it acts on, and where its facts allow (``over_time``,
``when``, ``unless``, ``not_for``). A number that is a base parameter already has no cause beside
it. The order is that of tables, rows and parts: commands group by group, instruments one after the
other, parts one after the other. It breaks ties between causes that say the same. After the members
of a kind, such as commands, come their exchanges and what all of them have alike (``ties``).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby

from diffsim.causes.catalogue import rows_in_order
from diffsim.causes.channel_groups import TURN, channel_groups
from diffsim.causes.commands import CommandGroup, cause_of_commands, say_in_unit
from diffsim.causes.plant import IN_TIME, LATE_RECORD, Place, Plant, Store
from diffsim.causes.ports import on_commands, on_numbers, on_numbers_between, on_readings
from diffsim.causes.readings import (
    Instrument,
    cause_of_readings,
    instrument_of,
    pace,
    with_ending,
)
from diffsim.causes.row import Row, spell_plainly
from diffsim.causes.ties import MAX_PAIRED, Member, pairs, ties
from diffsim.core.checked import checked
from diffsim.core.units import NO_UNIT, powers_of, to_si
from diffsim.identify.effect import Effect

RECORD = "record"  # what rows of the whole record are each of
PAIR = "pair"  # of commands or channels: what rows of exchanges are each of
_INERTIA = "F s^2/X"
_POWERS = {"X/s": 1.0, "1/s": 0.0, "(X)^0.5/s": 0.5}  # of the level in units of flows


@checked
def list_causes(plant: Plant) -> tuple[Effect, ...]:
    """Causes of a system, those of its table and of what that includes.

    Args:
        plant: What the system tells of itself.
    """
    found = [row for _, row in rows_in_order(plant.kind)]
    return tuple(
        effect for way, own in groupby(found, _way_of) for effect in _list_way(way, [*own], plant)
    )


def numbers_added(kind: str, parts: Mapping[str, Mapping[str, str]]) -> tuple[str, ...]:
    """Numbers that rows of a kind of system add to: zero, where no quantity has their name.

    Args:
        parts: Parts that are alike, as of ``Plant``.
    """
    filled = (own for _, row in rows_in_order(kind) for _, own in row.of_parts(parts))
    return tuple(dict.fromkeys(name for row in filled for name in row.add))


def is_offered(row: Row, plant: Plant, facts: Mapping[str, bool]) -> bool:
    """Whether a row suits a system.

    Args:
        facts: What holds of the part that the row acts on, beside the facts of the plant.
    """
    known = {**plant.facts, **facts}
    return (
        plant.kind not in row.not_for
        and (not row.over_time or bool(known.get(IN_TIME)))
        and all(known.get(fact) for fact in row.when)
        and not any(known.get(fact) for fact in row.unless)
    )


def _way_of(row: Row) -> str:
    """What stands side by side in a list: rows of one way are asked part after part."""
    if row.each is not None and row.each != PAIR:
        return {"command": "commands", "place": "force"}.get(row.each, f"each {row.each}")
    return {"command": "commands", "reading": "readings", "clock": "readings"}.get(row.at, row.at)


def _list_way(way: str, found: Sequence[Row], plant: Plant) -> Iterator[Effect]:
    if way == "commands":
        yield from _list_of_commands(found, plant)
    elif way == "readings":
        yield from _list_of_readings(found, plant)
    elif way == f"each {RECORD}":
        yield from _list_in_record(found, plant)
    elif way == "force":
        yield from _list_at_places(found, plant)
    elif way == "store":
        yield from _list_of_stores(found, plant)
    else:
        yield from _list_of_parts([r for r in found if is_offered(r, plant, {})], plant)


def _with_ties(members: Iterable[Member], what: str) -> Iterator[Effect]:
    """Causes of members, then those of all of them alike."""
    known = list(members)
    yield from (member.effect for member in known)
    yield from ties(known, what)


def _list_of_commands(found: Sequence[Row], plant: Plant) -> Iterator[Effect]:
    alone = [row for row in found if row.each != PAIR]
    members = (
        Member(row.name, frozenset(group.names), group.unit, effect)
        for group in plant.ways
        for row, effect in _list_on_the_way(alone, group, plant)
    )
    yield from _with_ties(members, "all_commands")
    for group in _list_single_commands(plant):
        yield from (effect for _, effect in _list_on_the_way(alone, group, plant))
    yield from _list_of_pairs(found, command_pairs(plant), plant)


def _list_single_commands(plant: Plant) -> Iterator[CommandGroup]:
    """Each command of those that go the same way, where these are few."""
    for group in plant.ways:
        for name in group.names if 1 < len(group.names) <= MAX_PAIRED else ():
            own = plant.scales.of_commands((name,))
            yield replace(
                group,
                names=(name,),
                scales={**group.scales, **own},
                is_one_sided=plant.scales.is_one_sided((name,)),
                ending=f"_of_{spell_plainly(name)}",
            )


def _list_on_the_way(
    found: Sequence[Row], group: CommandGroup, plant: Plant
) -> Iterator[tuple[Row, Effect]]:
    facts = {"one_sided": group.is_one_sided, **dict.fromkeys(group.facts, True)}
    for row in found:
        if not is_offered(row, plant, facts):
            continue
        if row.at == "command":
            effect = cause_of_commands(row, group, system=plant.kind)
        else:
            usual = {**plant.magnitudes, **group.scales}
            apply = plant.functions[row.name](*group.names, row.name + group.ending)
            effect = row.effect(apply, usual, system=plant.kind, ending=group.ending)
            effect = say_in_unit(effect, row, group)
        yield row, pace(effect, group.sample_s)


def _list_of_readings(found: Sequence[Row], plant: Plant) -> Iterator[Effect]:
    alone = [row for row in found if row.each != PAIR]
    members = [
        replace(member, effect=pace(member.effect, plant.sample_s))
        for member in _list_in_instruments(alone, plant)
    ]
    yield from (member.effect for member in members)
    # a record that is late as a whole is an instrument of its own
    yield from ties([m for m in members if m.effect.unit != "s"], "all_sensors")
    yield from _list_of_pairs(found, channel_pairs(plant), plant)


def _list_of_pairs(
    found: Sequence[Row], exchanged: Sequence[tuple[str, str]], plant: Plant
) -> Iterator[Effect]:
    for row in found:
        if row.each == PAIR and is_offered(row, plant, {}):
            for pair in exchanged:
                places = [plant.channel_names.index(n) for n in pair if row.at == "reading"]
                yield row.effect(
                    on_readings(row, places) if places else on_commands(row, pair),
                    plant.magnitudes,
                    system=plant.kind,
                    ending=f"_of_{'_and_'.join(map(spell_plainly, pair))}",
                )


def command_pairs(plant: Plant) -> tuple[tuple[str, str], ...]:
    """Commands of one unit that somebody may have exchanged."""
    return tuple(pairs({name: g.unit for g in plant.ways for name in g.names}))


def channel_pairs(plant: Plant) -> tuple[tuple[str, str], ...]:
    """Channels of one sensor, kind and unit that somebody may have exchanged."""
    watched = (c for c in plant.channels if c.name not in plant.unwatched and c.kind != TURN)
    return tuple(pairs({c.name: f"{c.sensor} {c.kind} {c.unit}" for c in watched}))


def _list_in_instruments(found: Sequence[Row], plant: Plant) -> Iterator[Member]:
    for instrument in plant.instruments or ():
        for row in found:
            if row.name in instrument.causes and is_offered(row, plant, {}):
                yield _member_of_readings(row, instrument, plant)
    if plant.instruments is not None:
        return
    late = bool(plant.facts.get(LATE_RECORD))
    watched = [c for c in plant.channels if c.name not in plant.unwatched]
    for group in channel_groups(watched, late_record=late):
        of = instrument_of(group, plant.channels, plant.scales)
        facts = {"known_clock": group.channels in plant.clocks}
        for row in found:
            if row.name in group.causes and is_offered(row, plant, facts):
                named = with_ending(of, row.name, group, watched)
                yield _member_of_readings(row, named, plant)


def _member_of_readings(row: Row, of: Instrument, plant: Plant) -> Member:
    effect = cause_of_readings(row, of, system=plant.kind)
    return Member(row.name, frozenset(c.name for c in of.channels), of.unit, effect)


def _list_in_record(found: Sequence[Row], plant: Plant) -> Iterator[Effect]:
    of = plant.record
    for row in found:
        if of is not None and row.name in of.causes and is_offered(row, plant, {}):
            yield cause_of_readings(row, of, system=plant.kind)


def _list_at_places(found: Sequence[Row], plant: Plant) -> Iterator[Effect]:
    """Forces on the whole, by the system's own functions; others at each place."""
    of_whole = [row for row in found if row.name in plant.functions and row.each is None]
    for row in of_whole:
        if is_offered(row, plant, {}):
            yield row.effect(
                plant.functions[row.name],
                plant.magnitudes,
                system=plant.kind,
                unit=_say_unit(row.unit, "N", "m"),
            )
    at_places = [row for row in found if row not in of_whole]
    members = (
        Member(row.name, frozenset((name,)), place.unit, effect)
        for name, place in plant.places.items()
        for row, effect in _list_at_place(at_places, name, place, plant)
    )
    yield from _with_ties(members, "all_places")


def _list_at_place(
    found: Sequence[Row], name: str, place: Place, plant: Plant
) -> Iterator[tuple[Row, Effect]]:
    facts = dict.fromkeys(place.facts, True)
    ending = f"_at_{spell_plainly(name)}" if place.ending is None else place.ending
    for row in found:
        if not is_offered(row, plant, facts):
            continue
        of_place = row.model_copy(update={"name": row.name + ending})
        effect = row.effect(
            plant.push(of_place, name)
            if row.at == "force"
            else plant.functions[row.name](name, of_place.name),
            place.magnitudes,
            system=plant.kind,
            ending=ending,
            unit=_say_unit(row.unit, place.unit, place.length),
        )
        yield row, effect


def _say_unit(pattern: str, force: str, length: str) -> str:
    """A unit with that of the force in place of F, and that of the position in place of X."""
    if pattern == _INERTIA and force == "N":
        return "kg"
    if length == "-":
        pattern = pattern.split("/X")[0].replace("X", "-")
    if force != f"{length}/s^2":
        return pattern.replace("F", force).replace("X", length)
    if pattern == _INERTIA:
        return NO_UNIT
    said = pattern.replace("/F", " s^2/X").replace("F", "X/s^2").replace("X", length)
    return to_si(said).unit  # an acceleration divides to less


def _list_of_stores(found: Sequence[Row], plant: Plant) -> Iterator[Effect]:
    for name, store in plant.stores.items():
        for row in found:
            assert plant.flow is not None
            yield row.effect(
                plant.flow(row.model_copy(update={"name": row.name + store.ending}), name),
                store.magnitudes,
                system=plant.kind,
                ending=store.ending,
                unit=_unit_in_store(row.unit, store),
                masks=row.said("masks", plant.kind),
            )


def _unit_in_store(pattern: str, store: Store) -> str:
    """A unit with that of the level in place of X; of a flow times the area that divides it."""
    if pattern not in _POWERS or store.area is None:
        is_flow = pattern in _POWERS and store.unit == NO_UNIT
        return "1/s" if is_flow else pattern.replace("X", store.unit)
    if store.area == NO_UNIT:
        return NO_UNIT
    powers = dict(powers_of(store.area))
    for name, power in powers_of(store.unit).items() if store.unit != NO_UNIT else ():
        powers[name] = powers.get(name, 0.0) + _POWERS[pattern] * power
    said = (n if p == 1 else f"{n}^{p:g}" for n, p in powers.items() if p)
    return f"{' '.join(said)}/s"


def _list_of_parts(found: Sequence[Row], plant: Plant) -> Iterator[Effect]:
    """Rows at numbers and of a system's own functions, part after part."""
    each = [list(row.of_parts(plant.parts)) for row in found]
    tied = dict[str, list[Member]]()
    for k in range(max(map(len, each), default=0)):
        for row, parts in zip(found, each, strict=True):
            if k < len(parts):
                ending, filled = parts[k]
                effect = _cause_of_part(row, filled, ending, plant)
                if effect is not None:
                    yield effect
                    if row.at == "number" and row.each is not None:
                        own = Member(row.name, frozenset((ending,)), None, effect)
                        tied.setdefault(row.each, []).append(own)
    for kind, members in tied.items():
        yield from ties(members, f"every_{kind}")


def _cause_of_part(row: Row, filled: Row, ending: str, plant: Plant) -> Effect | None:
    """The cause of one part, or of the whole system; None: the system does not have it."""
    usual, system = plant.magnitudes, plant.kind
    if row.at == "command":
        assert row.each is not None
        name = plant.parts[row.each][ending.removeprefix("_")]
        return row.effect(on_commands(row, (name,)), usual, system=system, ending=ending)
    if row.at == "number" and row.name not in plant.functions:
        numbers = filled.add or filled.scale
        if any(n not in plant.numbers for n in numbers):
            return None
        if row.per is None:
            if any(n in plant.fitted for n in numbers):
                return None
            return filled.effect(on_numbers(filled), usual, system=system, ending=ending)
        if plant.sessions is None:
            return None
        apply, sizes = on_numbers_between(filled, plant.sessions)
        return filled.effect(apply, usual, system=system, ending=ending, components=sizes)
    exact = plant.functions.get(row.name + ending)
    if exact is not None:
        return filled.effect(exact, usual, system=system, ending=ending)
    made = plant.functions.get(row.name)
    if made is None or row.each is None:
        return None
    part = plant.parts[row.each][ending.removeprefix("_")]
    own = made(part, row.name + ending)
    return filled.effect(own, usual, system=system, ending=ending)
