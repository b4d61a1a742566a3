"""The page of a diagnosis: the answer in one sentence first, its evidence and limits after it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.core.figures import figure, list_first, percent, probability, unit_of
from diffsim.data.study import Channel
from diffsim.diagnose.checks.gates import GateResult
from diffsim.diagnose.checks.noise import ljung_box
from diffsim.diagnose.judge.apart import apart_words
from diffsim.diagnose.judge.own_values import words_of
from diffsim.diagnose.judge.records import CERTAIN
from diffsim.diagnose.say.force_map import ForceMap
from diffsim.diagnose.say.law_records import DESCRIBED
from diffsim.diagnose.say.report import Report
from diffsim.diagnose.say.wording import MOST_LISTED, component_words
from diffsim.viz import diagnosis_charts as draw
from diffsim.viz import diagnosis_tables as tables
from diffsim.viz import report as page
from diffsim.viz.diagnosis_laws import laws_section
from diffsim.viz.diagnosis_motion import moving_runs
from diffsim.viz.diagnosis_parts import band_numbers, error_numbers, gain_numbers, runs_section
from diffsim.viz.diagnosis_series import (
    CONFOUNDED,
    PredictedRun,
    blocks_of,
    predicted_runs,
    with_noise,
)

MAX_COMMANDS = 12  # in the menu of the force map
MAX_NUISANCES = 40  # rows of the table of base parameters
TONES = {
    "none": "good",
    "data_sheet": "good",
    "named": "good",
    "ambiguous": "fair",
    DESCRIBED: "good",
    "unknown": "fair",
    "unrepeatable": "bad",
    "numerical": "bad",
}
"""Verdicts, and the tone in which the page shows them."""
MEANINGS = {
    "none": "the misfit is noise",
    "data_sheet": "no cause is missing; a number of the data sheet is off",
    "named": "one or more causes are certain",
    "ambiguous": "causes that these recordings cannot tell apart",
    DESCRIBED: "a law that is not in the library",
    "unknown": "something is missing that is not in the library",
    "unrepeatable": "repeats scatter far beyond the sensor's noise",
    "numerical": "time step, mesh or tolerance still move the record",
}
"""Verdicts in words, as ``docs/diagnose_reading.md`` has them."""
LIKELY_ONLY = {
    "named": "one or more causes are likely, none is certain",
    DESCRIBED: "a law that is not in the library; likely, not certain",
}


def write_diagnosis(report: Report, path: str | Path) -> Path:
    """Write the page, one static HTML file.

    Returns:
        ``path``.
    """
    return page.write(diagnosis_page(report), path)


def diagnosis_page(report: Report) -> page.Report:
    """The page: answer, errors on test runs, causes, data sheet, residuals, blind spots, next run.

    All runs are predicted, before and after.
    """
    channels = with_noise(report.study.channels, report.noise["sd"])
    extended = report.best if report.best is not report.null else None
    runs = predicted_runs(report.study, report.null, extended, bands=report.bands)
    laws, is_described = laws_section(report), report.verdict == DESCRIBED
    return page.Report(
        title=f"Diagnosis of {report.study.name}",
        subtitle=f"Recorded runs against the model “{report.model.name}”",
        verdict=[report.headline or report.sentences[0]],
        numbers=_numbers(report),
        sections=[
            _test_runs(report, runs, channels),
            *(laws if is_described else []),
            _causes(report),
            *([] if is_described else laws),
            _errors(report),
            *_apart(report),
            _data_sheet(report),
            _residuals(report, runs, channels),
            _force_map(report.force_map),
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
        "jumps of measured commands taken out": report.noise["num_misread"],
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
    """Verdict, then error before and after on unseen runs in the recordings' unit, then gain."""
    certain = {row.name for row in r.causes if row.status == CERTAIN}
    is_likely_only = r.verdict in ("named", DESCRIBED) and certain.isdisjoint(r.named)
    verdict = page.Number(
        label="verdict",
        value=r.verdict.replace("_", " "),
        note=LIKELY_ONLY[r.verdict] if is_likely_only else MEANINGS[r.verdict],
        tone="fair" if is_likely_only else TONES[r.verdict],
    )
    gained = gain_numbers(r.gain)
    return [verdict, *error_numbers(r.errors), *gained, *band_numbers(r.errors)]


def _errors(r: Report) -> page.Section:
    title = "Error on runs that nothing has seen"
    if not r.errors:
        why = "The study has no run with “use: test”, so no gain is known."
        return page.Section(title=title, text=[why])
    text = [f"Causes were chosen by {r.chosen_by}."] if r.chosen_by else []
    return page.Section(
        title=title,
        text=text,
        content=[tables.errors(r.errors), *tables.own(r.own), *tables.outside(r.outside)],
    )


