"""The plan on one static HTML page, pictures inside."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from diffsim.copter.fabrication.files import write_plan
from diffsim.copter.fabrication.materials import MaterialLine
from diffsim.copter.fabrication.planner import FabricationPlan
from diffsim.viz import fabrication_figures as draw
from diffsim.viz.figures import data_uri
from diffsim.viz.report import Number, Picture, Report, Section, Table, write

_IN_TOP_VIEW = ("rod", "plate", "frame", "battery")


def write_fabrication(plan: FabricationPlan, folder: str | Path) -> Path:
    """Write the files of a plan and ``index.html``, its page.

    Args:
        plan: What to cut, print, buy and wire.
        folder: Output folder, created where it is missing; files of the same names are replaced.

    Returns:
        The page.

    Raises:
        ImportError: matplotlib or jinja2 is missing.
    """
    shown = page(plan)
    return write(shown, write_plan(plan, folder) / "index.html")


def page(plan: FabricationPlan) -> Report:
    """Report of a plan: what to cut, print, buy, wire, and in which order."""
    design = plan.design
    extra = sum(line.mass for line in plan.consumables)
    sections = [_overview(plan), _rods(plan), _connectors(plan), _motors(plan), _prints(plan)]
    tilt = max(m.tilt for m in plan.motors)
    return Report(
        title=f"Fabrication plan: {design.name.replace('_', ' ')}",
        subtitle="Lengths in millimeters, angles in degrees; front, right and down are the "
        "copter's own axes.",
        verdict=[
            f"{len(plan.motors)} motors, {sum(c.quantity for c in plan.cuts)} rods, "
            f"{sum(len(p.names) for p in plan.printed if p.process == 'print')} printed parts; "
            f"{1e3 * plan.mass:.0f} g and {plan.price:.0f} EUR, the same as the design's.",
            f"Screws, glue and straps add about {1e3 * extra:.0f} g "
            f"({100.0 * extra / plan.mass:.1f} %), which the design does not count.",
        ],
        banner=f"Mend first: {'; '.join(plan.problems)}." if plan.problems else None,
        numbers=[
            Number(label="mass", value=f"{1e3 * plan.mass:.0f}", unit="g"),
            Number(label="parts", value=f"{plan.price:.0f}", unit="EUR"),
            Number(label="largest motor angle", value=f"{tilt:.1f}", unit="deg", note="from up"),
            Number(
                label="rod bars to buy",
                value=f"{len(plan.bars)}",
                note=f"{100.0 * plan.waste:.0f} % waste" if plan.bars else "none needed",
            ),
        ],
        sections=[s for s in sections if s is not None] + [_materials(plan), _steps(plan)],
        held_fixed=[
            ("print bed", " x ".join(f"{v:g}" for v in plan.printer.bed) + " mm"),
            ("thinnest wall allowed", f"{plan.printer.min_wall:g} mm"),
            *([("saw kerf", f"{1e3 * plan.bars[0].kerf:g} mm")] if plan.bars else []),
        ],
    )


def _overview(plan: FabricationPlan) -> Section:
    kinds = {p.name: p.part.kind for p in plan.design.parts}
    meshes = plan.design.meshes()
    com = plan.design.center_of_mass().numpy()
    shapes = [
        (kinds[name], mesh.triangles - com)
        for name, mesh in meshes.items()
        if any(key in kinds[name] for key in _IN_TOP_VIEW)
    ]
    return Section(
        title="The copter",
        text=[plan.design.spec.notes] if plan.design.spec.notes else [],
        content=[
            Picture(
                uri=data_uri(draw.view(meshes, kinds), png=True),
                caption="All parts in place, seen from the front left above.",
            ),
            Picture(
                uri=data_uri(draw.wiring(plan.motors, shapes), png=True),
                caption="Wiring and spins from above: the number is the flight controller's "
                "output. Angles of tilted motors: from up, and clockwise from the front.",
            ),
        ],
    )


def _rods(plan: FabricationPlan) -> Section | None:
    if not plan.cuts:
        return None
    rows = [
        [c.label, str(c.quantity), f"{1e3 * c.length:.1f}", c.section, ", ".join(c.names)]
        for c in plan.cuts
    ]
    used, bought = sum(b.used for b in plan.bars), sum(b.length for b in plan.bars)
    return Section(
        title="Rods",
        text=[
            f"{used:.3f} m of rod from {bought:.3f} m of stock: {100.0 * plan.waste:.1f} % is saw "
            "dust and remnants. Bars are filled longest piece first, each into the first bar that "
            "has room; another order may save a bar."
        ],
        content=[
            Table(
                columns=["piece", "quantity", "length [mm]", "section", "parts"],
                rows=rows,
                caption="Cut list.",
            ),
            Picture(uri=data_uri(draw.bars(plan.bars)), caption="Where to cut each bar."),
        ],
    )


def _connectors(plan: FabricationPlan) -> Section | None:
    if not plan.places:
        return None
    rows = [
        [
            f"{p.label}, {p.rod}",
            p.start,
            p.connector.replace("__", " to "),
            f"{1e3 * p.from_start:.1f}",
            f"{p.roll:.0f}",
        ]
        for p in plan.places
    ]
    return Section(
        title="Connectors on rods",
        content=[
            Table(
                columns=["rod", "from end", "connector", "to its middle [mm]", "turned [deg]"],
                rows=rows,
                caption="The turn is right-handed about the rod, looking away from the end named, "
                "and 0 where the connector's top faces up (forward, on an upright rod).",
            )
        ],
    )


def _motors(plan: FabricationPlan) -> Section:
    rows = [
        [
            f"{m.number}, {m.name}",
            *(f"{1e3 * v:.1f}" for v in m.position),
            f"{m.tilt:.1f}",
            f"{m.azimuth:.0f}" if m.clip else "-",
            m.turns,
            m.rotor,
        ]
        for m in plan.motors
    ]
    return Section(
        title="Motors",
        content=[
            Table(
                columns=["motor", "front [mm]", "right [mm]", "down [mm]", "angle from up [deg]",
                         "leans towards [deg]", "turns, seen from above", "rotor"],
                rows=rows,
                caption="Places of the propellers' centers relative to the center of mass. 'Leans "
                "towards' counts clockwise from the front.",
            )
        ],
    )  # fmt: skip


def _prints(plan: FabricationPlan) -> Section | None:
    if not plan.printed:
        return None
    rows = [
        [
            p.file,
            p.process,
            str(len(p.names)),
            " x ".join(f"{v:.1f}" for v in p.check.size),
            f"{1e-6 * p.check.volume * p.density:.1f}",
            f"{p.check.wall:.1f}",
            "; ".join(p.check.problems) or "ok",
        ]
        for p in plan.printed
    ]
    return Section(
        title="Printed parts and sheets",
        text=[
            "All meshes are closed, in millimeters, standing as they are printed. They weigh a "
            "little less than in the bill: bores are wider than rods by 0.15 mm all around, and "
            "screws need holes."
        ],
        content=[
            Picture(
                uri=data_uri(draw.printed(plan.printed), png=True),
                caption="Each to its own scale. The notch in a clip's rim says how it is turned.",
            ),
            Table(
                columns=["file in stl/", "process", "pieces", "size [mm]", "mass each [g]",
                         "thinnest wall [mm]", "check"],
                rows=rows,
            ),
        ],
    )  # fmt: skip


def _materials(plan: FabricationPlan) -> Section:
    rows = _lines(plan.materials)
    rows.append(["total", "", "", f"{1e3 * plan.mass:.1f}", f"{plan.price:.2f}"])
    more = _lines(plan.consumables)
    return Section(
        title="Bill of materials",
        content=[
            Table(
                columns=["item", "source", "pieces", "mass [g]", "price [EUR]"],
                rows=rows + more,
                caption="Below the total: what comes on top, estimated.",
                emphasis=[len(rows) - 1],
            )
        ],
    )


def _lines(lines: Sequence[MaterialLine]) -> list[list[str]]:
    return [
        [x.item, x.source, str(x.quantity), f"{1e3 * x.mass:.1f}", f"{x.price:.2f}"] for x in lines
    ]


def _steps(plan: FabricationPlan) -> Section:
    return Section(
        title="Assembly",
        text=[f"{k + 1}. {text}" for k, text in enumerate(plan.steps)],
    )
