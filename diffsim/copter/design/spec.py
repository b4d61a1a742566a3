"""A design as its author writes it: parts, connections, relations; no geometry yet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from diffsim.core.check import require_entries
from diffsim.core.checked import checked


@checked
@dataclass(frozen=True, kw_only=True)
class PartSpec:
    """One part.

    Attributes:
        name: Unique in the design, a Python identifier without double underscores.
        kind: Kind of the part in the database.
        options: Options of the kind: starting values of its parameters [m], constant sizes.
        bounds: Parameter to (lower, upper) [m], where they differ from the database's.
        rotation: Roll, pitch, yaw [deg]; None leaves it to the connections.
        place: Position of the origin [m]; None leaves it to the connections.
        anchored: The part stays at ``place``. Without any anchored part the first one is.
        direction: Direction of a motor's thrust, (3,); None stands straight on what carries it.
            What deviates gets a compound-angle clip.
        propeller: Whether a motor from the database carries a propeller.
    """

    name: str
    kind: str
    options: Mapping[str, Any] = field(default_factory=dict)
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    rotation: tuple[float, ...] | None = None
    place: tuple[float, ...] | None = None
    anchored: bool = False
    direction: tuple[float, ...] | None = None
    propeller: bool = True

    def __post_init__(self) -> None:
        if not self.name.isidentifier() or "__" in self.name:
            raise ValueError(
                f"part name {self.name!r} must be letters, digits and single underscores; names "
                "with __ are for inserted adapters"
            )


@checked
@dataclass(frozen=True, kw_only=True)
class Connection:
    """Two patches that belong together.

    Inserted adapters are called ``host__guest``, ``host__guest_2``, ...; later connections,
    constraints and values may use these names.

    Attributes:
        host, guest: ``part.patch``, or ``part`` alone for the closest pair of patches. The guest
            is turned to face the host.
        at: Place on the host's patch along its sliding directions [m]: along a rod, or along x and
            y of a plate. Fixed, or where a sliding connection starts.
        guest_at: Position on the guest's patch, likewise.
        angle: Turn of what follows about the outward normal of the first flat host patch [deg],
            counterclockwise seen from outside.
        roll: Turn of what follows about the axis of the first circular host patch [deg].
        slide: Whether the place on the host's patch is free; None: on rods yes, on plates no.
        adapters: Kinds to insert; None follows the rule table, empty joins directly.
    """

    host: str
    guest: str
    at: tuple[float, ...] | None = None
    guest_at: tuple[float, ...] | None = None
    angle: float = 0.0
    roll: float = 0.0
    slide: bool | None = None
    adapters: tuple[str, ...] | None = None


@checked
@dataclass(frozen=True, kw_only=True)
class DesignSpec:
    """A whole design.

    Attributes:
        name: Name of the design.
        notes: Source of the numbers.
        parts: Parts in the order in which parts join.
        connections: Connections in the order in which they are made.
        rigid: Pairs of placed parts that keep their distance vector.
        constraints: Linear relations, see ``diffsim.copter.design.constraints``.
        values: Parameters to start from [m], before those of the parts.
        folder: Folder of the files that parts name.
    """

    name: str
    parts: tuple[PartSpec, ...]
    notes: str = ""
    connections: tuple[Connection, ...] = ()
    rigid: tuple[tuple[str, str], ...] = ()
    constraints: tuple[str, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    folder: Path | None = None

    def __post_init__(self) -> None:
        require_entries("parts", self.parts, PartSpec)
        require_entries("connections", self.connections, Connection)
