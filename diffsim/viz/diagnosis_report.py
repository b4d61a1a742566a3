"""The page of a diagnosis: the verdict first, its evidence and its limits after it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from diffsim.viz import diagnosis_figures as draw
from diffsim.viz import report as page
from diffsim.viz.diagnosis_content import VERDICTS, DiagnosisFigures
from diffsim.viz.figures import data_uri


def write_diagnosis(figures: DiagnosisFigures, path: str | Path) -> Path:
    """Write the page, one static HTML file.

    Returns:
        ``path``.
    """
    return page.write(diagnosis_page(figures), path)


def diagnosis_page(f: DiagnosisFigures) -> page.Report:
    """The page: verdict, held-out runs, residuals, force map, causes, confounding, blind spots,
    next run, what was held fixed."""
    sections = [
        _held_out(f),
        _residuals(f),
        _force_map(f),
        _causes(f),
        _confounding(f),
        _blind(f),
        _next_run(f),
        _gates(f),
    ]
    return page.Report(
        title=f"Diagnosis of {f.study}",
        subtitle=f"Recorded runs against the model “{f.model}”",
        verdict=f.sentences,
        numbers=_numbers(f),
        sections=sections,
        held_fixed=list(_pairs(f.settings)),
    )


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


def _numbers(f: DiagnosisFigures) -> list[page.Number]:
    found = [page.Number(label="verdict", value=f.verdict, tone=VERDICTS[f.verdict])]
    if f.num_samples:
        for label, chi2 in (("before", f.chi2_null), ("after", f.chi2_best)):
            found.append(
                page.Number(
                    label=f"misfit {label}, chi2 per sample",
                    value=_figure(chi2 / f.num_samples),
                    note="1: noise alone",
                )
            )
    if f.gain is not None:
        value, low, high = f.gain
        tone = "good" if low > 0.0 else "bad" if high < 0.0 else "fair"
        found.append(
            page.Number(
                label="share of the excess error removed on held-out runs",
                value=f"{100 * value:.0f}",
                unit="%",
                note=f"90 % interval {100 * low:.0f} to {100 * high:.0f} %",
                tone=tone,
            )
        )
    return found


def _held_out(f: DiagnosisFigures) -> page.Section:
    title = "Before and after, on runs that no fit has seen"
    runs = [run for run in f.runs if run.use == "holdout"]
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
        content=[page.Picture(uri=_png(draw.before_after(shown, f.channels)), caption=caption)],
    )


def _residuals(f: DiagnosisFigures) -> page.Section:
    caption = (
        "Measured minus predicted over the noise's standard deviation, all runs and channels. "
        "Grey: 95 % of noise alone. What stands out of the noise over the command's phase or at a "
        "frequency acts there."
    )
    content: list[page.Picture | page.Table] = [
        page.Picture(uri=_png(draw.residual_views(f.runs, f.channels)), caption=caption)
    ]
    places = draw.over_position(f.runs, f.channels)
    if places is not None:
        where = (
            "The same over where the model before predicts the system to be; lines: rms in ten "
            "bins, 1 for noise alone. What grows to one side acts there."
        )
        content.append(page.Picture(uri=_png(places), caption=where))
    if f.whiteness:
        content.append(_whiteness(f))
    return page.Section(title="Where and when the model is off", content=content)


def _whiteness(f: DiagnosisFigures) -> page.Table:
    rows = [
        [c.name, *(f"{p:.2g}" if math.isfinite(p) else "–" for p in column)]
        for c, column in zip(f.channels, zip(*f.whiteness, strict=True), strict=True)
    ]
    return page.Table(
        columns=["channel", "before", "extended"][: 1 + len(f.whiteness)],
        rows=rows,
        caption="Ljung–Box probability that whitened residuals of the runs fitted are white. "
        "Shown, not used: at 5 % it rejects many clean cases, since no noise is as modelled.",
    )


def _force_map(f: DiagnosisFigures) -> page.Section:
    title = "Where a force is missing"
    if f.force_map is None:
        return page.Section(title=title, text=["No force map was computed for this model."])
    return page.Section(title=title, content=[f.force_map])


def _causes(f: DiagnosisFigures) -> page.Section:
    columns = [
        "effect",
        "status",
        "size ± 1.64 sd (90 %)",
        "nats",
        "held-out gain (90 %)",
        "share",
        "may also be",
    ]
    rows = [
        [
            row.name,
            f"{row.status}, {row.note}" if row.note else row.status,
            f"{_figure(row.size)} ± {_figure(1.645 * row.sd)} {_unit(row.unit)}",
            "–" if row.nats is None else f"{row.nats:.1f}",
            "–" if row.gain is None else "{:.2f} ({:.2f} to {:.2f})".format(*row.gain),
            "–" if row.share is None else f"{100 * row.share:.0f} %",
            ", ".join(row.aliases),
        ]
        for row in f.causes
    ]
    table = page.Table(
        columns=columns,
        rows=rows,
        caption="Nats: evidence of the best set with the effect over that of the best without it; "
        "kept from 4. Share: of the misfit above the noise that it explains alone.",
        emphasis=[i for i, row in enumerate(f.causes) if row.status == "named"],
    )
    text = []
    if len(f.rivals) > 0:
        sets = "; ".join(" + ".join(rival) if rival else "nothing" for rival in f.rivals)
        text.append(f"These data do not decide between the best set and: {sets}.")
    return page.Section(title="Candidate causes, by evidence", text=text, content=[table])


def _confounding(f: DiagnosisFigures) -> page.Section:
    title = "What mimics what"
    if not len(f.confounding_names):
        return page.Section(title=title, text=["No candidate was screened."])
    blocks = draw.blocks_of(f.confounding)
    names = ["; ".join(", ".join(f.confounding_names[i] for i in b) for b in blocks)]
    text = [f"These data hardly part: {names[0]}."] if blocks else []
    caption = (
        f"Boxed: sets linked by cosines beyond ±{draw.CONFOUNDED}. Of one set only a set can be "
        "named, not a member."
    )
    uri = _png(draw.confounding_matrix(f.confounding_names, f.confounding))
    return page.Section(title=title, text=text, content=[page.Picture(uri=uri, caption=caption)])


def _blind(f: DiagnosisFigures) -> page.Section:
    visible = [row for row in f.causes if not math.isnan(row.smallest_visible)]
    content = [
        page.Table(
            columns=["effect", "smallest visible size"],
            rows=[[r.name, f"{_figure(r.smallest_visible)} {_unit(r.unit)}"] for r in visible],
            caption="Six standard deviations of what the data tell of the size. Below it an effect "
            "may be there and is not seen.",
        )
    ]
    if f.cannot_see:
        rows = [[name, why] for name, why in f.cannot_see.items()]
        content.insert(0, page.Table(columns=["not seen at all, or hardly", "why"], rows=rows))
    return page.Section(title="What these data cannot see", content=content)


def _next_run(f: DiagnosisFigures) -> page.Section:
    title = "Which run to record next"
    if f.next_run is None:
        text = "No advice: one explanation stands alone, or no bank of commands was given."
        return page.Section(title=title, text=[text])
    best, gains, over_median = f.next_run
    text = (
        f"Record “{best}”: it moves the nearest rivals apart by an expected chi2 of "
        f"{gains[best]:.3g}, {over_median:.1f} times the bank's median."
    )
    caption = "Distance of the nearest rivals after both are refitted, by run of the bank."
    uri = _png(draw.next_run_bars(gains, best))
    return page.Section(title=title, text=[text], content=[page.Picture(uri=uri, caption=caption)])


def _gates(f: DiagnosisFigures) -> page.Section:
    rows = [
        [g.name, "passed" if g.passed else "FAILED", _figure(g.value), _figure(g.limit), g.note]
        for g in f.gates
    ]
    table = page.Table(
        columns=["check", "", "value", "limit", "of what"],
        rows=rows,
        emphasis=[i for i, g in enumerate(f.gates) if not g.passed],
    )
    return page.Section(title="Checks before physics is blamed", content=[table] if rows else [])


def _png(figure: Any) -> str:
    # many dots: as lines of text they would take megabytes
    return data_uri(figure, png=True)


def _figure(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.3g}"


def _unit(unit: str) -> str:
    return "" if unit == "-" else unit
