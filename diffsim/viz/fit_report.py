"""The page of a fit without effects: parameters, their correlations, and the misfit left."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffsim.core.figures import signed, with_sd
from diffsim.diagnose.checks.gates import leaves_more
from diffsim.diagnose.refit import NullFit
from diffsim.viz import diagnosis_charts as draw
from diffsim.viz import report as page
from diffsim.viz.diagnosis_series import predicted_runs, with_noise


def write_fit(null: NullFit, path: str | Path) -> Path:
    """Write the page, one static HTML file."""
    fit, study = null.fit, null.study
    sd = dict(zip([c.name for c in study.channels], null.noise.sd.tolist(), strict=True))
    channels, runs = (
        with_noise(study.channels, sd),
        predicted_runs(study, fit, uses=("fit", "select")),
    )
    per_sample = fit.chi2 / fit.num_samples
    worst = [page.Chart(figure=draw.runs_over_time(runs, channels), caption=_RUNS)]
    left = [page.Chart(figure=draw.residual_views(runs, channels), caption=_LEFT)]
    names = [name for name in fit.problem.names if name not in null.idle]
    own = [fit.problem.names.index(name) for name in names]
    part = fit.correlation[np.ix_(own, own)]
    matrix = draw.confounding_matrix(names, part, bar="posterior correlation")
    return page.write(
        page.Report(
            title=f"Fit of {study.name}",
            subtitle=f"The model “{fit.problem.model.name}”, without any effect",
            verdict=[
                f"What is left is {per_sample:.3g} noise variances per sample; noise alone "
                f"would leave 1. {_EXPLAIN if leaves_more(fit) else ''}".rstrip()
            ],
            numbers=[
                page.Number(label="chi2 per sample", value=f"{per_sample:.3g}", note="1: noise")
            ],
            sections=[
                page.Section(title="Parameters", content=[_parameters(null)]),
                page.Section(title="Measured and predicted", content=worst),
                page.Section(title="Where and when the model is off", content=left),
                page.Section(
                    title="What the data cannot part",
                    content=[page.Chart(figure=matrix, caption=_CORRELATION)],
                ),
            ],
            held_fixed=[
                ("noise floor from", ", ".join(dict.fromkeys(null.noise.source))),
                ("spikes taken out", str(null.num_spikes)),
                ("jumps of measured commands taken out", str(null.num_misread)),
                ("converged", f"{fit.converged}: {fit.message}"),
            ],
        ),
        path,
    )


_EXPLAIN = "The command “diffsim diagnose explain” looks for the cause."
_RUNS = "Dots: measured. Dashed: the fitted model. Runs with use: test are not looked at here."
_LEFT = (
    "Measured minus predicted over the noise's standard deviation, all runs and channels. Grey: "
    "95 % of noise alone."
)
_CORRELATION = "Posterior correlations of the parameters, priors included; beyond ±0.95 boxed."


def _parameters(null: NullFit) -> page.Table:
    fit = null.fit
    rows, idle = [], null.idle
    for p, name in zip(fit.problem.model.base, fit.problem.names, strict=True):
        if name in idle:
            continue
        notes = [
            word
            for word, names in (
                ("prior only", fit.undetermined),
                ("on its bound", fit.at_bound),
            )
            if name in names
        ]
        width = p.sd * p.value if p.log else p.sd
        moved = (fit.values[name] - p.value) / width if width else np.nan
        rows.append(
            [
                name,
                with_sd(fit.values[name], fit.sd[name]),
                "" if p.unit == "-" else p.unit,
                with_sd(p.value, width),
                signed(moved),
                ", ".join(notes),
            ]
        )
    return page.Table(
        columns=["parameter", "value ± sd", "unit", "prior", "moved [prior sd]", "note"],
        rows=rows,
        caption="Standard deviations with the prior. A parameter that moved by more than two "
        "prior standard deviations may stand for something that the model lacks.",
    )
