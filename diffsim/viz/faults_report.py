"""The page of ``faults``: what is said of each group, and the scatter it was held against."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.core.figures import figure, limits, probability, unit_of
from diffsim.diagnose.faults.verdict import UNLISTED, FaultReport, FaultVerdict, SetRow, Size
from diffsim.viz import charts
from diffsim.viz import report as page
from diffsim.viz.charts import EXTENDED
from diffsim.viz.figures import SOFT

MOST_SETS = 4  # explanations of a group that the page lists
MOST_VISIBLE = 6  # causes whose smallest visible size it lists


def faults_page(report: FaultReport) -> page.Report:
    """The page: a row for each group, sizes of named faults, explanations, scatter."""
    named = [v for v in report.verdicts if v.causes]
    sizes = [(v, s) for v in named for s in v.sizes]
    known = [v for v in report.verdicts if v.is_right is not None]
    numbers = [page.Number(label="groups with a fault", value=f"{report.num_faulty}")]
    numbers.append(page.Number(label="groups judged", value=f"{len(report.verdicts)}"))
    if known:
        right = sum(bool(v.is_right) for v in known)
        numbers.append(page.Number(label="known ones named exactly", value=f"{right}/{len(known)}"))
    sections = [_groups(report.verdicts)]
    if sizes:
        sections.append(_sizes(sizes))
    return page.Report(
        title=f"Faults of {report.study}",
        subtitle="Each group of runs against the scatter between sound ones",
        verdict=[report.headline],
        numbers=numbers,
        sections=[*sections, _explanations(report.verdicts), _scatter(report)],
    )


def _groups(verdicts: Sequence[FaultVerdict]) -> page.Section:
    rows = [
        [v.group, v.status, v.words, v.next_words, probability(v.sound), _sources(v), _facts(v)]
        for v in verdicts
    ]
    table = page.Table(
        columns=[
            "group",
            "status",
            "what is said",
            "what to do next",
            "probability of sound",
            "files",
            "known of it",
        ],
        rows=rows,
        caption="Probability that nothing is wrong: by these runs alone, without what other "
        "groups' labels say.",
        emphasis=[k for k, v in enumerate(verdicts) if v.causes or v.status == UNLISTED],
    )
    return page.Section(title="Groups", content=[table])


def _sources(verdict: FaultVerdict) -> str:
    """Files of a group, or its runs where they were read from none."""
    return ", ".join([Path(file).name for file in verdict.files] or verdict.runs)


def _facts(verdict: FaultVerdict) -> str:
    facts = [f"{name} {value}" for name, value in verdict.facts.items()]
    return ", ".join([*([f"said: {verdict.said}"] if verdict.said.strip("-") else []), *facts])


def _sizes(sizes: Sequence[tuple[FaultVerdict, Size]]) -> page.Section:
    content: list[page.Item] = []
    units = dict.fromkeys(s.unit for _, s in sizes)
    for unit in units:
        of_unit = [(v, s) for v, s in sizes if s.unit == unit]
        chart = _draw_sizes(of_unit, unit_of(unit))
        content.append(page.Chart(figure=chart, caption="Sizes of named faults, 90 % intervals."))
    return page.Section(title="How large the faults are", content=content)


def _draw_sizes(sizes: Sequence[tuple[FaultVerdict, Size]], unit: str) -> Any:
    """One row for each named cause of each group."""
    of = [s.interval for _, s in sizes]
    value, low, high = (np.array([getattr(i, e) for i in of]) for e in ("value", "low", "high"))
    labels = [f"{v.group}: {s.words}" for v, s in sizes]
    dots = charts.graph_objects().Scatter(
        x=charts.rounded(value),
        y=labels,
        mode="markers",
        marker={"color": EXTENDED, "size": 8},
        error_x={
            "type": "data",
            "symmetric": False,
            "array": charts.rounded(high - value),
            "arrayminus": charts.rounded(value - low),
            "color": SOFT,
        },
    )
    drawn = charts.graph_objects().Figure(dots)
    drawn.update_xaxes(title_text=f"size [{unit}]" if unit else "size", rangemode="tozero")
    drawn.update_yaxes(autorange="reversed", automargin=True)
    return charts.styled(drawn, height=140 + 30 * len(sizes))


def _explanations(verdicts: Sequence[FaultVerdict]) -> page.Section:
    rows = [
        [
            v.group,
            _explanation(v, s),
            probability(s.probability_alone),
            probability(s.probability),
        ]
        for v in verdicts
        for s in v.sets[:MOST_SETS]
    ]
    sets = page.Table(
        columns=["group", "explanation", "by these runs", "with labels of other groups"],
        rows=rows,
        caption="Most probable explanations of each group, with the probability of each.",
    )
    unseen = [[v.group, ", ".join(v.visible[:MOST_VISIBLE])] for v in verdicts if not v.causes]
    caption = "The smallest of each cause that would have been seen."
    tables = [page.Table(columns=["group", "would be seen"], rows=unseen, caption=caption)]
    return page.Section(title="What else it may be", content=[sets, *(tables if unseen else [])])


def _explanation(verdict: FaultVerdict, row: SetRow) -> str:
    if row.is_unlisted:
        return UNLISTED
    return " + ".join(verdict.plain.get(c, c) for c in row.causes) or "sound"


def _scatter(report: FaultReport) -> page.Section:
    rows = [
        [s.quantities, figure(s.stated), figure(s.interval.value), _ends(s.interval)]
        for s in report.spreads
    ]
    table = page.Table(
        columns=["quantities", "first guess", "learned, one sd", "90 % interval"],
        rows=rows,
        caption="By how much sound groups and runs differ, learned from all groups that teach.",
    )
    return page.Section(title="Scatter between sound groups", content=[table])


def _ends(interval: Any) -> str:
    return limits(interval.value, interval.low, interval.high)
