"""A plan as files: STL meshes [mm], CSV tables, YAML."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from diffsim.copter.fabrication.planner import FabricationPlan
from diffsim.core.checked import checked
from diffsim.core.files import csv_text, to_plain, write_bytes_atomic, write_text_atomic


@checked
def write_plan(plan: FabricationPlan, folder: str | Path) -> Path:
    """Write everything a workshop needs but the page; each file is whole or absent.

    ``plan.yaml``, ``design.yaml``, ``stl/*.stl``, and the tables ``rods.csv``,
    ``stock.csv``, ``connectors.csv``, ``motors.csv``, ``materials.csv``, ``prints.csv``.

    Args:
        plan: The plan, as ``plan`` returns it.
        folder: Output folder, created where it is missing; files of the same names are replaced.

    Returns:
        The folder.
    """
    import trimesh

    folder = Path(folder)
    for part in plan.printed:
        write_bytes_atomic(folder / "stl" / part.file, trimesh.exchange.stl.export_stl(part.mesh))
    for name, rows in tables(plan).items():
        write_text_atomic(
            folder / f"{name}.csv",
            csv_text(rows[0], (row.values() for row in rows)) if rows else "",
        )
    text = yaml.safe_dump(to_plain(summary(plan)), sort_keys=False, width=100)
    write_text_atomic(folder / "plan.yaml", text)
    plan.design.save(folder / "design.yaml")
    return folder


def tables(plan: FabricationPlan) -> dict[str, list[dict[str, Any]]]:
    """Rows by table; lengths [mm], masses [g], angles [deg], as their columns say."""
    return {
        "rods": [
            {
                "label": cut.label,
                "section": cut.section,
                "length_mm": round(1e3 * cut.length, 1),
                "quantity": cut.quantity,
                "parts": " ".join(cut.names),
            }
            for cut in plan.cuts
        ],
        "stock": [
            {
                "bar": i + 1,
                "section": bar.section,
                "stock_mm": round(1e3 * bar.length, 1),
                "pieces": " ".join(f"{label}:{1e3 * length:.1f}" for label, length in bar.pieces),
                "kerf_mm": round(1e3 * bar.kerf, 2),
                "remnant_mm": round(1e3 * bar.remnant, 1),
            }
            for i, bar in enumerate(plan.bars)
        ],
        "connectors": [
            {
                "rod": place.label,
                "rod_part": place.rod,
                "connector": place.connector,
                "start": place.start,
                "from_start_mm": round(1e3 * place.from_start, 1),
                "roll_deg": round(place.roll, 1),
            }
            for place in plan.places
        ],
        "motors": [
            {
                "number": m.number,
                "part": m.name,
                "rotor": m.rotor,
                "front_mm": round(1e3 * m.position[0], 1),
                "right_mm": round(1e3 * m.position[1], 1),
                "down_mm": round(1e3 * m.position[2], 1),
                "tilt_deg": round(m.tilt, 2),
                "azimuth_deg": round(m.azimuth, 1),
                "turns": m.turns,
                "upside_down": m.pusher,
                "clip": f"clip_motor_{m.number}.stl" if m.clip else "",
            }
            for m in plan.motors
        ],
        "materials": [
            {
                "item": line.item,
                "source": line.source,
                "quantity": line.quantity,
                "mass_g": round(1e3 * line.mass, 2),
                "price_eur": round(line.price, 2),
                "parts": " ".join(line.names),
            }
            for line in (*plan.materials, *plan.consumables)
        ],
        "prints": [
            {
                "file": part.file,
                "process": part.process,
                "quantity": len(part.names),
                "size_mm": " x ".join(f"{v:.1f}" for v in part.check.size),
                "volume_cm3": round(1e-3 * part.check.volume, 2),
                "mass_g": round(1e-6 * part.check.volume * part.density, 2),
                "thinnest_wall_mm": round(part.check.wall, 2),
                "problems": "; ".join(part.check.problems),
            }
            for part in plan.printed
        ],
    }


def summary(plan: FabricationPlan) -> dict[str, Any]:
    """Totals and all tables, for ``plan.yaml``."""
    return {
        "design": plan.design.name,
        "mass_kg": plan.mass,
        "price_eur": plan.price,
        "consumables_kg": sum(line.mass for line in plan.consumables),
        "rod_waste": plan.waste,
        "printer": {"bed_mm": plan.printer.bed, "min_wall_mm": plan.printer.min_wall},
        "problems": plan.problems,
        "steps": plan.steps,
        **tables(plan),
    }
