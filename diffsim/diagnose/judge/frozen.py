"""A saved model on new runs: nothing is fitted to them but what is unknown of each run."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.check import require_choice
from diffsim.core.threads import one_thread
from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose.checks.gates import BLOCK_OF, require_separate, shared_with, stretches_of
from diffsim.diagnose.checks.noise import ArWhitener
from diffsim.diagnose.inputs import Inputs
from diffsim.diagnose.judge.band import Band, band_from
from diffsim.diagnose.judge.described import description_of, differences, require_same_system
from diffsim.diagnose.judge.rivals import beside_no_skill, without_each
from diffsim.diagnose.judge.unseen import At, Span, Unseen, constants_of, on_unseen, spans_of
from diffsim.identify import Problem
from diffsim.identify.extended import ExtendedModel
from diffsim.identify.model_file import (
    SavedModel,
    effects_of,
    rebuilt,
    without_effects,
    without_values_of,
)


def facts_of(study: Study, noise: ArWhitener, band: Band | None) -> dict[str, Any]:
    """What judging new runs needs beside the model: noise floor, seen runs, and their range.

    Args:
        study: Study that was fitted; test runs are left out.
        noise: Noise under which it was fitted.
        band: What bands of unseen runs are made from; None: nothing tells of them.
    """
    seen = (*study.fit_runs, *study.select_runs)
    return {
        "noise": {
            channel.name: {"sd": float(sd), "coefficients": a.tolist()}
            for channel, sd, a in zip(study.channels, noise.sd, noise.coefficients, strict=True)
        },
        "seen_runs": {run.name: _describe_run(run) for run in seen},
        "range": {
            what: {**asdict(span), "labels": list(span.labels)}
            for what, span in spans_of(study.fit_runs, study.channels, study.commands).items()
        },
        **description_of(study),
        "constants": constants_of(study.fit_runs, study.channels),
        **({} if band is None else {"band": band.to_dict()}),
    }


def _describe_run(run: Run) -> dict[str, Any]:
    """What tells later that a run, or a part of it, was seen."""
    known = {"use": run.use, "content": content_of(run), "stretches": " ".join(stretches_of(run))}
    return known | ({BLOCK_OF: run.setup[BLOCK_OF]} if BLOCK_OF in run.setup else {})


def content_of(run: Run) -> str:
    """Hash of what was measured, whatever the run is called."""
    measured = np.where(np.isfinite(run.measured), run.measured + 0.0, np.nan)
    return hashlib.sha256(np.ascontiguousarray(measured).tobytes()).hexdigest()[:16]


@one_thread
def judge_saved(inputs: Inputs, saved: SavedModel, names: Sequence[str] = ()) -> Unseen:
    """Judge a saved model on runs of a study, which may be another one than it was fitted to.

    Args:
        inputs: Study and setup of the same system.
        names: Runs to judge; empty: all with use: test.

    Raises:
        ValueError: no such runs, runs that were fitted, another system's file, or one of before.
    """
    study, facts = inputs.study, saved.facts
    require_same_system(saved, inputs.setup, study)
    said = differences(saved, study)
    runs = _choose_unseen(study, saved, names)
    saved = without_values_of(saved, [run.name for run in runs])
    bare = without_each(saved, effects_of(saved, inputs.setup.effects))
    models = [rebuilt(s, inputs.setup) for s in (without_effects(saved), saved, *bare.values())]
    noise = noise_of(saved, study)
    spans = {
        what: Span(**{**s, "labels": tuple(s["labels"])}) for what, s in facts["range"].items()
    }
    plain, extended, *others = (_at(model, noise, inputs) for model in models)
    facts_named = [p.name for p in inputs.setup.model.base if "[" in p.name]
    unmet = [name for name in facts_named if name not in saved.parameters]
    half_widths = partial(
        _half_widths, extended, facts.get("band"), channels=study.channels, unmet=unmet
    )
    compare = partial(
        on_unseen,
        extended=extended,
        runs=runs,
        channels=study.channels,
        sd=noise.sd,
        spans=spans,
        seed=inputs.seed,
        commands=study.commands,
        unmet=unmet,
        constants=facts.get("constants", {}),
    )
    found = compare(plain, half_widths=half_widths)
    causes = {name: compare(other) for name, other in zip(bare, others, strict=True)}
    errors = beside_no_skill(found, study)
    left_out = tuple(run.name for run in runs if run.use == "fit")
    return replace(found, errors=errors, differences=said, causes=causes, left_out=left_out)


def _half_widths(
    extended: At,
    band: Mapping[str, Any] | None,
    run: Run,
    times: float,
    *,
    channels: Sequence[Channel],
    unmet: Sequence[str],
) -> Array | None:
    """Half of the width of the band of a run, in a saved model; None in files of before."""
    if band is None:
        return None
    # priors of the rebuilt model are posteriors of the fit
    sd = np.ones(len(extended.x))
    return band_from(band).half_widths(extended, sd, run, times, channels=channels, unmet=unmet)


def _choose_unseen(study: Study, saved: SavedModel, names: Sequence[str]) -> tuple[Run, ...]:
    """Runs to judge, none of which the model has seen."""
    by_name = {run.name: run for run in study.runs}
    for name in names:
        require_choice("--runs", name, by_name)
    runs = tuple(by_name[n] for n in dict.fromkeys(names)) or study.test_runs
    if not runs:
        raise ValueError(
            f"study {study.name} has no run with use: test; name runs to judge with --runs"
        )
    seen = saved.facts.get("seen_runs", {})
    contents = {entry["content"]: name for name, entry in seen.items()}
    for run in runs:
        if (known := contents.get(content_of(run))) is not None:
            use = seen[known]["use"]
            raise ValueError(
                f"run {run.name} was used to {use} the model (as {known}): its error proves nothing"
            )
        _require_new(run, seen)
    # a few samples alike: only if the study still holds the runs that were seen
    chosen = {run.name for run in runs}
    others = [r for r in study.runs if r.name not in chosen and r.name in seen]
    asked = [replace(r, use="test") for r in runs]
    require_separate(replace(study, runs=(*others, *asked)))
    return runs


def _require_new(run: Run, seen: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse a run that is in part one which the model has seen, unless both are declared blocks.

    Raises:
        ValueError: it is; the message names the run that was seen.
    """
    block = run.setup.get(BLOCK_OF)
    known = {
        key: name
        for name, entry in seen.items()
        if block is None or entry.get(BLOCK_OF) != block
        for key in entry.get("stretches", "").split()
    }
    if (shared := shared_with(run, known)) is not None:
        name, count = shared
        raise ValueError(
            f"run {run.name} holds at least {count} samples of run {name}, which was used to "
            f"{seen[name]['use']} the model: its error there proves nothing. Cut them off (from_s, "
            f"until_s), or declare blocks of one run with setup: {{{BLOCK_OF}: NAME}}"
        )


def noise_of(saved: SavedModel, study: Study) -> ArWhitener:
    """The noise floor under which a saved model was fitted.

    Args:
        study: Study whose channels are asked for.

    Raises:
        ValueError: the file knows no noise of a channel of the study.
    """
    known: Mapping[str, Any] = saved.facts.get("noise", {})
    for channel in study.channels:
        require_choice(f"{saved.path}: channel with a noise floor", channel.name, known)
    own = [known[channel.name] for channel in study.channels]
    coefficients = [np.array(entry["coefficients"], dtype=np.float64) for entry in own]
    return ArWhitener(np.array([entry["sd"] for entry in own]), coefficients)


def _at(model: ExtendedModel, noise: ArWhitener, inputs: Inputs) -> At:
    """The model at the saved values, which are the middle of its priors."""
    settings = inputs.setup.settings
    problem = Problem(model, (), noise, (), settings.jacobian)
    return At(problem, model.at_prior().numpy())
