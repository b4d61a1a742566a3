"""Rods to cut: equal lengths grouped, packed into stock bars."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

from diffsim.copter.design.listing import PartEntry
from diffsim.copter.design.placement import PlacedPart
from diffsim.core.check import require_number
from diffsim.core.checked import checked

_SAME = 1e-4  # lengths that agree to a tenth of a millimeter are cut alike [m]


@checked(kinds_only=True)
@dataclass(frozen=True)
class RodCut:
    """Rods of one length.

    Attributes:
        label: Letter on the piece.
        section: Cross-section in words.
        length: Length [m].
        names: Names of the parts, one per piece.
    """

    label: str
    section: str
    length: float
    names: tuple[str, ...]

    @property
    def quantity(self) -> int:
        """How many to cut."""
        return len(self.names)


@checked(kinds_only=True)
@dataclass(frozen=True)
class StockBar:
    """How one bar is cut.

    Attributes:
        section: Cross-section in words.
        length: Length [m].
        pieces: (label, length [m]) from one end to the other.
        kerf: Lost per cut [m].
    """

    section: str
    length: float
    pieces: tuple[tuple[str, float], ...]
    kerf: float

    @property
    def used(self) -> float:
        """Length in pieces [m]."""
        return sum(length for _, length in self.pieces)

    @property
    def remnant(self) -> float:
        """What is left in one piece, after a cut per piece [m]."""
        return max(0.0, self.length - self.used - self.kerf * len(self.pieces))


def rod_cuts(entries: Sequence[PartEntry], parts: Sequence[PlacedPart]) -> tuple[RodCut, ...]:
    """Rods of a design by cross-section and length, longest first."""
    groups: dict[tuple[str, int], list[PartEntry]] = defaultdict(list)
    for entry, placed in zip(entries, parts, strict=True):
        if placed.part.rod_parameter is not None:
            steps = round(entry.dimensions["length"] / _SAME)
            groups[_section(placed), steps].append(entry)
    ordered = sorted(groups.items(), key=lambda item: (item[0][0], -item[0][1]))
    return tuple(
        RodCut(
            _letter(k),
            section,
            sum(e.dimensions["length"] for e in alike) / len(alike),
            tuple(e.name for e in alike),
        )
        for k, ((section, _), alike) in enumerate(ordered)
    )


def pack(cuts: Sequence[RodCut], stock: float, kerf: float) -> tuple[StockBar, ...]:
    """Cut pieces from bars, first fit decreasing: at most 11/9 of the fewest bars, and a bit.

    Args:
        stock: Length of a bar [m].
        kerf: Width of the saw's cut [m].

    Raises:
        ValueError: a piece is longer than a bar.
    """
    require_number("stock", stock, above=0.0)
    require_number("kerf", kerf, at_least=0.0)
    bars: list[tuple[str, list[tuple[str, float]]]] = []
    for cut in sorted(cuts, key=lambda c: -c.length):
        if cut.length > stock:
            raise ValueError(
                f"stock must be at least as long as every rod, got {stock:g} m for "
                f"{cut.names[0]!r} of {cut.length:.4g} m; buy longer bars"
            )
        for _ in cut.names:
            bar = next(
                (b for s, b in bars if s == cut.section and _fits(b, cut, stock, kerf)), None
            )
            if bar is None:
                bars.append((cut.section, bar := []))
            bar.append((cut.label, cut.length))
    return tuple(StockBar(section, stock, tuple(pieces), kerf) for section, pieces in bars)


def _fits(bar: list[tuple[str, float]], cut: RodCut, stock: float, kerf: float) -> bool:
    return sum(length + kerf for _, length in bar) + cut.length <= stock + 1e-12


def _section(placed: PlacedPart) -> str:
    options = placed.part.options
    if "outer_diameter" in options:
        outer, inner = (1e3 * float(str(options[f"{k}_diameter"])) for k in ("outer", "inner"))
        return f"carbon tube {outer:g} x {inner:g} mm"
    return f"{placed.part.kind.replace('_', ' ')}"


def _letter(index: int) -> str:
    """A, B, ..., Z, AA, AB, ..."""
    letters = [chr(ord("A") + i) for i in range(26)]
    names = itertools.chain.from_iterable(
        itertools.product(letters, repeat=r) for r in itertools.count(1)
    )
    return "".join(next(itertools.islice(names, index, None)))
