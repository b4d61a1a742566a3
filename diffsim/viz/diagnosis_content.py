"""What is on the page of a diagnosis, filled from what ``diffsim.diagnose`` reports."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim.core.check import require_choice
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
        uri=data_uri(draw.force_map(found.components, groups, found.z[order]), png=True),
        caption=caption,
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
