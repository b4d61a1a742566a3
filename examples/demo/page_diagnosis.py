"""The page's last section: the diagnosis."""

from __future__ import annotations

from typing import Any

from diffsim.viz.charts import graph_objects
from diffsim.viz.report import Chart, Section, Table

TITLE = "What the simulation still gets wrong, and why"
COLUMNS = ("cause", "status", "size (90 %)", "nats", "held-out gain (90 %)", "may also be")


def section(found: dict[str, Any]) -> Section:
    """The verdict, its figures and the candidates' table, or why there is none."""
    if "skipped" in found:
        return Section(title=TITLE, text=[found["skipped"]])
    figure = graph_objects().Figure
    return Section(
        title=TITLE,
        text=[
            *found["sentences"],
            "A quick look at the published study, study.yaml beside this page: the hung weight as "
            f"the authors have it, a constant force, and {found['num_candidates']} candidate "
            "causes against an unknown force and a drift. Moment, height and speed of the release "
            "are fitted per recording; one chooses between causes, load52_b judges. 0.3 mm is what "
            "two releases by hand differ by at least. `diffsim diagnose explain silicone_beam` has "
            "all causes: docs/measured/silicone_beam.md.",
        ],
        content=[
            *(Chart(figure=figure(c["figure"]), caption=c["caption"]) for c in found["charts"]),
            Table(
                columns=COLUMNS,
                rows=found["table"],
                caption="Nats: evidence of the best set with the cause over that of the best "
                "without it; kept from 4, alone from 3 more than any rival.",
                emphasis=[i for i, row in enumerate(found["table"]) if row[1].startswith("named")],
            ),
        ],
    )
