"""The page of a diagnosis: the verdict first, its evidence and its limits after it.

``DiagnosisFigures`` holds all that is on the page in plain types; ``figures_of`` fills it from what
``diffsim.diagnose`` reports.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim._check import require_choice
from diffsim.diagnose.gain import held_out_point
from diffsim.diagnose.whiteness import ljung_box
from diffsim.viz import diagnosis_figures as draw
from diffsim.viz import report as page
from diffsim.viz.diagnosis_figures import MeasuredChannel, RunComparison
from diffsim.viz.figures import data_uri

Array = NDArray[np.float64]
MAPPED = 6  # commands in the force map
VERDICTS = {
    "none": "good",
    "named": "good",
    "ambiguous": "fair",
    "unknown": "fair",
    "unrepeatable": "bad",
    "numerical": "bad",
}
"""Verdicts, and the tone in which the page shows them."""


@dataclass(frozen=True, kw_only=True)
class CauseRow:
    """One component of a candidate in the ranked table.

    Attributes:
        name: Of the effect, with the component where there are several.
        status: "named", "rival", "mimic", "screened" or "not judged".
        size, sd, unit: Size and its standard deviation [unit].
        nats: Evidence against the best set without it; None where it was only screened.
        gain: (value, low, high): share of the excess error removed on held-out runs, 90 % interval.
        share: Of the misfit that it explains alone.
        aliases: What these data may not tell from it.
        smallest_visible: [unit].
        note: Such as "not confirmed".
    """

    name: str
    status: str
    size: float
    sd: float
    unit: str
    nats: float | None = None
    gain: tuple[float, float, float] | None = None
    share: float | None = None
    aliases: Sequence[str] = ()
    smallest_visible: float = math.nan
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class GateRow:
    """One check before physics is blamed: ``value`` against ``limit``."""

    name: str
    passed: bool
    value: float
    limit: float
    note: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class DiagnosisFigures:
    """What the page shows.

    Attributes:
        study, model: Names.
        verdict: One of ``VERDICTS``.
        sentences: The verdict in words, with numbers and units.
        channels: Of the study, with the noise that was estimated.
        runs: Fitted and held out.
        causes: Ranked.
        confounding_names, confounding: Components and their (n, n) cosines.
        cannot_see: Effect -> why, or the smallest visible size.
        gates: Data, gradients, numerics.
        rivals: Sets within 3 nats of the best.
        gain: (value, low, high) of the best set on held-out runs.
        chi2_null, chi2_best, num_samples: Of the runs fitted.
        next_run: (name advised, expected chi2 by run of the bank, best over median).
        force_map: Picture of where and when a force is missing, over its noise scale.
        settings: Thresholds, seed and what else was held fixed.
        whiteness: Ljung-Box probability by channel, of the model before and the extended one.
    """

    study: str
    model: str
    verdict: str
    sentences: Sequence[str]
    channels: Sequence[MeasuredChannel]
    runs: Sequence[RunComparison]
    causes: Sequence[CauseRow]
    confounding_names: Sequence[str]
    confounding: Array
    cannot_see: Mapping[str, str]
    gates: Sequence[GateRow] = ()
    rivals: Sequence[Sequence[str]] = ()
    gain: tuple[float, float, float] | None = None
    chi2_null: float = math.nan
    chi2_best: float = math.nan
    num_samples: int = 0
    next_run: tuple[str, Mapping[str, float], float] | None = None
    force_map: page.Picture | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    whiteness: Sequence[Sequence[float]] = ()

    def __post_init__(self) -> None:
        require_choice("verdict", self.verdict, VERDICTS)
        n = len(self.confounding_names)
        if self.confounding.shape != (n, n):
            raise ValueError(
                f"confounding must have shape ({n}, {n}), one row per name, got "
                f"{self.confounding.shape}"
            )
        for run in self.runs:
            if run.measured.shape != (len(run.time_s), len(self.channels)):
                raise ValueError(
                    f"run {run.name}: measured must have shape ({len(run.time_s)}, "
                    f"{len(self.channels)}) (samples, channels), got {run.measured.shape}"
                )


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


def figures_of(report: Any, *, force_map: page.Picture | None = None) -> DiagnosisFigures:
    """Fill the page's figures from a diagnosis, predicting all runs before and after.

    Args:
        report: ``diffsim.diagnose.Report``.
        force_map: In place of the report's own map.
    """
    study = report.study
    extended = report.best if report.named else None
    fits = [report.null] if extended is None else [report.null, extended]
    next_run = report.next_run
    return DiagnosisFigures(
        study=study.name,
        model=report.model.name,
        verdict=report.verdict,
        sentences=report.sentences,
        channels=measured_channels(study, report.noise["sd"]),
        runs=comparisons(study, report.null, extended),
        causes=[row for effect in report.table for row in _cause_rows(effect)],
        confounding_names=report.confounding_names,
        confounding=report.confounding,
        cannot_see=report.cannot_see,
        gates=[
            GateRow(name=g.name, passed=g.passed, value=g.value, limit=g.limit, note=g.note)
            for g in report.gates
        ],
        rivals=report.rivals,
        gain=_interval(report.gain),
        chi2_null=report.chi2_null,
        chi2_best=report.chi2_best,
        num_samples=report.num_samples,
        next_run=None
        if next_run is None
        else (next_run["best"], next_run["chi2_gain"], next_run["over_median"]),
        force_map=_mapped(report.force_map) if force_map is None else force_map,
        settings=_held_fixed(report),
        whiteness=[ljung_box(fit).tolist() for fit in fits],
    )


def _mapped(found: Any) -> page.Picture | None:
    """Picture of ``diffsim.diagnose.ForceMap``, commands with the largest scores first."""
    if found is None:
        return None
    order = np.argsort(-np.abs(found.z).max(axis=1))[:MAPPED]
    groups = [found.groups[i] for i in order]
    caption = (
        f"Score of {found.name} at the model before: how much a force of that shape and time would "
        "lower the misfit, over what noise alone makes of it (from repeats where there are). "
        "Beyond ±3: a force is missing there and then."
    )
    if len(groups) < len(found.groups):
        caption += f" The {MAPPED} commands with the largest scores of {len(found.groups)}."
    return page.Picture(
        uri=_png(draw.force_map(found.components, groups, found.z[order])), caption=caption
    )


def _held_fixed(report: Any) -> dict[str, Any]:
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


def measured_channels(study: Any, sd: Mapping[str, float]) -> list[MeasuredChannel]:
    """Channels of a study with the noise that was estimated, by name."""
    return [
        MeasuredChannel(name=c.name, unit=c.unit, sd=float(sd[c.name]), kind=c.kind)
        for c in study.channels
    ]


def comparisons(study: Any, null: Any, extended: Any = None) -> list[RunComparison]:
    """Measured and predicted, runs for fitting first.

    Args:
        study: ``diffsim.data.Study``.
        null, extended: ``diffsim.identify.Fit`` without and with effects.
    """
    return [
        RunComparison(
            name=run.name,
            use=run.use,
            time_s=run.time_s,
            command=run.command,
            measured=run.measured,
            null=predicted(null, run),
            extended=None if extended is None else predicted(extended, run),
        )
        for run in (*study.fit_runs, *study.holdout_runs)
    ]


def predicted(fit: Any, run: Any) -> Array:
    """(num_samples, num_channels) of a ``diffsim.identify.Fit`` at its parameters.

    Nuisances of a held-out run are fitted to it, as the gain does.
    """
    x = held_out_point(fit, run) if run.use == "holdout" else fit.x
    with torch.no_grad():
        return fit.problem.predict(run, torch.as_tensor(x)).numpy()


def _cause_rows(effect: Any) -> list[CauseRow]:
    many = len(effect.size) > 1
    return [
        CauseRow(
            name=f"{effect.effect}.{component}" if many else effect.effect,
            status=effect.status,
            size=size,
            sd=effect.sd[component],
            unit=effect.unit,
            nats=effect.nats,
            gain=_interval(effect.gain),
            share=effect.share,
            aliases=effect.aliases,
            smallest_visible=effect.smallest_visible[component],
            note=effect.note,
        )
        for component, size in effect.size.items()
    ]


def _interval(gain: Any) -> tuple[float, float, float] | None:
    return None if gain is None else (gain.value, gain.low, gain.high)


def _png(figure: Any) -> str:
    # many dots: as lines of text they would take megabytes
    return data_uri(figure, png=True)


def _figure(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.3g}"


def _unit(unit: str) -> str:
    return "" if unit == "-" else unit
