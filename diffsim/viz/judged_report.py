"""The page of a judgment: a saved model on runs that nothing was fitted to."""

from __future__ import annotations

from collections.abc import Sequence

from diffsim.core.figures import figure, unit_of, with_sd
from diffsim.data.study import Channel, Study
from diffsim.diagnose.judge.gain import Gain
from diffsim.diagnose.judge.own_values import own_words, words_of
from diffsim.diagnose.judge.records import no_skill_words
from diffsim.diagnose.judge.rivals import cause_words
from diffsim.diagnose.judge.unseen import Unseen
from diffsim.diagnose.say.headline import judged_headline
from diffsim.identify.model_file import SavedModel
from diffsim.viz import diagnosis_charts as draw
from diffsim.viz import diagnosis_tables as tables
from diffsim.viz import report as page
from diffsim.viz.diagnosis_parts import band_numbers, error_numbers, gain_numbers, runs_section
from diffsim.viz.diagnosis_series import PredictedRun, with_noise


def judgment_page(found: Unseen, study: Study, saved: SavedModel) -> page.Report:
    """The page: gain, errors and gain of each run, how far outside, the runs over time."""
    sd = {name: entry["sd"] for name, entry in saved.facts["noise"].items()}
    channels = with_noise(study.channels, sd)
    runs = _collect_predictions(found, study, extended=bool(saved.components))
    gained = gain_numbers(found.gain) if saved.components else []
    sections = [_gains(found, saved), _errors(found)]
    if runs:
        sections += [
            runs_section("Measured and predicted", runs, channels),
            _build_misfit_section(runs, channels),
        ]
    return page.Report(
        title=f"Judgment of {study.name}",
        subtitle=f"Recorded runs against the saved model {saved.path.name}; nothing was fitted to "
        "them but what the study declares unknown per run",
        verdict=[
            judged_headline(
                found.errors, found.gain, extended=bool(saved.components), gains=found.gains
            )
        ],
        numbers=[*error_numbers(found.errors), *gained, *band_numbers(found.errors)],
        sections=[*sections, _sizes(saved)],
        held_fixed=[
            ("saved model", str(saved.path)),
            ("verdict of its diagnosis", saved.verdict or "unknown"),
            ("runs that it was fitted to or chosen by", ", ".join(saved.facts["seen_runs"])),
            ("spikes taken out", str(found.num_spikes)),
            ("jumps of measured commands taken out", str(found.num_misread)),
        ],
    )


def _collect_predictions(found: Unseen, study: Study, *, extended: bool) -> list[PredictedRun]:
    by_name = {run.name: run for run in study.runs}
    use = {name: run.use for name, run in by_name.items()}
    use |= {row.run: row.use for row in found.errors}  # whatever the study says: none was fitted
    return [
        PredictedRun(
            **{**vars(by_name[name]), "use": use[name]},
            null=before,
            extended=after if extended else None,
            band=found.bands.get(name),
        )
        for name, (before, after) in found.predicted.items()
    ]


def _errors(found: Unseen) -> page.Section:
    text = [f"Run {name} could not be simulated: {why}" for name, why in found.failed.items()]
    outside = tables.outside(found.outside, "judge.json")
    text += [found.left_out_words] if found.left_out else []
    text += [*found.differences, *no_skill_words(found.errors), *own_words(found.own)]
    if not outside and found.errors:
        text.append("All runs lie inside of what was fitted.")
    content = [tables.errors(found.errors), *tables.own(found.own), *outside]
    content = content if found.errors else []
    return page.Section(title="Error on these runs", text=text, content=content)


def _gains(found: Unseen, saved: SavedModel) -> page.Section:
    title = "Gain, run by run"
    if not saved.components:
        return page.Section(
            title=title, text=["The saved model names no cause: it is the plain one."]
        )
    rows = [
        [name, *_share_cells(g), g.status]
        for name, g in {**found.gains, **{f"all {n}": g for n, g in found.kinds.items()}}.items()
    ]
    table = page.Table(
        columns=["run", "removed [%]", "90 % interval [%]", "status"],
        rows=rows,
        caption="Share of the error above the noise that the named causes remove. A short run may "
        "have too few blocks of samples to confirm anything alone.",
    )
    text = cause_words(found.causes, {name: words_of(name) for name in found.causes})
    return page.Section(title=title, text=text, content=[table] if rows else [])


def _share_cells(gain: Gain) -> tuple[str, str]:
    """A gain and its interval in percent; dashes where a share says nothing."""
    if not gain.has_share:
        return "–", "–"
    return f"{100 * gain.value:.0f}", f"{100 * gain.low:.0f} to {100 * gain.high:.0f}"


def _build_misfit_section(
    runs: Sequence[PredictedRun], channels: Sequence[Channel]
) -> page.Section:
    caption = (
        "Measured minus predicted over the noise's standard deviation, all these runs and "
        "channels. Grey: 95 % of noise alone."
    )
    chart = page.Chart(figure=draw.residual_views(runs, channels), caption=caption)
    return page.Section(title="Where and when the models are off", content=[chart])


def _sizes(saved: SavedModel) -> page.Section:
    shared = [n for n in saved.parameters if "@" not in n]
    moved = [n for n in shared if n not in saved.plain or saved.plain[n] != saved.values[n]]
    rows = [
        [
            words_of(name),
            with_sd(saved.values[name], saved.sd[name]),
            figure(saved.plain[name], 4) if name in saved.plain else "–",
            unit_of(saved.units.get(name, "-")) or "–",
        ]
        for name in (*saved.components, *moved)
    ]
    table = page.Table(
        columns=["name", "extended model ± 1 sd", "plain model", "unit"],
        rows=rows,
        caption="As they were saved. The plain model has a fit of its own; parameters that are the "
        "same in both are left out.",
        emphasis=list(range(len(saved.components))),
    )
    return page.Section(title="What was judged", content=[table])
