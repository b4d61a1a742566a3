"""Tables of a diagnosis's page: errors, causes, sets of causes, base parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence

from diffsim.diagnose.gain import Gain
from diffsim.diagnose.records import REFUTED, BaseRow, CauseRow, Interval
from diffsim.diagnose.report import Report
from diffsim.viz.report import Table

MOST_OUTSIDE = 10  # rows: a flight has twenty quantities, most just outside


def errors(r: Report) -> Table:
    """Error before and after on every run that was not fitted."""
    return Table(
        columns=["run", "of", "before", "after", "noise", "unit", "values fitted to it", "use"],
        rows=[
            [
                e.run,
                e.kind,
                figure(e.before),
                figure(e.after),
                figure(e.noise),
                e.unit,
                str(e.num_fitted),
                e.use,
            ]
            for e in r.errors
        ],
        caption="Root mean square over the samples. Before: the plain model at its own fit. After: "
        "the extended model. Nothing is fitted to these runs but what the study declares unknown "
        "per run; the table says how many values these are.",
    )


def causes(r: Report) -> Table:
    """Every candidate cause with its status, probability and size."""
    columns = [
        "cause",
        "name",
        "status",
        "probability",
        "size (90 % interval)",
        "gain where not fitted (90 %)",
        "note",
    ]
    return Table(
        columns=columns,
        rows=[_cause(row) for row in r.causes],
        caption="Probability: over all sets of causes that were weighed. Size: averaged over the "
        "sets that hold the cause; intervals hold the spread over left-out runs.",
        emphasis=[i for i, row in enumerate(r.causes) if row.status == "certain"],
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


def outside(r: Report) -> list[Table]:
    """Where test runs lie outside of what was fitted; empty where they do not."""
    beyond = [o for o in r.outside if o.times > 1.0]
    if not beyond:
        return []
    rows = [
        [
            o.run,
            o.what,
            f"{figure(o.value) if isinstance(o.value, float) else o.value} {unit_of(o.unit)}",
            "–" if o.low is None or o.high is None else f"{figure(o.low)} to {figure(o.high)}",
            "never fitted" if math.isinf(o.times) else f"{o.times:.2g} times",
        ]
        for o in beyond[:MOST_OUTSIDE]
    ]
    caption = "These runs ask for more than was fitted: the model is extrapolated there."
    if len(beyond) > MOST_OUTSIDE:  # the farthest come first
        caption += f" {len(beyond) - MOST_OUTSIDE} more lie outside by less; report.json has them."
    columns = ["run", "quantity", "value", "fitted range", "outside"]
    return [Table(columns=columns, rows=rows, caption=caption)]


def _cause(row: CauseRow) -> list[str]:
    row, status = row.as_read(), row.status
    if row.rivals:
        by = " by" if status == REFUTED else ""
        status += f"{by} {', '.join(row.rivals)}"
    if row.helps:
        status += "; helps"
    return [
        row.words,
        row.name,
        status,
        "–" if row.probability is None else f"{row.probability:.2f}",
        "; ".join(_sized(row, c, size) for c, size in row.size.items()) or "–",
        _interval(row.gain),
        row.note,
    ]


def _sized(row: CauseRow, component: str, size: Interval) -> str:
    label = "" if len(row.size) == 1 else f"{component} "
    numbers = f"{figure(size.value)} ({figure(size.low)} to {figure(size.high)})"
    return f"{label}{numbers} {unit_of(row.unit)}".rstrip()


def sets(r: Report, most: int = 12) -> list[Table]:
    """The best sets of causes by evidence."""
    if not r.hypotheses:
        return []
    best = r.hypotheses[0].nats
    rows = [
        [
            " + ".join((*h.effects, *([h.unknown] if h.unknown else []))) or "nothing",
            f"{h.nats - best:+.1f}",
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
    return [Table(columns=columns, rows=rows, caption=caption)]


def _base(row: BaseRow) -> list[str]:
    row = row.as_read()
    return [
        row.words,
        row.name,
        f"{figure(row.value)} ({figure(row.low)} to {figure(row.high)})",
        f"{figure(row.prior_value)} ± {figure(row.prior_sd)}",
        row.unit,
        f"{row.pull:+.1f}",
    ]


def figure(value: float) -> str:
    """A number of three digits."""
    return "–" if math.isnan(value) else f"{value:.3g}"


def unit_of(unit: str) -> str:
    """A unit as it is written after a number."""
    return "" if unit == "-" else unit


def _interval(gained: Gain | None) -> str:
    if gained is None:
        return "–"
    return f"{gained.value:.2f} ({gained.low:.2f} to {gained.high:.2f})"
