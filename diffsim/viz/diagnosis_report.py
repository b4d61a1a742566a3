"""The page of a diagnosis: the verdict first, its evidence and its limits after it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diffsim.data.study import Channel
from diffsim.diagnose.force_map import ForceMap
from diffsim.diagnose.gain import Gain
from diffsim.diagnose.report import Z90, Report
from diffsim.diagnose.whiteness import ljung_box
from diffsim.viz import diagnosis_figures as draw
from diffsim.viz import report as page
from diffsim.viz.diagnosis_figures import PredictedRun
from diffsim.viz.figures import data_uri

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_COMMANDS = 6  # in the force map
TONES = {
    "none": "good",
    "named": "good",
    "ambiguous": "fair",
    "unknown": "fair",
    "unrepeatable": "bad",
    "numerical": "bad",
}
"""Verdicts, and the tone in which the page shows them."""


def write_diagnosis(report: Report, path: str | Path) -> Path:
    """Write the page, one static HTML file.

    Returns:
        ``path``.
    """
    return page.write(diagnosis_page(report), path)


def diagnosis_page(report: Report) -> page.Report:
    """The page: verdict, held-out runs, residuals, force map, causes, confounding, blind spots,
    next run, what was held fixed. All runs are predicted, before and after."""
    channels = draw.with_noise(report.study.channels, report.noise["sd"])
    extended = report.best if report.named else None
    runs = draw.predicted_runs(report.study, report.null, extended)
    return page.Report(
        title=f"Diagnosis of {report.study.name}",
        subtitle=f"Recorded runs against the model “{report.model.name}”",
        verdict=report.sentences,
        numbers=_numbers(report),
        sections=[
            _held_out(runs, channels),
            _residuals(report, runs, channels),
            _force_map(report.force_map),
            _causes(report),
            _confounding(report),
            _blind(report),
            _next_run(report),
            _gates(report),
        ],
        held_fixed=list(_pairs(held_fixed(report))),
    )


def held_fixed(report: Report) -> dict[str, Any]:
    """Thresholds and seed, and what entered as it is; versions stand beside it on the page."""
    settings = {k: v for k, v in report.settings.items() if k != "versions"}
    effort = settings.pop("search", {})
    base = [p.name for p in report.model.base]
    shared = [name for name in base if "@" not in name]
    return {
        "fitted": f"{', '.join(shared)}; {len(base) - len(shared)} nuisances of single runs",
        "all else of the model": "held fixed",
        "taken from the study": list(report.study.metadata) or "runs and channels only",
        "noise floor from": list(dict.fromkeys(report.noise["source"])),
        "spikes taken out": report.noise["num_spikes"],
        **settings,
        "effort of the search": effort,
    }


def _pairs(settings: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    """Nested settings as lines; an empty list is said, not shown as brackets."""
    for name, value in settings.items():
        words = f"{before}{name.replace('_', ' ')}"
        if isinstance(value, Mapping):
            yield from _pairs(value, f"{words}: ")
        elif isinstance(value, (list, tuple)):
            yield words, ", ".join(map(str, value)) or "none"
        else:
            yield words, str(value)


def _numbers(r: Report) -> list[page.Number]:
    shown = [page.Number(label="verdict", value=r.verdict, tone=TONES[r.verdict])]
    if r.num_samples:
        for label, chi2 in (("before", r.chi2_null), ("after", r.chi2_best)):
            shown.append(
                page.Number(
                    label=f"misfit {label}, chi2 per sample",
                    value=_figure(chi2 / r.num_samples),
                    note="1: noise alone",
                )
            )
    if r.gain is not None:
        g = r.gain
        tone = "good" if g.low > 0.0 else "bad" if g.high < 0.0 else "fair"
        shown.append(
            page.Number(
                label="share of the excess error removed on held-out runs",
                value=f"{100 * g.value:.0f}",
                unit="%",
                note=f"90 % interval {100 * g.low:.0f} to {100 * g.high:.0f} %",
                tone=tone,
            )
        )
    return shown


def _held_out(all_runs: Sequence[PredictedRun], channels: Sequence[Channel]) -> page.Section:
    title = "Before and after, on runs that no fit has seen"
    runs = [run for run in all_runs if run.use == "test"]
    if not runs:
        return page.Section(title=title, text=["The study has no held-out run: no gain is known."])
    shown = runs[:4]
    text = [] if len(shown) == len(runs) else [f"The first {len(shown)} of {len(runs)} runs."]
    caption = (
        "Dots: measured. Dashed: the fitted model before. Line: the extended model. The channels "
        "with the largest misfit before, in units of their noise."
    )
    return page.Section(
        title=title,
        text=text,
        content=[page.Picture(uri=_png(draw.before_after(shown, channels)), caption=caption)],
    )


def _residuals(
    r: Report, runs: Sequence[PredictedRun], channels: Sequence[Channel]
) -> page.Section:
    caption = (
        "Measured minus predicted over the noise's standard deviation, all runs and channels. "
        "Grey: 95 % of noise alone. What stands out of the noise over the command's phase or at a "
        "frequency acts there."
    )
    content: list[page.Picture | page.Table] = [
        page.Picture(uri=_png(draw.residual_views(runs, channels)), caption=caption)
    ]
    places = draw.over_position(runs, channels)
    if places is not None:
        where = (
            "The same over where the model before predicts the system to be; lines: rms in ten "
            "bins, 1 for noise alone. What grows to one side acts there."
        )
        content.append(page.Picture(uri=_png(places), caption=where))
    fits = [r.null, r.best] if r.named else [r.null]
    content.append(_whiteness(channels, [ljung_box(fit).tolist() for fit in fits]))
    return page.Section(title="Where and when the model is off", content=content)


def _whiteness(channels: Sequence[Channel], probabilities: Sequence[Sequence[float]]) -> page.Table:
    rows = [
        [c.name, *(f"{p:.2g}" if math.isfinite(p) else "–" for p in column)]
        for c, column in zip(channels, zip(*probabilities, strict=True), strict=True)
    ]
    return page.Table(
        columns=["channel", "before", "extended"][: 1 + len(probabilities)],
        rows=rows,
        caption="Ljung–Box probability that whitened residuals of the runs fitted are white. "
        "Shown, not used: at 5 % it rejects many clean cases, since no noise is as modeled.",
    )


def _force_map(scores: ForceMap | None) -> page.Section:
    """Commands with the largest scores first."""
    title = "Where a force is missing"
    if scores is None:
        return page.Section(title=title, text=["No force map was computed for this model."])
    order = np.argsort(-np.abs(scores.z).max(axis=1))[:MAX_COMMANDS]
    groups = [scores.groups[i] for i in order]
    caption = (
        f"Score of {scores.name} at the model before: how much a force of that shape and time "
        "would lower the misfit, over what noise alone makes of it (from repeats where there are). "
        "Beyond ±3: a force is missing there and then."
    )
    if len(groups) < len(scores.groups):
        caption += f" The {MAX_COMMANDS} commands with the largest scores of {len(scores.groups)}."
    uri = _png(draw.force_map(scores.components, groups, scores.z[order]))
    return page.Section(title=title, content=[page.Picture(uri=uri, caption=caption)])


def _causes(r: Report) -> page.Section:
    columns = [
        "effect",
        "status",
        "size ± 1.64 sd (90 %)",
        "nats",
        "held-out gain (90 %)",
        "share",
        "may also be",
    ]
    shown = [(row, component) for row in r.table for component in row.size]
    rows = [
        [
            row.label(component),
            f"{row.status}, {row.note}" if row.note else row.status,
            f"{_figure(row.size[component])} ± {_figure(Z90 * row.sd[component])} "
            f"{_unit(row.unit)}",
            "–" if row.nats is None else f"{row.nats:.1f}",
            _interval(row.gain),
            "–" if row.share is None else f"{100 * row.share:.0f} %",
            ", ".join(row.aliases),
        ]
        for row, component in shown
    ]
    table = page.Table(
        columns=columns,
        rows=rows,
        caption="Nats: evidence of the best set with the effect over that of the best without it; "
        "kept from 4. Share: of the misfit above the noise that it explains alone.",
        emphasis=[i for i, (row, _) in enumerate(shown) if row.status == "named"],
    )
    text = []
    if len(r.rivals) > 0:
        sets = "; ".join(" + ".join(rival) if rival else "nothing" for rival in r.rivals)
        text.append(f"These data do not decide between the best set and: {sets}.")
    return page.Section(title="Candidate causes, by evidence", text=text, content=[table])


def _confounding(r: Report) -> page.Section:
    title = "What mimics what"
    if not len(r.confounding_names):
        return page.Section(title=title, text=["No candidate was screened."])
    blocks = draw.blocks_of(r.confounding)
    names = ["; ".join(", ".join(r.confounding_names[i] for i in b) for b in blocks)]
    text = [f"These data hardly part: {names[0]}."] if blocks else []
    caption = (
        f"Boxed: sets linked by cosines beyond ±{draw.CONFOUNDED}. Of one set only a set can be "
        "named, not a member."
    )
    uri = _png(draw.confounding_matrix(r.confounding_names, r.confounding))
    return page.Section(title=title, text=text, content=[page.Picture(uri=uri, caption=caption)])


def _blind(report: Report) -> page.Section:
    visible = [(r, c, size) for r in report.table for c, size in r.smallest_visible.items()]
    content = [
        page.Table(
            columns=["effect", "smallest visible size"],
            rows=[[r.label(c), f"{_figure(size)} {_unit(r.unit)}"] for r, c, size in visible],
            caption="Six standard deviations of what the data tell of the size. Below it an effect "
            "may be there and is not seen.",
        )
    ]
    if report.cannot_see:
        rows = [[name, why] for name, why in report.cannot_see.items()]
        content.insert(0, page.Table(columns=["not seen at all, or hardly", "why"], rows=rows))
    return page.Section(title="What these data cannot see", content=content)


def _next_run(r: Report) -> page.Section:
    title = "Which run to record next"
    if r.next_run is None:
        text = "No advice: one explanation stands alone, or no bank of commands was given."
        return page.Section(title=title, text=[text])
    best, gains = r.next_run.best, r.next_run.chi2_gain
    text = (
        f"Record “{best}”: it moves the nearest rivals apart by an expected chi2 of "
        f"{gains[best]:.3g}, {r.next_run.over_median:.1f} times the bank's median."
    )
    caption = "Distance of the nearest rivals after both are refitted, by run of the bank."
    uri = _png(draw.next_run_bars(gains, best))
    return page.Section(title=title, text=[text], content=[page.Picture(uri=uri, caption=caption)])


def _gates(r: Report) -> page.Section:
    rows = [
        [g.name, "passed" if g.passed else "FAILED", _figure(g.value), _figure(g.limit), g.note]
        for g in r.gates
    ]
    table = page.Table(
        columns=["check", "", "value", "limit", "of what"],
        rows=rows,
        emphasis=[i for i, g in enumerate(r.gates) if not g.passed],
    )
    return page.Section(title="Checks before physics is blamed", content=[table] if rows else [])


def _png(figure: Figure) -> str:
    # many dots: as lines of text they would take megabytes
    return data_uri(figure, png=True)


def _figure(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.3g}"


def _unit(unit: str) -> str:
    return "" if unit == "-" else unit


def _interval(gained: Gain | None) -> str:
    if gained is None:
        return "–"
    return f"{gained.value:.2f} ({gained.low:.2f} to {gained.high:.2f})"
