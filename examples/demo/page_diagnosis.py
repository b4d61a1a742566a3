"""The page's last section: the diagnosis."""

from __future__ import annotations

from typing import Any

from diffsim.viz.report import Picture, Section, Table
from examples.demo.plan import Plan

TITLE = "What the simulation still gets wrong, and why"
COLUMNS = ("cause", "status", "size (90 %)", "nats", "held-out gain (90 %)", "may also be")


def section(found: dict[str, Any], plan: Plan) -> Section:
    """The verdict, its figures and the candidates' table, or why there is none."""
    if "skipped" in found:
        return Section(title=TITLE, text=[found["skipped"]])
    cells = " x ".join(str(n) for n in plan.diagnosis_cells)
    return Section(
        title=TITLE,
        text=[
            *found["sentences"],
            f"A quick look at the height of the bar without weight, swinging freely: "
            f"{found['num_candidates']} candidate causes against an unknown force and a drift, "
            f"0.25 to {plan.diagnosis_until_s:g} s after release, {cells} elements, "
            f"{1e3 * plan.diagnosis_dt_s:g} ms steps; one recording fitted, one held out. "
            "`diffsim diagnose explain silicone_beam` has all causes and a longer window. What the "
            "string does that the weight hangs on is not known: docs/measured/silicone_beam.md.",
        ],
        content=[
            *(Picture(uri=p["uri"], caption=p["caption"]) for p in found["pictures"]),
            Table(
                columns=COLUMNS,
                rows=found["table"],
                caption="Nats: evidence of the best set with the cause over that of the best "
                "without it; kept from 4, alone from 3 more than any rival.",
                emphasis=[i for i, row in enumerate(found["table"]) if row[1].startswith("named")],
            ),
        ],
    )
