"""Causes that a user adds to any system, by the same rows as the library's own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

from pydantic import Field, model_validator

from diffsim.causes.acting import ByFormula
from diffsim.causes.formulas import (
    Formula,
    MemoryKeys,
    ShapeKeys,
    constants_of,
    fitted_shapes,
    parse_formula,
    signals_of,
)
from diffsim.causes.plant import Plant
from diffsim.causes.ports import (
    OF_FORCES,
    OF_SIGNALS,
    on_clock,
    on_commands,
    on_numbers,
    on_place,
    on_readings,
)
from diffsim.causes.row import ANY, Row
from diffsim.causes.signals import MAPS
from diffsim.core.check import did_you_mean
from diffsim.core.checked import checked
from diffsim.core.errors import Mistakes
from diffsim.core.schema import Names
from diffsim.data.study import Study
from diffsim.identify.effect import Apply, Effect


class OwnRow(Row):
    """A cause of your own; ``at`` says through which port it acts."""

    kind: Literal["force", "actuator", "sensor", "material", "environment"] | None = Field(  # type: ignore[assignment]  # said by the port where nobody states it
        None, description="Where the cause lies; default: as its port says"
    )
    of: Names = Field(
        (),
        description="Commands or channels that it changes alike, or the place of a force; default: "
        "all commands or channels",
    )
    memories: dict[str, MemoryKeys] = Field(
        {}, description="What a map remembers, by the names that it uses"
    )
    shapes: dict[str, ShapeKeys] = Field(  # type: ignore[assignment]  # of numbers alone
        {}, description="Further numbers of the formula, fitted where they have an `sd`"
    )
    price: float = Field(0.0, ge=0, description="Nats that its choice among other formulas costs")

    @model_validator(mode="after")
    def _has_a_formula(self) -> OwnRow:
        text = self.map or self.law
        is_named = self.at in ("command", "reading") and text is not None and text[ANY] in MAPS
        if (self.memories or self.shapes) and (text is None or is_named):
            raise ValueError("memories and shapes are of a formula; write one under map or law")
        if self.memories and self.at not in ("command", "reading"):
            raise ValueError(f"a cause at a {self.at} remembers nothing; leave memories out")
        return self


_KINDS = {
    "command": "actuator",
    "reading": "sensor",
    "clock": "sensor",
    "number": "material",
    "force": "force",
}


@checked
def own_causes(rows: Sequence[OwnRow], plant: Plant, study: Study) -> tuple[Effect, ...]:
    """Effects of rows that a study states under ``effects.own``.

    Args:
        rows: Rows of the study's own causes.
        plant: What the system offers.
        study: Study that states them.

    Raises:
        ValueError: rows that name what there is not; a line for each.
    """
    wrong = [
        line for i, row in enumerate(rows) for line in _mistakes(f"effects.own[{i}]", row, plant)
    ]
    if wrong:
        raise Mistakes(wrong)
    return tuple(_effect(row, plant, study) for row in rows)


def _list_offered_names(row: OwnRow, plant: Plant) -> Sequence[str]:
    """Names that a row's ``of``, ``add`` or ``scale`` may use."""
    return {
        "command": tuple(plant.commands),
        "reading": plant.channel_names,
        "clock": plant.channel_names if plant.is_in_time else (),
        "number": plant.numbers,
        "force": tuple(plant.places),
    }.get(row.at, ())


def _mistakes(where: str, row: OwnRow, plant: Plant) -> Iterator[str]:
    known = _list_offered_names(row, plant)
    if not known:
        yield f"{where}.at: this system has no {row.at} for causes of your own"
        return
    for name in row.add or row.scale or row.of:
        if name not in known:
            yield (
                f"{where}: no {row.at} {name!r}{did_you_mean(name, known)}; "
                f"known: {', '.join(known)}"
            )
    taken = {"force": OF_FORCES, "number": ("size",)}.get(row.at, OF_SIGNALS)
    for name in (*row.shapes, *row.memories):
        if name in taken:
            yield f"{where}: {name!r} is a letter of formulas of a {row.at}; call it otherwise"
    if row.at == "number" and row.of:
        yield f"{where}.of: a cause of numbers names them under add or scale; leave of out"
    if row.at == "force" and len(row.of) != 1:
        yield f"{where}.of: name the one place at which the force acts; known: {', '.join(known)}"


def _effect(row: OwnRow, plant: Plant, study: Study) -> Effect:
    stated = row if row.kind is not None else row.model_copy(update={"kind": _KINDS[row.at]})
    apply, scales, unit = _acts(stated, plant, study)
    own: dict[str, Any] = {"price": row.price, "shapes": fitted_shapes(row.shapes, row.name)}
    if unit is not None and row.unit in ("command", "channel"):
        own["unit"] = unit
    return stated.effect(apply, scales, **own)


def _acts(row: OwnRow, plant: Plant, study: Study) -> tuple[Apply, Mapping[str, float], str | None]:
    """How a row acts, the magnitudes that it may use, and the unit of what it changes."""
    if row.at == "command":
        return _acts_on_commands(row, plant, study)
    if row.at in ("reading", "clock"):
        return _acts_on_channels(row, plant, study)
    if row.at == "force":
        place = row.of[0]
        if plant.push is not on_place:  # the system writes it into its formulas
            return plant.push(row, place), plant.places[place].magnitudes, None
        formula = _read(row, row.said("law"), (*OF_FORCES, *constants_of(study)), {})
        return _by(formula, row).at_place(place), plant.places[place].magnitudes, None
    if row.map is None:
        return on_numbers(row), {}, None
    formula = _read(row, row.said("map"), ("size", *constants_of(study)), {})
    return _by(formula, row).at_numbers(row.add or row.scale, is_factor=bool(row.scale)), {}, None


def _acts_on_commands(
    row: OwnRow, plant: Plant, study: Study
) -> tuple[Apply, Mapping[str, float], str | None]:
    names = row.of or tuple(plant.commands)
    scales = plant.scales.of_commands(names)
    units = {c.unit for c in study.commands if c.name in names}
    if row.said("map") in MAPS:
        apply = on_commands(row, names, scales, plant.commands[names[0]])
    else:
        known = (*OF_SIGNALS, *constants_of(study), *signals_of(study))
        apply = _by(_read(row, row.said("map"), known, scales), row).at_commands(names)
    return apply, scales, units.pop() if len(units) == 1 else None


def _acts_on_channels(
    row: OwnRow, plant: Plant, study: Study
) -> tuple[Apply, Mapping[str, float], str | None]:
    names = row.of or plant.channel_names
    scales = plant.scales.of_channels(names)
    places = [plant.channel_names.index(name) for name in names]
    units = {study.channels[i].unit for i in places}
    if row.at == "clock":
        apply = on_clock(places)
    elif row.said("map") in MAPS:
        apply = on_readings(row, places, scales)
    else:
        known = (*OF_SIGNALS, *constants_of(study), *signals_of(study), *plant.channel_names)
        formula = _read(row, row.said("map"), known, scales)
        apply = _by(formula, row).at_readings(places, plant.channel_names)
    return apply, scales, units.pop() if len(units) == 1 else None


def _read(row: OwnRow, text: str, known: Sequence[str], scales: Mapping[str, float]) -> Formula:
    return parse_formula(text, known, scales, row.memories, row.shapes)


def _by(formula: Formula, row: OwnRow) -> ByFormula:
    fitted = tuple(name for name, s in row.shapes.items() if s.sd is not None)
    return ByFormula(formula, fitted, len(row.components), row.said("kink"))
