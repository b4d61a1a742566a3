"""Steps of a diagnosis on their own: the null fit, a saved model refitted, advice from a report."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from diffsim.core.arrays import Array
from diffsim.core.check import as_spelled, require_choice
from diffsim.core.errors import DiffsimError
from diffsim.core.files import to_plain, write_json_atomic
from diffsim.core.threads import one_thread
from diffsim.core.yaml_text import read_text
from diffsim.data.study import Channel, Run, Study
from diffsim.diagnose.checks.noise import NoiseFloor
from diffsim.diagnose.inputs import Inputs
from diffsim.diagnose.judge.band import Band, band_of
from diffsim.diagnose.judge.data_sheet import ranges_of_fit
from diffsim.diagnose.judge.frozen import content_of, noise_of
from diffsim.diagnose.judge.gain import Gain
from diffsim.diagnose.judge.own_values import unmet_by, words_of
from diffsim.diagnose.judge.records import CERTAIN, EFFECT, UNJUDGED
from diffsim.diagnose.judge.unseen import Unseen, on_unseen, spans_of
from diffsim.diagnose.say.law_records import DESCRIBED
from diffsim.diagnose.say.next_run import Narrowing, NextRun, narrowing, next_run
from diffsim.diagnose.say.report import fit_to_dict, save_model
from diffsim.diagnose.say.wording import MOST_LISTED
from diffsim.diagnose.search.fit import Case, Null, null_fit
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import Fit
from diffsim.identify import fit as fit_runs
from diffsim.identify.effect import PRIOR_WIDTH, Effect, coordinate_of, effect_coordinates
from diffsim.identify.effort import FIT_NATS
from diffsim.identify.extended import ExtendedModel, extended_model
from diffsim.identify.fitting import summary
from diffsim.identify.linearization import linearization_at
from diffsim.identify.model_file import SavedModel, effects_of
from diffsim.identify.numerics import Numerics
from diffsim.identify.ranges import Range

EXTEND_FILE = "extend.json"  # beside the model that it writes
CLOSED_VERDICTS = ("none", "data_sheet", "named", DESCRIBED)  # verdicts that may leave nothing open


@dataclass(frozen=True, eq=False)
class NullFit:
    """Fit of the plain model, without effects."""

    study: Study  # study without the samples that are spikes
    noise: NoiseFloor  # noise floor of the study
    fit: Fit  # fit of the base parameters to the runs for fitting
    num_spikes: int  # number of samples that were removed as spikes
    num_misread: int = 0  # number of jumps of measured commands that were taken out

    @property
    def idle(self) -> tuple[str, ...]:
        """Names of parameters that move nothing of the plain model, such as those of causes."""
        moves = self.fit.jacobian.any(0).tolist()
        named = zip(self.fit.problem.names, moves, strict=True)
        return tuple(name for name, is_moving in named if not is_moving)

    def strongest_correlations(self) -> Iterator[tuple[str, str, float]]:
        """Pairs of parameters above 0.8, strongest first."""
        names, r = self.fit.problem.names, self.fit.correlation
        rows, cols = np.triu_indices(len(names), 1)
        for k in np.argsort(-np.abs(r[rows, cols])):
            value = float(r[rows[k], cols[k]])
            if abs(value) <= 0.8:
                return
            yield names[rows[k]], names[cols[k]], value

    def to_dict(self) -> dict[str, Any]:
        """Content of the fit in types that JSON has."""
        channels = [c.name for c in self.study.channels]
        return to_plain(
            {
                "study": self.study.name,
                "model": self.fit.problem.model.name,
                **fit_to_dict(self.fit),
                "noise": {
                    "sd": dict(zip(channels, self.noise.sd.tolist(), strict=True)),
                    "source": self.noise.source,
                    "num_spikes": self.num_spikes,
                    "num_misread": self.num_misread,
                },
            }
        )


@one_thread
def fit_null(inputs: Inputs, numerics: Numerics | None = None) -> NullFit:
    """Noise floor and fit of the plain model.

    Args:
        numerics: Refined numerical settings; None: the model's own.
    """
    return _plain(null_fit(_case(inputs, numerics)))


def _plain(null: Null) -> NullFit:
    return NullFit(null.case.study, null.noise, null.fit, null.num_spikes, null.num_misread)


@dataclass(frozen=True, eq=False)
class Extension:
    """A saved extended model, refitted."""

    study: Study  # study that the model was fitted to
    # null, fit: fits without and with the effects, to the same runs with the same noise
    null: Fit
    fit: Fit
    unseen: Unseen | None  # errors and gain on test runs; None without any
    verdict: str  # verdict of the diagnosis that made the model
    # 90 % intervals by name, no narrower than the model's own where the same runs were fitted: what
    # the choice among causes leaves open is in them
    ranges: Mapping[str, Range]
    band: Band | None = None  # what bands of unseen runs are made from; None: nothing tells of them
    # values that the fit began at, by name
    start: Mapping[str, float] = field(default_factory=dict)

    @property
    def gain(self) -> Gain | None:
        """Gain on test runs, as ``explain`` states it; None without, or where one has failed."""
        return None if self.unseen is None else self.unseen.gain

    def model(self) -> ExtendedModel:
        """The extended model at the refitted values."""
        return extended_model(self.fit)

    def save(self, folder: Path) -> Path:
        """Write extended_model.yaml and extend.json; the path of the first."""
        content = {
            "gain": self.gain,
            "chi2_null": self.null.chi2,
            "chi2_extended": self.fit.chi2,
            "null": fit_to_dict(self.null),
            "extended": fit_to_dict(self.fit),
            "start": self.start,
        }
        write_json_atomic(folder / EXTEND_FILE, content)
        return save_model(
            self.fit,
            self.null,
            folder,
            study=self.study,
            verdict=self.verdict,
            band=self.band,
            ranges=self.ranges,
        )


@one_thread
def extend(inputs: Inputs, saved: SavedModel) -> Extension:
    """Refit a saved model's parameters and sizes jointly on the runs for fitting.

    It begins where the diagnosis ended, under the noise and the numerical settings of that, and
    does not end above it. The priors are those of the setup, not the saved posterior: the same runs
    must not count twice.

    Args:
        inputs: Study and setup.
        saved: Content of the model's file.

    Raises:
        ValueError: the setup does not have an effect of the saved model.
    """
    effects = effects_of(saved, inputs.setup.effects)
    null = _null_beside(inputs, saved)
    start = _start_of(saved)
    refitted = _not_above(refit(null, effects, inputs, start), _begin(null, effects, start))
    study, sd, runs = null.study, null.noise.sd, inputs.study.test_runs
    unseen = None
    if runs and effects:
        spans = spans_of(study.fit_runs, study.channels, study.commands)
        which = (null.fit, refitted, runs, study.channels, sd, spans)
        unmet = unmet_by(refitted.problem)
        unseen = on_unseen(*which, seed=inputs.seed, commands=study.commands, unmet=unmet)
    return Extension(
        study,
        null.fit,
        refitted,
        unseen,
        saved.verdict,
        _no_narrower(ranges_of_fit(refitted, study.fit_runs), saved, study.fit_runs),
        band_of(refitted, study.channels, sd, study.select_runs, plain=null.fit),
        start,
    )


def _null_beside(inputs: Inputs, saved: SavedModel) -> NullFit:
    """The plain model under the noise of a saved file, no worse than in the file."""
    null = null_fit(_case(inputs, saved.numerics))
    known = saved.facts.get("noise", {})
    if all(channel.name in known for channel in null.case.study.channels):
        whitener = noise_of(saved, null.case.study)
        if not whitener.is_like(null.noise.whitener):
            null = null.under(replace(null.noise, whitener=whitener, sd=whitener.sd))
    if saved.plain:
        problem = null.fit.problem
        x = np.clip(_begin(_plain(null), (), saved.plain), *problem.bounds)
        fit, at = gauss_newton(problem, linearization_at(problem, x))
        if fit.chi2 + fit.prior < null.fit.chi2 + null.fit.prior - 2.0 * FIT_NATS:
            null = replace(null, fit=fit, at=at)
    return _plain(null)


def _not_above(fit: Fit, start: Array) -> Fit:
    """A fit, or its start where that has the lower misfit: along a valley priors may pull it on."""
    x = np.clip(start, *fit.problem.bounds)
    residual, slopes = fit.problem.linearize(x)
    if float(residual @ residual) >= fit.chi2:
        return fit
    message = "no lower misfit than at the start"
    return summary(fit.problem, x, residual, slopes, "converged", message, fit.num_evaluations)


def _no_narrower(
    found: Mapping[str, Range], saved: SavedModel, runs: Sequence[Run]
) -> dict[str, Range]:
    """Intervals of a fit; of the runs that a file was fitted to they hold those of the file."""
    seen = saved.facts.get("seen_runs", {}).values()
    fitted = {entry["content"] for entry in seen if entry["use"] == "fit"}
    if fitted != {content_of(run) for run in runs}:
        return dict(found)
    known = {name: saved.ranges.get(name, own) for name, own in found.items()}
    return {
        name: Range(own.value, min(own.low, known[name].low), max(own.high, known[name].high))
        for name, own in found.items()
    }


def _start_of(saved: SavedModel) -> Mapping[str, float]:
    """Where a refit begins: at the values, or, of a model that ``extend`` wrote, where that began.

    A fit that begins at its own end moves in the last digits; so twice is the same as once.
    """
    path = saved.path.parent / EXTEND_FILE
    if path.is_file():
        content = json.loads(read_text(path))
        if content["extended"]["values"] == dict(saved.values) and content.get("start"):
            return {str(name): float(value) for name, value in content["start"].items()}
    return saved.values


def rival_sets(report: Mapping[str, Any]) -> tuple[list[tuple[str, ...]], str]:
    """Sets of effects between which a report leaves the choice, and that in words.

    An unknown cause predicts no new run: where it is the only rival, the plain model stands for it,
    for a run on which the names make the largest difference is the one to tell.

    Args:
        report: Content of ``report.json``.
    """
    effects = {row["effect"] for row in report["table"]}
    named, verdict = tuple(report["named"]), report["verdict"]
    # of a verdict that names what all rivals share, the rivals are all the sets
    given = [tuple(r) for r in report["rivals"]]
    sets = list(dict.fromkeys(given if verdict == "named" and given else [named, *given]))
    known = [r for r in sets if set(r) <= effects]
    unknown = len(sets) - len(known)
    if verdict == "data_sheet":
        off = ", ".join(report.get("findings", ()))
        return [], f"verdict data_sheet: no cause is open; measure {off} to confirm the number"
    if verdict == "none":
        return [], "verdict none: nothing is open; the misfit is noise"
    if not named:
        return [], f"verdict {verdict}: no set of effects stands, none can be settled"
    if len(sets) > 1:
        note = ""
        if unknown:
            note = f", or one of {unknown} with an unknown cause, which predicts no new run"
        if len(known) < 2:
            note += "; the plain model stands for it"
            known = [*known, ()]
        surely = f"{_words(named)} {_is_or_are(named)} certain; " if verdict == "named" else ""
        return known, f"{surely}open: " + ", or ".join(_words(s) for s in known if s) + note
    if verdict in ("named", DESCRIBED) and not _unsure_of(report):
        return [named], f"nothing is open: {_words(named)} {_is_or_are(named)} certain"
    for row in report["hypotheses"]:
        rival = tuple(row["effects"])
        if row["unknown"] is None and not set(rival) >= set(named):
            why = f"{_words(named)} stands alone; against the nearest other set, {_words(rival)}"
            return [named, rival], why
    return [named], f"{_words(named)} stands alone, and nothing else was refitted"


def _unsure_of(report: Mapping[str, Any]) -> list[str]:
    """Named effects that are not certain."""
    return [
        row["name"]
        for row in report.get("causes", ())
        if row["origin"] == EFFECT and row["name"] in report["named"] and row["status"] != CERTAIN
    ]


@one_thread
def advise_narrowing(
    inputs: Inputs, report: Mapping[str, Any], numerics: Numerics | None = None
) -> Narrowing | None:
    """Refit the answer of a report that leaves nothing open; what a run would narrow.

    Sizes of the named effects; without one, the data sheets that are off; without these, what is
    known of the parameters that all runs share.

    Args:
        report: Content of ``report.json``.
        numerics: Refined numerical settings of the report; None: the model's own.

    Returns:
        None where there is no bank of runs, nothing to narrow, or something is open.
    """
    setup, named = inputs.setup, report["named"]
    if report["verdict"] not in CLOSED_VERDICTS or not setup.bank:
        return None
    effects = _effects_by_name(named, setup.effects)
    null = fit_null(inputs, numerics)
    shared = [p.name for p in null.fit.problem.model.base if "@" not in p.name]
    off = [name for name in report.get("findings", ()) if name in shared]
    names = effect_coordinates(effects) or off or shared
    if not names:
        return None
    fit = refit(null, effects, inputs, {})
    return narrowing(fit, _within_travel([fit], setup.bank, null.study.channels), names)


def _effects_by_name(names: Iterable[str], effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Causes of a setup by their names, in any case of letters."""
    known = {e.name: e for e in effects}
    return tuple(known[require_choice("effect", as_spelled(n, known), known)] for n in names)


