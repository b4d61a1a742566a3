"""Causes that a user adds to any system, by the same rows as the library's own."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from pydantic import Field

from diffsim.causes.ports import on_clock, on_commands, on_numbers, on_place, on_readings
from diffsim.causes.row import Names, Row
from diffsim.causes.scales import Scales
from diffsim.causes.signals import Between
from diffsim.core.check import did_you_mean
from diffsim.core.errors import Mistakes
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


@dataclass(frozen=True)
class Ports:
    """What a described system offers to causes of a user.

    Attributes:
        scales: Usual magnitudes of the recordings.
        commands: What each command does between samples, by name.
        channels: Names of the channels, in order.
        has_clock: Whether channels may be late.
        numbers: Names of the numbers that may be changed.
        places: Names of the places at which forces may act, with their usual magnitudes: ``push``,
            ``distance``, ``speed``.
        push: Function (row, place) -> how a force acts; other than through the scene's port where
            a system writes forces into its formulas.
    """

    scales: Scales
    commands: Mapping[str, Between] = field(default_factory=dict)
    channels: tuple[str, ...] = ()
    has_clock: bool = False
    numbers: tuple[str, ...] = ()
    places: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    push: Callable[[Row, str], Apply] = on_place


_KINDS = {
    "command": "actuator",
    "reading": "sensor",
    "clock": "sensor",
    "number": "material",
    "force": "force",
}


def own_causes(rows: Sequence[OwnRow], ports: Ports, study: Study) -> tuple[Effect, ...]:
    """Effects of rows that a study states under ``effects.own``.

    Args:
        rows: Rows of the study's own causes.
        ports: What the system offers.
        study: Study that states them.

    Raises:
        ValueError: rows that name what there is not; a line for each.
    """
    wrong = [
        line for i, row in enumerate(rows) for line in _mistakes(f"effects.own[{i}]", row, ports)
    ]
    if wrong:
        raise Mistakes(wrong)
    return tuple(_effect(row, ports, study) for row in rows)


def _list_offered_names(row: OwnRow, ports: Ports) -> Sequence[str]:
    """Names that a row's ``of``, ``add`` or ``scale`` may use."""
    return {
        "command": tuple(ports.commands),
        "reading": ports.channels,
        "clock": ports.channels if ports.has_clock else (),
        "number": ports.numbers,
        "force": tuple(ports.places),
    }.get(row.at, ())


def _mistakes(where: str, row: OwnRow, ports: Ports) -> Iterator[str]:
    known = _list_offered_names(row, ports)
    if not known:
        yield f"{where}.at: this system has no {row.at} for causes of your own"
        return
    for name in row.add or row.scale or row.of:
        if name not in known:
            yield (
                f"{where}: no {row.at} {name!r}{did_you_mean(name, known)}; "
                f"known: {', '.join(known)}"
            )
    if row.at == "number" and row.of:
        yield f"{where}.of: a cause of numbers names them under add or scale; leave of out"
    if row.at == "force" and len(row.of) != 1:
        yield f"{where}.of: name the one place at which the force acts; known: {', '.join(known)}"


def _effect(row: OwnRow, ports: Ports, study: Study) -> Effect:
    stated = row if row.kind is not None else row.model_copy(update={"kind": _KINDS[row.at]})
    apply, scales, unit = _acts(stated, ports, study)
    own = {} if unit is None or row.unit not in ("command", "channel") else {"unit": unit}
    return stated.effect(apply, scales, **own)


def _acts(row: OwnRow, ports: Ports, study: Study) -> tuple[Apply, Mapping[str, float], str | None]:
    """How a row acts, the magnitudes that it may use, and the unit of what it changes."""
    if row.at == "command":
        names = row.of or tuple(ports.commands)
        scales = ports.scales.of_commands(names)
        units = {c.unit for c in study.commands if c.name in names}
        apply = on_commands(row, names, scales, ports.commands[names[0]])
        return apply, scales, units.pop() if len(units) == 1 else None
    if row.at in ("reading", "clock"):
        names = row.of or ports.channels
        scales = ports.scales.of_channels(names)
        places = [ports.channels.index(name) for name in names]
        units = {study.channels[i].unit for i in places}
        apply = on_clock(places) if row.at == "clock" else on_readings(row, places, scales)
        return apply, scales, units.pop() if len(units) == 1 else None
    if row.at == "force":
        return ports.push(row, row.of[0]), ports.places[row.of[0]], None
    return on_numbers(row), {}, None


__all__ = ["OwnRow", "Ports", "own_causes"]