def _test_runs(
    r: Report, all_runs: Sequence[PredictedRun], channels: Sequence[Channel]
) -> page.Section:
    """All test runs; without any, select runs, else those that were fitted."""
    use = next(use for use in _TITLES if any(run.use == use for run in all_runs))
    runs = [run for run in all_runs if run.use == use]
    return runs_section(_TITLES[use], runs, channels, moving_runs(r, runs))


_TITLES = {
    "test": "Measured and predicted, on test runs",
    "select": "Measured and predicted, on the runs that chose between causes",
    "fit": "Measured and predicted, on the runs that were fitted",
}


def _residuals(
    r: Report, runs: Sequence[PredictedRun], channels: Sequence[Channel]
) -> page.Section:
    caption = (
        "Measured minus predicted over the noise's standard deviation, all runs and channels. "
        "Grey: 95 % of noise alone. What stands out of the noise over the command's phase or at a "
        "frequency acts there."
    )
    content: list[page.Item] = [
        page.Chart(figure=draw.residual_views(runs, channels), caption=caption)
    ]
    places = draw.over_position(runs, channels)
    if places is not None:
        where = (
            "The same over where the model before predicts the system to be; lines: rms in ten "
            "bins, 1 for noise alone. What grows to one side acts there."
        )
        content.append(page.Chart(figure=places, caption=where))
    fits = [r.null] if r.best is r.null else [r.null, r.best]
    content.append(_whiteness(channels, [ljung_box(fit).tolist() for fit in fits]))
    return page.Section(title="Where and when the model is off", content=content)


