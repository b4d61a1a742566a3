"""Tables of a diagnosis's page: errors, causes, sets of causes, base parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence

from diffsim.core.figures import figure, percent, signed, unit_of, with_interval, with_sd
from diffsim.diagnose.judge.apart import ApartRow
from diffsim.diagnose.judge.gain import Gain
from diffsim.diagnose.judge.own_values import OwnRow, words_of
from diffsim.diagnose.judge.records import (
    HIDDEN,
    REFUTED,
    UNJUDGED,
    UNTOLD,
    BaseRow,
    CauseRow,
    ErrorRow,
    Interval,
    OutsideRow,
    in_small_units,
)
from diffsim.diagnose.say.report import Report
from diffsim.diagnose.say.wording import component_words
from diffsim.identify.ranges import SURE_SD
from diffsim.viz.report import Table

_OUT = (REFUTED, HIDDEN, UNJUDGED)  # statuses of causes that the answer does without
MOST_OUTSIDE = 10  # rows: a flight has twenty quantities, most just outside


def errors(rows: Sequence[ErrorRow]) -> Table:
    """Error before and after on runs that were not fitted; no columns without a number, and each
    kind of channel in the unit of its key figure."""
    rows = in_small_units(rows)
    given = ("constant", "held", "command", "without")
    shown = [which for which in given if any(getattr(row, which) is not None for row in rows)]
    return Table(
        columns=[
            "run",
            "quantity",
            "before",
            "after",
            "noise",
            *shown,
            "90 % band ±",
            "inside",
            "unit",
            "values fitted to it",
            "use",
        ],
        rows=[
            [
                e.run,
                e.kind,
                figure(e.before),
                figure(e.after),
                figure(e.noise),
                *("–" if (v := getattr(e, w)) is None else figure(v) for w in shown),
                "–" if e.band is None else figure(e.band),
                "–" if e.band is None else f"{100 * e.num_inside / e.num_samples:.0f} %",
                unit_of(e.unit) or "–",
                str(e.num_fitted),
                e.use,
            ]
            for e in rows
        ],
        caption="Root mean square over the samples. Before: the plain model at its own fit. After: "
        "the extended model. Nothing is fitted to these runs but what the study declares unknown "
        "per run; the table says how many values these are. Constant: the mean of the fitted runs, "
        "its zero as free as the model's. Held: the first reading of this run. Command: itself, "
        "late and shifted; none of these takes any skill. Without: the extended "
        "model with what was fitted to the run where the study states it. Inside: share of the "
        "samples in the band around the extended model.",
    )


def own(rows: Sequence[OwnRow]) -> list[Table]:
    """What was fitted to runs that nothing else was fitted to; empty where nothing was."""
    if not rows:
        return []
    table = Table(
        columns=["run", "value", "ended at", "stated ± 1 sd", "unit", "off by [sd]"],
        rows=[
            [
                row.run,
                words_of(row.name.partition("@")[0]),
                figure(row.value),
                with_sd(row.prior_value, row.prior_sd),
                unit_of(row.unit) or "–",
                f"{round(row.pull, 1) + 0.0:+.1f}",  # no minus before zero
            ]
            for row in (row.as_read() for row in rows)
        ],
        caption="Fitted to these runs for the extended model, by what the study declares unknown "
        "per run.",
        emphasis=[i for i, row in enumerate(rows) if abs(row.pull) > SURE_SD],
    )
    return [table]


def causes(r: Report) -> Table:
    """Every candidate cause with its status, probability and size."""
    columns = [
        "cause",
        "status",
        "size (90 % interval)",
        "probability",
        "gain where not fitted (90 % interval)",
        "removes",
        "note",
    ]
    return Table(
        columns=columns,
        rows=[_cause(row) for row in r.causes],
        caption="Probability: over all sets of causes that were weighed. Size: of causes that may "
        "act, as the extended model holds it, else averaged over the sets that hold the cause; "
        "intervals are over all these sets and hold the spread over left-out runs. Gain: share of "
        "the error removed from runs that the cause was not fitted to. Removes: share of the "
        "fitted misfit above the noise that is back without the cause.",
        emphasis=[i for i, row in enumerate(r.causes) if row.status == "certain"],
        folded=[i for i, row in enumerate(r.causes) if row.status in _OUT and not row.helps],
        folded_words="refuted, not visible or not judged",
    )


def base(rows: Sequence[BaseRow]) -> Table:
    """Base parameters beside their data sheets."""
    return Table(
        columns=[
            "parameter",
            "name",
            "fitted (90 % interval)",
            "data sheet ± 1 sd",
            "unit",
            "pull",
        ],
        rows=[_base(row) for row in rows],
        caption="Pull: distance from the data sheet in its standard deviations. Beyond ±3 the "
        "parameter is a finding of its own.",
        emphasis=[i for i, row in enumerate(rows) if row.finding],
    )


def apart(rows: Sequence[ApartRow]) -> Table:
    """Numbers that groups of runs have of their own, and how far each is from the others."""
    return Table(
        columns=["number", "of", "size (90 % interval)", "over the others", "unit", "differs"],
        rows=[_apart(row) for row in rows],
        caption="Over the others: the number less the median of the other groups, with its 90 % "
        "interval; of two batches, the mean of one less that of the other. It differs where all "
        "these differences together are that large by chance once "
        "in a hundred times. Else groups may still differ by what the interval holds.",
        emphasis=[i for i, row in enumerate(rows) if row.differs],
    )


def _apart(row: ApartRow) -> list[str]:
    size, over, unit = row.as_read()
    return [
        words_of(row.name),
        f"{row.fact} {row.label}",
        with_interval(size.value, size.low, size.high),
        with_interval(over.value, over.low, over.high),
        unit_of(unit) or "–",
        "yes" if row.differs else "not seen",
    ]


def outside(rows: Sequence[OutsideRow], file: str = "report.json") -> list[Table]:
    """Where test runs lie outside of what was fitted; empty where they do not.

    Args:
        rows: Quantities of the test runs, the farthest first.
        file: File that holds all of them.
    """
    beyond = [o for o in rows if o.times > 1.0]
    if not beyond:
        return []
    shown = [_outside(row) for row in beyond[:MOST_OUTSIDE]]
    caption = (
        "These runs ask for more than was fitted: the model is extrapolated there. Outside: "
        "strokes and rates over the largest fitted one; else the distance from the middle of the "
        "range over half its width."
    )
    if len(beyond) > MOST_OUTSIDE:  # the farthest come first
        caption += f" {len(beyond) - MOST_OUTSIDE} more lie outside by less; {file} has them."
    columns = ["run", "quantity", "value", "fitted range", "outside"]
    return [Table(columns=columns, rows=shown, caption=caption)]


def _outside(o: OutsideRow) -> list[str]:
    times = figure(o.times, 3 if o.times < 1.1 else 2)
    return [
        o.run,
        o.what,
        f"{figure(o.value) if isinstance(o.value, float) else o.value} {unit_of(o.unit)}".rstrip(),
        "–" if o.low is None or o.high is None else f"{figure(o.low)} to {figure(o.high)}",
        "never fitted" if math.isinf(o.times) else "barely" if times == "1" else f"{times} times",
    ]


def _cause(row: CauseRow) -> list[str]:
    row = row.as_read()
    return [
        # the name, as options take it, where the words do not say it
        row.words if row.words in (row.name, words_of(row.name)) else f"{row.words}\n{row.name}",
        _status(row),
        _sizes(row),
        "–" if row.probability is None else f"{row.probability:.2f}",
        _interval(row.gain),
        "–" if row.removes is None else percent(row.removes),
        _note(row),
    ]


def _note(row: CauseRow) -> str:
    """What else is said of a cause, and why it is not certain."""
    if row.status == UNJUDGED and row.note:
        return f"needs {row.note}"
    doubts = f"Likely, not certain: {'; '.join(row.doubts)}." if row.doubts else ""
    point = "" if not row.note or row.note.endswith(".") else "."
    return f"{row.note}{point} {doubts}".strip()


def _status(row: CauseRow) -> str:
    """The status with what it speaks of: rivals, or the smallest size that would be seen."""
    status, rivals = row.status, ", ".join(words_of(name) for name in row.rivals)
    if status == HIDDEN:
        seen = [v for v in row.smallest_visible.values() if math.isfinite(v)]
        low, high = (figure(f(seen)) for f in (min, max)) if seen else ("", "")
        size = low if low == high else f"{low} to {high}"
        status = f"{status} {size} {unit_of(row.unit)}".rstrip() if seen else "not visible"
    elif rivals:
        joined = {UNTOLD: " ", REFUTED: " by "}.get(status, "; rivals: ")
        status += f"{joined}{rivals}"
    return f"{status}; helps" if row.helps else status


def _sizes(row: CauseRow) -> str:
    """Sizes of a cause that may act, a line for each component."""
    if row.status in (REFUTED, HIDDEN) and not row.helps:
        return "–"
    return "\n".join(_format_size(row, c, size) for c, size in row.size.items()) or "–"


def _format_size(row: CauseRow, component: str, size: Interval) -> str:
    label = "" if len(row.size) == 1 else f"{component_words(component)}: "
    numbers = with_interval(size.value, size.low, size.high)
    said = f"{label}{numbers} {unit_of(row.unit)}".rstrip().replace(" ", "\u00a0")
    return said.replace("\u00a0(", " (").replace(")\u00a0", ") ")  # where a narrow column breaks


def sets(r: Report, most: int = 12) -> list[Table]:
    """The best sets of causes by evidence."""
    if not r.hypotheses:
        return []
    best = r.hypotheses[0].nats
    rows = [
        [
            " + ".join(words_of(n) for n in (*h.effects, *([h.unknown] if h.unknown else [])))
            or "nothing",
            signed(h.nats - best),
            figure(h.chi2),
            "refitted" if h.refitted else "linear",
        ]
        for h in r.hypotheses[:most]
    ]
    caption = (
        f"The {len(rows)} best sets of {len(r.hypotheses)} that were weighed. Evidence in nats "
        "behind the best: 3 nats are odds of 20 to 1."
    )
    columns = ["set of causes", "nats behind", "chi2", "how"]
    words = f"{len(rows)} sets of causes by evidence"
    folded = range(len(rows))
    return [Table(columns=columns, rows=rows, caption=caption, folded=folded, folded_words=words)]


def _base(row: BaseRow) -> list[str]:
    row = row.as_read()
    return [
        row.words,
        row.name,
        with_interval(row.value, row.low, row.high),
        with_sd(row.prior_value, row.prior_sd),
        unit_of(row.unit) or "–",
        signed(row.pull),
    ]


def _interval(gained: Gain | None) -> str:
    if gained is None:
        return "–"
    if gained.excess <= 0.0:  # of noise alone no share is left
        return "nothing to gain, but less is left" if gained.has_fallen else "nothing to gain"
    return f"{gained.value:.2f} ({gained.low:.2f} to {gained.high:.2f})"