@one_thread
def advise(
    inputs: Inputs, sets: Sequence[Sequence[str]], numerics: Numerics | None = None
) -> NextRun:
    """Refit each set and take the run of the setup's bank on which they differ most.

    Args:
        sets: Names of the effects of every set.
        numerics: Refined numerical settings of the report; None: the model's own.

    Raises:
        ValueError: the setup has no bank, or not these effects.
    """
    setup = inputs.setup
    if not setup.bank:
        raise ValueError(
            f"the setup of study {inputs.study.name} has no bank of runs that could be recorded"
        )
    chosen = [_effects_by_name(names, setup.effects) for names in sets]
    null = fit_null(inputs, numerics)
    fits = [refit(null, effects, inputs, {}) for effects in chosen]
    return next_run(fits, _within_travel(fits, setup.bank, null.study.channels))


def _within_travel(
    fits: Sequence[Fit], bank: Sequence[Run], channels: Sequence[Channel]
) -> list[Run]:
    """Runs that no fit takes beyond the stated travel of a channel; those that cannot be simulated
    stay, and are told as such.

    Raises:
        ValueError: every run goes beyond it.
    """
    low = np.array([-np.inf if c.lower is None else c.lower for c in channels])
    high = np.array([np.inf if c.upper is None else c.upper for c in channels])
    if not np.isfinite([low, high]).any():
        return list(bank)
    kept = []
    for run in bank:
        try:
            with torch.no_grad():
                said = [fit.problem.predict(run, torch.from_numpy(fit.x)).numpy() for fit in fits]
        except DiffsimError:
            kept.append(run)
            continue
        if all(bool(((values >= low) & (values <= high)).all()) for values in said):
            kept.append(run)
    if not kept:
        raise ValueError(
            f"all {len(bank)} runs that could be recorded leave the travel (lower, upper) of a "
            "channel; state smaller limits of the commands"
        )
    return kept