def _whiteness(channels: Sequence[Channel], probabilities: Sequence[Sequence[float]]) -> page.Table:
    rows = [
        [c.name, *map(probability, column)]
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
        why = "No force map: the description names no place where a force may act."
        return page.Section(title=title, text=[why])
    order = np.argsort(-np.abs(scores.z).max(axis=1))[:MAX_COMMANDS]
    groups = [scores.groups[i] for i in order]
    caption = (
        f"Score of {scores.name} at the model before: how much a force of that shape and time "
        "would lower the misfit, over what noise alone makes of it (from repeats where there are). "
        "Beyond ±3: a force is missing there and then."
    )
    if len(groups) < len(scores.groups):
        caption += f" The {MAX_COMMANDS} commands with the largest scores of {len(scores.groups)}."
    chart = draw.force_map(scores.components, groups, scores.z[order])
    return page.Section(title=title, content=[page.Chart(figure=chart, caption=caption)])


def _causes(r: Report) -> page.Section:
    """Causes by probability, then sets of causes as they were weighed."""
    title = "What acts, and what does not"
    if not r.causes:
        return page.Section(title=title, text=["No cause was judged."])
    text = list(r.sentences)
    if r.unknown_share is not None and r.unknown_share >= 0.01:
        share = percent(r.unknown_share)
        text.append(f"{share} of the misfit above the noise stays without a name.")
    if r.interval_factor > 1.05:
        text.append(
            f"Intervals are up to {r.interval_factor:.2g} times as wide as noise alone makes them."
        )
    return page.Section(title=title, text=text, content=[tables.causes(r), *tables.sets(r)])


def _apart(r: Report) -> list[page.Section]:
    """What groups of runs share and in what they differ; none where nothing may differ."""
    if not (rows := r.apart):
        return []
    title = f"What each {' and '.join(dict.fromkeys(row.fact for row in rows))} has of its own"
    text = list(apart_words(rows, r.shared))
    return [page.Section(title=title, text=text, content=[tables.apart(rows)])]


def _data_sheet(r: Report) -> page.Section:
    title = "Base parameters against their data sheets"
    told = [row for row in r.base if row.is_told]
    shared = [row for row in told if row.run is None]
    own = sorted((row for row in told if row.run is not None), key=lambda row: -abs(row.pull))
    shown = [*shared, *own[:MAX_NUISANCES]]
    if not r.base:
        return page.Section(title=title, text=["The model has no base parameter."])
    text = []
    if (left := len(own) - MAX_NUISANCES) > 0:
        text.append(f"{left} more values of single runs, of smaller pull, are in report.json.")
    stems = (row.name.partition("@")[0].partition("[")[0] for row in r.base if not row.is_told)
    if names := list(dict.fromkeys(words_of(stem) for stem in stems)):
        whole = {words_of(row.name.partition("@")[0].partition("[")[0]) for row in told}
        some = ["some of " * (name in whole) + name for name in names]
        text.append(f"These runs say nothing of {list_first(some, MOST_LISTED * 2)}.")
    content = [tables.base(shown)] if shown else []
    return page.Section(title=title, text=text, content=content)


def _confounding(r: Report) -> page.Section:
    title = "What mimics what"
    if not len(r.confounding_names):
        return page.Section(title=title, text=["No candidate was screened."])
    blocks = blocks_of(r.confounding)
    words = [_component_of(name) for name in r.confounding_names]
    sets = [" and ".join(words[i] for i in block) for block in blocks]
    text = [f"These data hardly part {list_first(sets, MOST_LISTED, '; ')}."] if blocks else []
    caption = (
        f"Boxed: sets linked by cosines beyond ±{CONFOUNDED}. Of one set only a set can be "
        "named, not a member."
    )
    chart = draw.confounding_matrix(words, r.confounding)
    return page.Section(title=title, text=text, content=[page.Chart(figure=chart, caption=caption)])


def _component_of(name: str) -> str:
    """A component of a cause in words: "stiffness_loss.root" is "stiffness loss (root)"."""
    effect, _, component = name.partition(".")
    words = words_of(effect)
    return f"{words} ({component_words(component)})" if component else words


def _blind(report: Report) -> page.Section:
    """Smallest visible sizes; a cause that was sized above its own is not among them."""
    sized = {c.name for c in report.causes if c.status in ("certain", "likely")}
    hidden = {n: why for n, why in report.cannot_see.items() if n.split(".")[0] not in sized}
    visible = [
        (row, c, size)
        for row in report.table
        if row.effect not in sized
        for c, size in row.smallest_visible.items()
        if math.isfinite(size) and row.label(c) not in hidden
    ]
    content: list[page.Item] = []
    if hidden:
        rows = [[_component_of(name), why] for name, why in hidden.items()]
        content.append(_fold(["not seen at all, or hardly", "why"], rows, "not seen, or hardly"))
    if visible:
        caption = (
            "Six standard deviations of what the data tell of the size. Below it a cause may act "
            "and is not seen."
        )
        rows = [
            [_component_of(row.label(c)), f"{figure(size, 2)} {unit_of(row.unit)}"]
            for row, c, size in visible
        ]
        what = "causes by the size that would be seen"
        content.append(_fold(["cause", "smallest visible size"], rows, what, caption))
    return page.Section(title="What these data cannot see", content=content)


def _fold(
    columns: Sequence[str], rows: Sequence[Sequence[str]], what: str, caption: str = ""
) -> page.Table:
    """A table that a click opens."""
    words = f"{len(rows)} {what}"
    every = range(len(rows))
    return page.Table(columns=columns, rows=rows, caption=caption, folded=every, folded_words=words)


def _next_run(r: Report) -> page.Section:
    title = "Which run to record next"
    if r.next_run is None:
        alone = r.verdict in ("none", "data_sheet", "named", DESCRIBED) and not r.rivals
        text = (
            "Nothing is open. The command “diffsim diagnose next” says which run would narrow "
            "what is known."
            if alone
            else "The command “diffsim diagnose next” looks for runs that part what is left open."
        )
        return page.Section(title=title, text=[text])
    caption = "Distance of the nearest two sets after both are refitted, by run to record."
    chart = draw.next_run_bars(r.next_run.apart, r.next_run.best)
    words = r.next_run.words
    text = f"{words[:1].upper()}{words[1:]}."
    return page.Section(
        title=title, text=[text], content=[page.Chart(figure=chart, caption=caption)]
    )


def _gates(r: Report) -> page.Section:
    rows = [
        [_check_words(g.name), _describe_gate(g), figure(g.value), figure(g.limit), g.note]
        for g in r.gates
    ]
    failed = [i for i, g in enumerate(r.gates) if g.applies and not g.passed]
    table = page.Table(
        columns=["check", "result", "value", "limit", "of what"],
        rows=rows,
        emphasis=failed,
        folded=[i for i in range(len(rows)) if i not in failed],
        folded_words="that passed or do not apply" if failed else "Checks, none of which failed",
    )
    return page.Section(title="Checks before physics is blamed", content=[table] if rows else [])


def _check_words(name: str) -> str:
    """A check in words: "gradient:sliding_friction" is "gradient of sliding friction"."""
    kind, _, of = name.partition(":")
    return f"{words_of(kind)} of {words_of(of)}" if of else words_of(kind)


def _describe_gate(gate: GateResult) -> str:
    if not gate.applies:
        return "does not apply"
    return "passed" if gate.passed else "FAILED"
