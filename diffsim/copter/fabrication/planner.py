"""From a design to what a workshop needs (thesis 3.6)."""

from __future__ import annotations

import itertools
import re
from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from diffsim.copter.design.design import Design
from diffsim.copter.design.placement import PlacedPart
from diffsim.copter.fabrication.assembly import ConnectorPlace, connector_places, steps
from diffsim.copter.fabrication.materials import PLATES, MaterialLine, bill, consumables
from diffsim.copter.fabrication.motors import MotorPlan, motor_plans
from diffsim.copter.fabrication.overlap import Overlap, overlaps
from diffsim.copter.fabrication.print_check import PrintCheck, Printer, check_print
from diffsim.copter.fabrication.printable import print_mesh
from diffsim.copter.fabrication.rods import RodCut, StockBar, pack, rod_cuts
from diffsim.copter.vehicle.clearance import disc_clearances
from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.core.errors import DiffsimError

if TYPE_CHECKING:
    import trimesh

_MASS_TOLERANCE = 1e-9  # the bill against the design, relative: only the order of sums differs


class FabricationError(DiffsimError):
    """A plan that contradicts its design or cannot be made; the message says where."""


@checked(kinds_only=True)
@dataclass(frozen=True, eq=False)
class PrintedPart:
    """A mesh to print, or to cut from a sheet.

    Attributes:
        file: Name of the STL file.
        mesh: Mesh as it stands on the printer's bed [mm].
        names: Names of the parts, one per piece.
        process: ``print`` or ``sheet``.
        density: Density that gives the design's mass [kg/m^3]; below the plastic's: infill.
        check: Outcome of the check whether it can be printed.
    """

    file: str
    mesh: trimesh.Trimesh
    names: tuple[str, ...]
    process: str
    density: float
    check: PrintCheck


@checked(kinds_only=True)
@dataclass(frozen=True, eq=False)
class FabricationPlan:
    """What a workshop needs.

    Attributes:
        design: With the shape and the directions that are to be built.
        cuts: Rods by length.
        bars: Stock bars and how they are cut.
        motors: Place, tilt and spin of every motor.
        places: Connectors on rods.
        printed: Meshes for printer and sheet cutter.
        materials: Bill of materials; adds up to the design's mass and price.
        consumables: Screws, glue and strap, estimated, beside the design's mass.
        steps: Steps of assembly.
        printer: The printer for which the meshes were checked.
    """

    design: Design
    cuts: tuple[RodCut, ...]
    bars: tuple[StockBar, ...]
    motors: tuple[MotorPlan, ...]
    places: tuple[ConnectorPlace, ...]
    printed: tuple[PrintedPart, ...]
    materials: tuple[MaterialLine, ...]
    consumables: tuple[MaterialLine, ...]
    steps: tuple[str, ...]
    printer: Printer

    @property
    def mass(self) -> float:
        """Mass of the bill without consumables [kg]."""
        return sum(line.mass for line in self.materials)

    @property
    def price(self) -> float:
        """Price of the bill without consumables [EUR]."""
        return sum(line.price for line in self.materials)

    @property
    def waste(self) -> float:
        """Share of the stock bars that does not end in rods, kerf included."""
        bought = sum(bar.length for bar in self.bars)
        return 1.0 - sum(bar.used for bar in self.bars) / bought if bought else 0.0

    @cached_property
    def overlaps(self) -> tuple[Overlap, ...]:
        """Parts that interpenetrate as the design stands, the deepest first."""
        return overlaps(self.design.meshes())

    @property
    def problems(self) -> tuple[str, ...]:
        """What stands in the way of printing, assembly and flying, one sentence each."""
        prints = [f"{p.file}: {text}" for p in self.printed for text in p.check.problems]
        # two propellers are told by their discs, below
        solid = {p.name for p in self.design.parts if p.part.kind != "propeller"}
        gaps = disc_clearances(self.design.multicopter()).tolist()
        pairs = itertools.combinations(self.motors, 2)
        return (
            *prints,
            *(str(o) for o in self.overlaps if not solid.isdisjoint(o.parts)),
            *(
                f"the propellers of motors {a.number} and {b.number} cut into each other"
                for (a, b), gap in zip(pairs, gaps, strict=True)
                if gap <= 0.0
            ),
        )