def wanted_columns(report: Mapping[str, Any]) -> list[str]:
    """What else to record, for causes that could not be judged without it, a sentence each.

    Args:
        report: Content of ``report.json``.
    """
    if report["verdict"] in ("none", "data_sheet"):
        return []
    needs: dict[str, list[str]] = {}
    for row in report.get("causes", ()):
        if row["status"] == UNJUDGED and (note := row["note"]):
            why = note.removeprefix("not judged: ")
            is_need = row.get("probability") is None and why == note  # what its row asks of a study
            needs.setdefault(f"record {why}" if is_need else why, []).append(row["words"])
    return [
        f"{', '.join(words[:MOST_LISTED])} could not be judged: {why}"
        for why, words in needs.items()
    ]


def refit(
    null: NullFit, effects: Sequence[Effect], inputs: Inputs, values: Mapping[str, float]
) -> Fit:
    """Base parameters from the null fit or ``values``, sizes from ``values`` or 0."""
    if not effects:
        return null.fit
    problem = null.fit.problem
    return fit_runs(
        problem.model,
        problem.runs,
        null.study.channels,
        effects=effects,
        start=_begin(null, effects, values),
        whitener=problem.whitener,
        jacobian=problem.jacobian,
        numerics=problem.numerics,
        workers=inputs.setup.settings.workers,
    )


def _begin(null: NullFit, effects: Sequence[Effect], values: Mapping[str, float]) -> Array:
    """Standardized coordinates of values; what is not among them is that of the null fit, or 0."""
    start = [
        p.coordinate_of(values[p.name]) if p.name in values else x
        for p, x in zip(null.fit.problem.model.base, null.fit.x, strict=True)
    ]
    for effect in effects:
        scale = PRIOR_WIDTH * effect.typical
        sizes = np.array([values.get(name, 0.0) for name in effect_coordinates([effect])])
        start += coordinate_of(sizes / scale).tolist()
    return np.array(start)


def _case(inputs: Inputs, numerics: Numerics | None) -> Case:
    setup = inputs.setup
    study = inputs.study.without_tests()
    settings = (setup.effects, setup.unknowns, setup.settings)
    return Case(study, setup.model, *settings, numerics=numerics)


def _is_or_are(names: Sequence[str]) -> str:
    return "is" if len(names) == 1 else "are"


def _words(names: Sequence[str]) -> str:
    return " with ".join(map(words_of, names)) if names else "no effect"
