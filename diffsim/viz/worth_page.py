"""The page of what it would buy a task to mend each cause."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import wrap
from typing import Any

import numpy as np

from diffsim.core.figures import figure
from diffsim.core.units import small_scale
from diffsim.diagnose.judge.own_values import words_of
from diffsim.sim_to_real.worth import ALL, MISS, Worth
from diffsim.viz import charts
from diffsim.viz import report as page
from diffsim.viz.charts import EXTENDED, NULL
from diffsim.viz.figures import COLORS

SHOWN = {"whole": "with it", "half": "with half of it", "none": "without it"}
LABEL = 16  # letters of a cause in a line beside its bars
UNAWARE = "command that does not know of it"
TASK_MISS = "root mean square of the misses, each in units of the task's `miss`; less is better"
TRAVEL = "travel [m]; more is better"


def worth_page(found: Sequence[Worth], name: str, facts: Sequence[tuple[str, str]]) -> page.Report:
    """The page: what mending buys most, every cause as numbers and as bars."""
    ranked = sorted(found, key=lambda row: -row.bought)
    travel = found[0].of != MISS
    numbers = [
        page.Number(
            label=f"mending {_words(row)} buys",
            value="nothing" if row.is_nothing else row.read(row.bought).partition(" ")[0],
            unit="" if row.is_nothing else row.read(row.bought).partition(" ")[2],
            note=f"{row.read(row.whole)} with it, {row.read(row.none)} without",
        )
        for row in ranked
    ]
    miss = "root mean square of the misses; less is better" if found[0].unit else TASK_MISS
    what = TRAVEL if travel else miss
    content: list[page.Item] = [_table(ranked), _bars(ranked, what)]
    return page.Report(
        title=f"What mending would buy: {name}",
        subtitle="The task's best command was sought again with each cause, with half of its size, "
        "and without it.",
        verdict=[_first_sentence(ranked[0])],
        numbers=numbers,
        sections=[
            page.Section(
                title="Cause by cause",
                text=[f"Numbers are the {what}."],
                content=content,
            )
        ],
        held_fixed=list(facts),
    )


def _first_sentence(row: Worth) -> str:
    """What mending buys most, and what it costs a command not to know of it."""
    if row.is_nothing:
        best = f"its best {row.of} is {row.read(row.whole)}"
        return f"Mending no cause buys this task anything: {best}."
    most = f"its best {row.of} goes from {row.read(row.whole)} to {row.read(row.none)}"
    unaware = f"a command that does not know of it has {row.read(row.unaware)}"
    return f"Mending {_words(row)} buys most: {most}; {unaware}."


def _words(row: Worth) -> str:
    return "all causes" if row.cause == ALL else words_of(row.cause)


def _table(rows: Sequence[Worth]) -> page.Table:
    return page.Table(
        columns=["cause", *SHOWN.values(), "mending buys", UNAWARE],
        rows=[
            [
                _words(r),
                *(r.read(getattr(r, key)) for key in SHOWN),
                "nothing" if r.is_nothing else r.read(r.bought),
                r.read(r.unaware),
            ]
            for r in rows
        ],
        caption="Last column: the command of a model without the cause, where the cause acts. "
        "Nothing: less than repeated searches for the best command differ by.",
    )


def _bars(rows: Sequence[Worth], what: str) -> page.Chart:
    """Bars that lie, so that names and all of a scale have room on a phone."""
    colors = dict(zip(SHOWN, (EXTENDED, COLORS["fourth"], COLORS["measured_2"]), strict=True))
    labels = {**SHOWN, "unaware": UNAWARE}
    unit, times = small_scale("m" if rows[0].of != MISS else rows[0].unit, [_largest(rows)])
    bars = [
        charts.graph_objects().Bar(
            x=charts.rounded(times * _one(rows) * np.array([getattr(row, key) for row in rows])),
            y=["<br>".join(wrap(_words(row), LABEL)) for row in rows],
            orientation="h",
            name=label,
            marker_color=colors.get(key, NULL),
        )
        for key, label in labels.items()
    ]
    drawn: Any = charts.graph_objects().Figure(bars)
    title = "travel" if what == TRAVEL else "rms of the misses"
    ticks = [digit * 10.0**power for power in range(-6, 7) for digit in (1, 2, 5)]
    drawn.update_xaxes(
        title_text=f"{title} [{unit}]" if unit else title,
        type="log",
        tickvals=ticks,
        ticktext=[figure(tick) for tick in ticks],  # plotly writes a small 2 for 20
    )
    drawn.update_yaxes(autorange="reversed")
    drawn.update_layout(legend={"traceorder": "normal"})
    return page.Chart(
        figure=charts.styled(drawn, height=140 + 110 * len(rows)),
        caption="Logarithmic scale. A long last bar says that the command must know of the cause; "
        "a fall from the first bar to the third, that a mended rig would do better.",
    )


def _one(rows: Sequence[Worth]) -> float:
    return rows[0].one if rows[0].of == MISS else 1.0


def _largest(rows: Sequence[Worth]) -> float:
    return _one(rows) * max(row.whole for row in rows)
