"""Bill of materials: like parts on one line, and the screws and glue that no design lists."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

from diffsim.copter.design.design import Design
from diffsim.copter.design.listing import PartEntry
from diffsim.copter.design.placement import PlacedPart
from diffsim.copter.fabrication.printable import clip_middle

_SCREWS = (8, 10, 12, 16, 20, 25, 30, 35, 40, 50, 60)  # lengths in which M3 is sold [mm]
_GRIP = 10.0  # of a screw in what it is screwed into [mm]
PLATES = ("plate", "circular_plate")  # parts that are cut from a sheet


@dataclass(frozen=True)
class MaterialLine:
    """One line of the bill."""

    item: str  # description with sizes
    source: str  # ``bought``, ``cut``, ``printed`` or ``consumable``
    quantity: int  # pieces
    mass: float  # mass of all pieces [kg]
    price: float  # price of all pieces [EUR]
    names: tuple[str, ...] = ()  # names of the parts, empty for consumables


def bill(entries: Sequence[PartEntry], parts: Sequence[PlacedPart]) -> tuple[MaterialLine, ...]:
    """Parts of a design, like ones together; their masses and prices add up to the design's."""
    groups: dict[tuple[str, str, int], list[PartEntry]] = defaultdict(list)
    for entry, placed in zip(entries, parts, strict=True):
        tenths = round(1e4 * entry.mass)  # of a gram: what is alike weighs alike
        groups[entry.source, _item(entry, placed), tenths].append(entry)
    order = ("bought", "cut", "printed")
    ranked = sorted(groups.items(), key=lambda g: (order.index(g[0][0]), g[0][1], g[0][2]))
    return tuple(
        MaterialLine(
            item,
            source,
            len(alike),
            sum(e.mass for e in alike),
            sum(e.price for e in alike),
            tuple(e.name for e in alike),
        )
        for (source, item, _), alike in ranked
    )


def consumables(design: Design) -> tuple[MaterialLine, ...]:
    """Screws, glue and strap; masses and prices are estimates, and no part of the design's."""
    parts = {p.name: p for p in design.parts}
    screws: dict[int, int] = defaultdict(int)
    clip = 0.0
    for p in design.parts:
        if p.part.kind == "compound_angle_clip":
            clip = clip_middle(p)
        elif p.part.rotor_mount is not None:
            screws[_screw_length(clip)] += 4
            clip = 0.0
        elif p.part.kind in ("standoff", "screw_mount"):
            screws[_screw_length(0.0)] += 2
    for connection in design.spec.connections:
        names = (text.partition(".")[0] for text in (connection.host, connection.guest))
        ends = {parts[name].part.kind for name in names}
        if ends & set(PLATES):
            screws[_screw_length(2.0)] += 2
    lines = [
        MaterialLine(f"M3 screw, {length} mm", "consumable", n, n * _screw_mass(length), 0.1 * n)
        for length, n in sorted(screws.items())
    ]
    bores = sum(p.part.kind == "round_connector" for p in design.parts)
    if bores:
        lines.append(
            MaterialLine("epoxy, 0.5 g per bore", "consumable", bores, 5e-4 * bores, 0.1 * bores)
        )
    packs = sum(p.part.kind == "battery" for p in design.parts)
    if packs:
        lines.append(MaterialLine("battery strap", "consumable", packs, 8e-3 * packs, 2.0 * packs))
    return tuple(lines)


def _screw_length(through: float) -> int:
    """Shortest M3 screw that is sold for this much material to pass through [mm]."""
    return next((s for s in _SCREWS if s >= through + _GRIP), _SCREWS[-1])


def _screw_mass(length: int) -> float:
    """Mass of an M3 socket-head screw of steel: 0.5 g of head, 4.4 g per 100 mm of thread [kg]."""
    return 1e-3 * (0.5 + 0.044 * length)


def _item(entry: PartEntry, placed: PlacedPart) -> str:
    """What to buy, cut or print, with sizes in millimeters."""
    options = placed.part.options
    words = entry.kind.replace("_", " ")
    if "rotor" in options:
        words += f" {options['rotor']}"
    sizes = [f"{key} {1e3 * value:.1f} mm" for key, value in entry.dimensions.items()]
    for key in ("outer_diameter", "inner_diameter", "diameter", "rod_diameter", "thickness"):
        if key in options:
            sizes.append(f"{key.replace('_', ' ')} {1e3 * float(str(options[key])):g} mm")
    if "size" in options:
        size = options["size"]
        assert isinstance(size, (list, tuple))
        sizes.append(" x ".join(f"{1e3 * float(v):g}" for v in size) + " mm")
    if "file" in options:
        sizes.append(str(options["file"]).rpartition("/")[2])
    return ", ".join([words, *sizes])