def plan(
    design: Design,
    s: Tensor | None = None,
    directions: Tensor | None = None,
    spins: Tensor | None = None,
    *,
    stock: float = 1.0,
    kerf: float = 0.0015,
    printer: Printer | None = None,
) -> FabricationPlan:
    """Fabrication plan of a design.

    Args:
        design: Composed design.
        s: Free parameters, (n_free,) [m], such as a co-design's; the design's own if None.
        directions: Unit thrust directions, (n_rotors, 3); the design is rebuilt with a
            compound-angle clip under every motor that leans. As built if None.
        spins: b_i, (n_rotors,), +1 or -1, such as a co-design's; as built if None.
        stock: Length of the rods that are sold [m].
        kerf: Width of the saw's cut [m].
        printer: To check the meshes for; 220 x 220 x 250 mm and 1.2 mm of wall by default.

    Returns:
        The plan. Meshes that do not fit the printer are in it, and in its ``problems``.

    Raises:
        ValueError: s leaves the feasible set, wrong shapes, a rod longer than the stock.
        FabricationError: a mesh is not closed or a wall is too thin, or the bill does not add up.
    """
    printer = Printer() if printer is None else printer
    if s is not None:
        design = design.with_values(s)
    if spins is not None:
        design = design.with_spins(spins)
    if directions is not None:
        design = design.with_directions(directions)
    values = dict(zip(design.all_names, design.all_values().tolist(), strict=True))
    entries = design.bill_of_materials()
    cuts = rod_cuts(entries, design.parts)
    motors = motor_plans(design)
    places = connector_places(design, values, cuts)
    result = FabricationPlan(
        design=design,
        cuts=cuts,
        bars=pack(cuts, stock, kerf),
        motors=motors,
        places=places,
        printed=_plan_prints(design, values, motors, printer),
        materials=bill(entries, design.parts),
        consumables=consumables(design),
        steps=steps(design, motors, places, values),
        printer=printer,
    )
    _require_sound(result)
    return result


def _plan_prints(
    design: Design,
    values: dict[str, float],
    motors: tuple[MotorPlan, ...],
    printer: Printer,
) -> tuple[PrintedPart, ...]:
    """Meshes, like ones once; clips carry the number of their motor."""
    numbers = {m.clip: m.number for m in motors}
    groups: dict[str, list[tuple[PlacedPart, Array]]] = defaultdict(list)
    for p in design.parts:
        if p.part.source == "printed" or p.part.kind in PLATES:
            shape = np.array([values[n] for n in p.shape_names])
            groups[_file(p, shape, numbers)].append((p, shape))
    entries = []
    for file, alike in groups.items():
        first, shape = alike[0]
        mesh = print_mesh(first, shape, design)
        entries.append(
            PrintedPart(
                file=file,
                mesh=mesh,
                names=tuple(p.name for p, _ in alike),
                process="sheet" if first.part.kind in PLATES else "print",
                density=first.part.density,
                check=check_print(mesh, printer),
            )
        )
    return tuple(entries)


def _file(p: PlacedPart, shape: Array, numbers: dict[str | None, int]) -> str:
    """Name of the STL file: equal for parts that are alike."""
    if p.part.kind == "compound_angle_clip":
        return f"clip_motor_{numbers[p.name]}.stl"
    if p.part.kind.endswith("frame"):
        return f"{p.name}.stl"
    sizes = [f"{1e3 * v:.1f}" for v in shape]
    sizes += [
        f"{1e3 * float(str(p.part.options[key])):.1f}"
        for key in ("rod_diameter", "diameter", "thickness")
        if key in p.part.options
    ]
    return re.sub(r"[^\w.]+", "_", "_".join([p.part.kind, *sizes])) + ".stl"


def _require_sound(result: FabricationPlan) -> None:
    """A bill that adds up, and meshes that are solids. What is only too large is a problem."""
    expected = float(result.design.mass())
    if abs(result.mass - expected) > _MASS_TOLERANCE * expected:
        raise FabricationError(
            f"the bill of materials weighs {result.mass:.9g} kg, the design {expected:.9g} kg"
        )
    for part in result.printed:
        check = part.check
        if not check.watertight or check.volume <= 0.0 or check.wall < result.printer.min_wall:
            raise FabricationError(f"{part.file}: {'; '.join(check.problems)}")
