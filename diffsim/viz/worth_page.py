"""The page of what it would buy a task to mend each cause."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.core.figures import figure
from diffsim.diagnose.judge.own_values import words_of
from diffsim.sim_to_real.worth import ALL, MISS, Worth
from diffsim.viz import charts
from diffsim.viz import report as page
from diffsim.viz.charts import EXTENDED, NULL
from diffsim.viz.figures import COLORS

SHOWN = {"whole": "with it", "half": "with half of it", "none": "without it"}
UNAWARE = "command that does not know of it"
TASK_MISS = "root mean square of the misses, each in units of the task's `miss`; less is better"
TRAVEL = "travel [m]; more is better"


def write_worth(
    found: Sequence[Worth], name: str, facts: Sequence[tuple[str, str]], path: str | Path
) -> Path:
    """Write the page, one static HTML file.

    Args:
        found: What each cause costs, as ``sim_to_real.worth`` gives it.
        name: Of the study.
        facts: (what, value) pairs: where the model and the task came from.
        path: File to write.

    Returns:
        ``path``.
    """
    return page.write(worth_page(found, name, facts), path)


def worth_page(found: Sequence[Worth], name: str, facts: Sequence[tuple[str, str]]) -> page.Report:
    """The page: what mending buys most, every cause as numbers and as bars."""
    ranked = sorted(found, key=lambda row: -row.bought)
    travel = found[0].of != MISS
    unit = "m" if travel else ""
    numbers = [
        page.Number(
            label=f"mending {_words(row)} buys",
            value="nothing" if row.is_nothing else figure(row.bought),
            unit="" if row.is_nothing else unit,
            note=f"{figure(row.whole)} with it, {figure(row.none)} without",
        )
        for row in ranked
    ]
    content: list[page.Item] = [_table(ranked), _bars(ranked, TRAVEL if travel else TASK_MISS)]
    return page.Report(
        title=f"What mending would buy: {name}",
        subtitle="The task's best command was sought again with each cause, with half of its size, "
        "and without it.",
        verdict=[_first_sentence(ranked[0])],
        numbers=numbers,
        sections=[
            page.Section(
                title="Cause by cause",
                text=[f"Numbers are the {TRAVEL if travel else TASK_MISS}."],
                content=content,
            )
        ],
        held_fixed=list(facts),
    )


def _first_sentence(row: Worth) -> str:
    """What mending buys most, and what it costs a command not to know of it."""
    unit = " m" if row.of != MISS else ""
    if row.is_nothing:
        best = f"its best {row.of} is {figure(row.whole)}{unit}"
        return f"Mending no cause buys this task anything: {best}."
    most = f"its best {row.of} goes from {figure(row.whole)} to {figure(row.none)}{unit}"
    unaware = f"a command that does not know of it has {figure(row.unaware)}{unit}"
    return f"Mending {_words(row)} buys most: {most}; {unaware}."


def _words(row: Worth) -> str:
    return "all causes" if row.cause == ALL else words_of(row.cause)


def _table(rows: Sequence[Worth]) -> page.Table:
    return page.Table(
        columns=["cause", *SHOWN.values(), "mending buys", UNAWARE],
        rows=[
            [
                _words(r),
                *(figure(getattr(r, key)) for key in SHOWN),
                "nothing" if r.is_nothing else figure(r.bought),
                figure(r.unaware),
            ]
            for r in rows
        ],
        caption="Last column: the command of a model without the cause, where the cause acts. "
        "Nothing: less than repeated searches for the best command differ by.",
    )


def _bars(rows: Sequence[Worth], title: str) -> page.Chart:
    colors = dict(zip(SHOWN, (EXTENDED, COLORS["fourth"], COLORS["measured_2"]), strict=True))
    labels = {**SHOWN, "unaware": UNAWARE}
    bars = [
        charts.graph_objects().Bar(
            x=[_words(row) for row in rows],
            y=charts.rounded(np.array([getattr(row, key) for row in rows])),
            name=label,
            marker_color=colors.get(key, NULL),
        )
        for key, label in labels.items()
    ]
    drawn: Any = charts.graph_objects().Figure(bars)
    drawn.update_yaxes(title_text=title.split(";")[0].split(",")[0], type="log")
    return page.Chart(
        figure=charts.styled(drawn, height=320),
        caption="Logarithmic scale. A tall last bar says that the command must know of the cause; "
        "a fall from the first bar to the third, that a mended rig would do better.",
    )
