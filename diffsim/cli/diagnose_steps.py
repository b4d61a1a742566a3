"""The steps of ``diffsim diagnose STEP STUDY``; those about a task are in ``diagnose_task``."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from diffsim.cli.arguments import DIAGNOSES
from diffsim.cli.diagnose_check import certain_faults, check, done_by_setup, require_ready
from diffsim.cli.diagnose_export import EXPORT_FILE, constants_of, notes_of, say_interval
from diffsim.cli.diagnose_faults import judged, new_labels, with_new
from diffsim.cli.diagnose_files import (
    INPUTS_FILE,
    PAGE_FILE,
    RECORDING_FILE,
    REPORT_FILE,
    against_before,
    is_drawn,
    lacking,
    write_judged,
)
from diffsim.cli.diagnose_init import init
from diffsim.cli.diagnose_inputs import changed, inputs_of, read_study
from diffsim.cli.diagnose_progress import progress_bar
from diffsim.cli.diagnose_schema import write_schema
from diffsim.cli.diagnose_task import command, worth
from diffsim.cli.export_targets import export_to, only_target
from diffsim.core.figures import figure, limits, percent
from diffsim.core.files import write_json_atomic, write_text_atomic
from diffsim.core.optional import advice, present
from diffsim.core.threads import one_thread
from diffsim.data.bank import command_table
from diffsim.data.guess import listed
from diffsim.data.study import Study
from diffsim.data.study_check import Problem
from diffsim.diagnose.checks.whole_record import model_problems
from diffsim.diagnose.diagnosis import diagnosed
from diffsim.diagnose.inputs import Inputs
from diffsim.diagnose.judge.apart import apart_words
from diffsim.diagnose.judge.described import require_same_kind
from diffsim.diagnose.judge.frozen import judge_saved
from diffsim.diagnose.judge.own_values import OwnRow, own_words, words_of
from diffsim.diagnose.judge.records import OutsideRow, band_words, in_small_units, no_skill_words
from diffsim.diagnose.judge.rivals import cause_words
from diffsim.diagnose.refit import (
    advise,
    advise_narrowing,
    extend,
    fit_null,
    rival_sets,
    wanted_columns,
)
from diffsim.diagnose.say.headline import judged_headline
from diffsim.diagnose.say.law_records import DESCRIBED
from diffsim.diagnose.say.next_run import Narrowing, NextRun
from diffsim.diagnose.say.report import Report
from diffsim.diagnose.say.tables import FIRST_LOOK
from diffsim.identify.effort import FIRST_STEPS
from diffsim.identify.model_file import MODEL_FILE, SavedModel, read_extended
from diffsim.identify.numerics import Numerics

CACHE, JUDGE_FILE, JUDGE_PAGE, NEXT_FILE = "interrupted", "judge.json", "judge.html", "next.json"
FAULTS_PAGE = "faults.html"
RECORD = "record"  # verdict where the record itself is at fault
MAX_OUTSIDE = 3  # lines per run; the file holds all
JUDGED_ERRORS = ("before", "after", "noise", "constant", "held", "command", "without")
MAX_FITTED = 4  # values in a run's line; the file holds all


@one_thread  # pages simulate, too
def run_step(args: argparse.Namespace) -> None:
    """Run the step that the arguments name."""
    STEPS[args.step](args)


def _init(args: argparse.Namespace) -> None:
    """Write a first study of a folder."""
    init(args.folder, args.out, system=args.system, parts=args.parts, force=args.force)


def _schema(args: argparse.Namespace) -> None:
    """Write the schema of study.yaml."""
    write_schema(args.out)


def _check(args: argparse.Namespace) -> None:
    """Show the study and what is wrong with it."""
    check(read_study(args.study), args.study, accept_record=args.accept_record)


def _inputs(
    args: argparse.Namespace, study: Study | None = None, *, with_bank: bool = False
) -> tuple[Inputs, Path]:
    """Study (read unless it is given) and setup as chosen; the folder of the results."""
    study = study or read_study(args.study)
    require_ready(study, args.study, plan=args.step != "judge", accept_record=args.accept_record)
    inputs = inputs_of(
        study,
        seed=args.seed,
        setup_file=args.setup,
        only=getattr(args, "effects", ()),
        without=getattr(args, "without", ()),
        budget=args.budget,
        workers=args.workers,
        accept_numerics=args.accept_numerics,
        with_bank=with_bank,
    )
    for line in done_by_setup(study, inputs.study):
        print(line)
    return inputs, args.out or Path(DIAGNOSES) / study.name


def _fit(args: argparse.Namespace) -> None:
    inputs, out = _inputs(args)
    null = fit_null(inputs)
    fit = null.fit
    print(f"{'parameter':<32} {'value':>12} {'sd':>10}")
    units = {p.name: p.unit for p in fit.problem.model.base}
    idle = null.idle
    for name, value in ((n, v) for n, v in fit.values.items() if n not in idle):
        unit = "" if units[name] == "-" else units[name]
        print(f"{name:<32} {value:>12.6g} {fit.sd[name]:>10.2g} {unit}")
    for a, b, r in null.strongest_correlations():
        print(f"correlated: {a} and {b} ({r:+.2f})")
    notes = (("not determined by the data", fit.undetermined), ("on its bound", fit.at_bound))
    for what, names in notes:
        for line in listed(what, (n for n in names if n not in idle)):
            print(line)
    if idle:
        words = dict.fromkeys(words_of(name.partition("@")[0]) for name in idle)
        print(f"the plain model does not depend on: {', '.join(words)}")
    source = ", ".join(dict.fromkeys(null.noise.source))
    print(
        f"chi2 {fit.chi2:.6g} of {fit.num_samples} samples: {fit.chi2 / fit.num_samples:.3g} per "
        f"sample, 1 would be noise alone (noise from {source})"
    )
    if not fit.converged:
        print(f"the fit did not converge: {fit.message}")
    write_json_atomic(out / "fit.json", null.to_dict())
    print(f"wrote {out / 'fit.json'}")

    def page() -> Path:
        from diffsim.viz.fit_report import write_fit  # viz by entry points only

        return write_fit(null, out / "fit.html")

    is_drawn(page)


def _explain(args: argparse.Namespace) -> None:
    study = read_study(args.study)
    if not args.accept_record and (faults := certain_faults(study)):
        _blame_record(study, faults, args.out or Path(DIAGNOSES) / study.name)
        return
    if study.faults is not None:
        print(f"{study.name} has `faults`: every group is judged for itself, by the others")
        require_ready(study, args.study, plan=False, accept_record=args.accept_record)
        out = args.out or Path(DIAGNOSES) / study.name
        _judge_groups(study, out, everything=True, seed=args.seed)
        return
    for line in _pictures_left_out():
        print(line)
    inputs, out = _inputs(args, study)
    if not args.accept_record and (faults := model_problems(inputs.study, inputs.setup)):
        _blame_record(study, faults, out)
        return
    before = _read_json(out / INPUTS_FILE)  # written last: it says that all files are there
    if before is not None and (out / REPORT_FILE).is_file() and not args.force:
        differs, lacks = changed(before, inputs.fingerprint), lacking(out, before)
        if not differs and not lacks:
            _say_again(out)
            return
        if differs:
            what = f"holds a diagnosis of other inputs ({', '.join(differs)})"
        else:
            what = f"lacks {', '.join(lacks)}"
        print(f"{out} {what}: diagnosing again")
    stood = _read_json(out / REPORT_FILE) if before is not None else None
    cache = out / CACHE / inputs.key  # an interrupted diagnosis goes on from what is there
    if args.force:
        shutil.rmtree(out / CACHE, ignore_errors=True)
    elif cache.is_dir():
        print(f"going on with what an interrupted diagnosis left in {cache}")
    steps = inputs.setup.settings.search.refit_steps
    if steps > FIRST_STEPS and not args.quiet:
        print(
            f"a full answer: at most {steps / 1e6:.0f} million simulated steps, by their weight; "
            f"a first one (--quick) takes {FIRST_STEPS / 1e6:.0f} million, about a minute",
            file=sys.stderr,
        )
    with progress_bar("diagnose") as progress:

        def told(stage: str, fraction: float, message: str) -> None:
            progress(stage, fraction, message)
            if stage == FIRST_LOOK and not (out / INPUTS_FILE).is_file():
                look = {"study": study.name, "verdict": FIRST_LOOK, "headline": message}
                write_json_atomic(out / REPORT_FILE, look)  # until the answer takes its place

        report = diagnosed(inputs, progress=told, cache=cache)
    is_drawn_all = _write(report, inputs, out)
    if stood is not None and (added := against_before(stood, report.to_dict())):
        print(added)
    if is_drawn_all:  # else a page, once it can be drawn, costs no diagnosis
        shutil.rmtree(out / CACHE, ignore_errors=True)


def _blame_record(study: Study, faults: Sequence[Problem], out: Path) -> None:
    """The answer where the record is at fault: no physics is asked, and no cause is named."""
    for name in (INPUTS_FILE, PAGE_FILE, RECORDING_FILE, MODEL_FILE):
        (out / name).unlink(missing_ok=True)  # of an answer before: not to pass for this one
    first = faults[0]
    headline = f"The record is at fault, {first.where}: {first.message}."
    sentences = [str(fault) for fault in faults[1:]]
    sentences.append("No physics was asked; --accept-record goes on with the record as it is.")
    content = {
        "study": study.name,
        "verdict": RECORD,
        "headline": headline,
        "sentences": sentences,
        "faults": faults,
    }
    path = write_json_atomic(out / REPORT_FILE, content)
    print(headline)
    print(f"verdict: {RECORD}")
    for sentence in sentences:
        print(sentence)
    print(f"wrote {path}")


def _pictures_left_out() -> list[str]:
    """What will not be drawn for want of packages, said before anything is computed."""
    needed = {PAGE_FILE: ("matplotlib", "plotly", "jinja2"), RECORDING_FILE: ("rerun",)}
    lines = []
    for name, modules in needed.items():
        if missing := [module for module in modules if not present(module)]:
            lines.append(
                f"{name} will not be drawn, the answer is saved without it; for it: "
                f"{advice(missing)}, then the same command again"
            )
    return lines


def _tell(headline: str, verdict: str, sentences: Sequence[str]) -> None:
    print(headline)
    print(f"verdict: {verdict}")
    for sentence in sentences[:2]:
        print(sentence)


def _write(report: Report, inputs: Inputs, out: Path) -> bool:
    """Answer first, then pictures: what cannot be drawn must not lose the answer.

    The file of the inputs comes last: until it is there, the same command goes on from the cache.

    Returns:
        Whether all pictures were drawn.
    """
    (out / INPUTS_FILE).unlink(missing_ok=True)
    report.save(out)
    _tell(report.headline, report.verdict, report.sentences)
    for sentence in apart_words(report.apart, report.shared):
        print(sentence)
    print(f"wrote {out / REPORT_FILE} and {out / MODEL_FILE}", flush=True)

    def page() -> Path:
        from diffsim.viz.diagnosis_report import write_diagnosis

        return write_diagnosis(report, out / PAGE_FILE)

    def recording() -> Path:
        from diffsim.viz.diagnosis_recording import write_recording_of

        return write_recording_of(report, out / RECORDING_FILE)

    pictures = {PAGE_FILE: page, RECORDING_FILE: recording}
    for name in pictures:
        (out / name).unlink(missing_ok=True)  # of other inputs: not to pass for this answer's
    not_drawn = [name for name, write in pictures.items() if not is_drawn(write)]
    write_json_atomic(out / INPUTS_FILE, {**inputs.fingerprint, "not_drawn": not_drawn})
    return not not_drawn


def _say_again(out: Path) -> None:
    saved = _read_json(out / REPORT_FILE) or {}
    print(f"{out} holds the answer to exactly this already; --force diagnoses again")
    _tell(saved.get("headline", ""), saved["verdict"], saved["sentences"])


def _extend(args: argparse.Namespace) -> None:
    study = read_study(args.study)
    out = args.out or Path(DIAGNOSES) / study.name
    saved = read_extended(args.saved or out)
    inputs, _ = _inputs(args, saved.framed(study))  # sizes mean what they meant
    extension = extend(inputs, saved)
    path = extension.save(out)
    sizes = [n for n in extension.fit.problem.names if n not in extension.null.problem.names]
    if not sizes:
        print(f"{saved.path} names no effect: the extended model is the plain model")
    units = {c.name: c.unit for c in extension.model().base}
    for name in sizes:
        unit = "" if units[name] == "-" else f" {units[name]}"
        value, low, high = extension.ranges[name]
        was = f"was {saved.values[name]:.6g}" if name in saved.values else "of a new run"
        within = limits(value, low, high, 4)
        print(f"{name:<32} {value:>12.6g}{unit} ({within}; 90 % interval; {was})")
    before, after = extension.null.chi2, extension.fit.chi2
    print(f"chi2 of the runs fitted: {before:.6g} before, {after:.6g} extended")
    if extension.gain is not None:
        print(extension.gain.words)
    elif extension.unseen is None:
        print("no test run, so no gain is known: a smaller training error proves nothing")
    else:
        for name, why in extension.unseen.failed.items():
            print(f"run {name} could not be simulated, so no gain is quoted: {why}")
    print(f"wrote {path}")


def _judge(args: argparse.Namespace) -> None:
    """Errors of a saved model on runs that it has not seen."""
    study = read_study(args.study)
    out = args.out or Path(DIAGNOSES) / study.name
    saved = _read_judged(args, study, out)
    require_same_kind(saved, study)
    inputs, _ = _inputs(args, saved.framed(study))
    found = judge_saved(inputs, saved, args.runs)
    for line in filter(None, (*found.differences, found.left_out_words)):
        print(line)
    heads = (f"{h:>9}" for h in JUDGED_ERRORS)
    print(f"{'run':<24} {'quantity':<14} {' '.join(heads)}  {'unit':<8} fitted to it")
    for row in in_small_units(found.errors):
        values = (getattr(row, which) for which in JUDGED_ERRORS)
        numbers = " ".join(f"{'-' if v is None else f'{v:.3g}':>9}" for v in values)
        fitted = f"{row.num_fitted} value{'' if row.num_fitted == 1 else 's'}"
        print(f"{row.run:<24} {row.kind:<14} {numbers}  {row.unit:<8} {fitted}")
    for line in _say_fitted(found.own):
        print(line)
    for name, why in found.failed.items():
        print(f"run {name} could not be simulated, so no gain is quoted: {why}")
    if saved.components and found.gain is not None:
        single = {} if len(found.gains) < 2 else {f"Run {n}": g for n, g in found.gains.items()}
        for what, gain in {**single, **{f"Runs {n}": g for n, g in found.kinds.items()}}.items():
            value, low, high = (percent(v) for v in (gain.value, gain.low, gain.high))
            share = f"{value} ({low} to {high})"
            said = f"{share} of the error above the noise is removed: " if gain.has_share else ""
            print(f"{what}: {said}{gain.status}")
        print(found.gain.words)
    for line in cause_words(found.causes, {name: words_of(name) for name in found.causes}):
        print(line)
    for line in no_skill_words(found.errors):
        print(line)
    if held := band_words(found.errors):
        print(held)
    for name in found.runs:
        _tell_outside(name, [far for far in found.outside if far.run == name])
    said = judged_headline(
        found.errors, found.gain, extended=bool(saved.components), gains=found.gains
    )
    print(said)
    content = {"study": inputs.study.name, "model": str(saved.path), "headline": said}
    print(f"wrote {write_json_atomic(out / JUDGE_FILE, {**content, **found.to_dict()})}")
    for path in write_judged(out, inputs.study, found):
        print(f"wrote {path}")

    def page() -> Path:
        from diffsim.viz.judged_report import judgment_page
        from diffsim.viz.report import write

        return write(judgment_page(found, inputs.study, saved), out / JUDGE_PAGE)

    (out / JUDGE_PAGE).unlink(missing_ok=True)  # of other runs: not to pass for this answer's
    is_drawn(page)


def _read_judged(args: argparse.Namespace, study: Study, out: Path) -> SavedModel:
    """The saved model; a study that nothing could be fitted to needs that of another one."""
    if args.saved is None and not study.fit_runs and not (out / MODEL_FILE).is_file():
        raise FileNotFoundError(
            f"study {study.name} has no run with use: fit, so no model was fitted to it; name the "
            "saved model of another study of this rig with --model FOLDER/extended_model.yaml"
        )
    return read_extended(args.saved or out)


def _say_fitted(rows: Sequence[OwnRow]) -> list[str]:
    """What was fitted to each run, the farthest from what is stated first."""
    out, told = [], [row for row in rows if row.is_told]
    for run in dict.fromkeys(row.run for row in told):
        own = [row for row in told if row.run == run]
        more = f"; {len(own) - MAX_FITTED} more in {JUDGE_FILE}" if len(own) > MAX_FITTED else ""
        said = "; ".join(row.words for row in own[:MAX_FITTED])
        out.append(f"fitted to {run}: {said}{more}")
    return [*out, *own_words(rows)]


def _tell_outside(name: str, rows: Sequence[OutsideRow]) -> None:
    """Where a run lies outside of what was fitted: facts of its set-up first, then the farthest."""
    if not rows:
        print(f"Run {name}: inside of what was fitted.")
    shown = sorted(rows, key=lambda row: not row.is_fact)[:MAX_OUTSIDE]
    for row in shown:
        print(row.words)
    if more := len(rows) - len(shown):
        what = "quantity" if more == 1 else "quantities"
        print(f"Run {name}: {more} more {what} outside, in {JUDGE_FILE}.")


def _faults(args: argparse.Namespace) -> None:
    """Verdict on every group of runs, new ones included."""
    study = with_new(args.study, args.new, dict(args.fact))
    if not args.accept_record and (faults := certain_faults(study)):
        _blame_record(study, faults, args.out or Path(DIAGNOSES) / study.name)
        return
    require_ready(study, args.study, plan=False, accept_record=args.accept_record)
    out = args.out or Path(DIAGNOSES) / study.name
    groups = args.groups or new_labels(len(args.new))
    _judge_groups(study, out, groups=groups, everything=args.all, seed=args.seed)


def _judge_groups(study: Study, out: Path, **which: Any) -> None:
    """Verdicts on groups, printed, saved and drawn."""
    (out / FAULTS_PAGE).unlink(missing_ok=True)  # of other groups: not to pass for these
    report = judged(study, out, **which)

    def page() -> Path:
        from diffsim.viz.faults_report import faults_page
        from diffsim.viz.report import write

        return write(faults_page(report), out / FAULTS_PAGE)

    is_drawn(page)


def _export(args: argparse.Namespace) -> None:
    study = read_study(args.study)
    out = args.out or Path(DIAGNOSES) / study.name
    saved = read_extended(args.saved or out)
    chosen = study if args.to is None else only_target(study, args.to)
    found = constants_of(chosen, saved) if args.to is None or chosen.export else []
    print(f"verdict: {saved.verdict}{'; value (90 % interval)' if found else ''}")
    for exported in found:
        print(f"{exported.title}:")
        for name, constant in exported.constants.items():
            print(f"  {name:<24} {constant.value:>12.6g}{say_interval(constant)}")
        print(f"wrote {write_json_atomic(out / f'{exported.stem}.json', exported.values())}")
    for note in notes_of(chosen, saved):
        print(note)
    ranges = {exported.stem: exported.ranges() for exported in found}
    print(f"wrote {write_json_atomic(out / EXPORT_FILE, ranges)}")
    if args.to is not None:
        export_to(args.to, study, saved, out)


def _next(args: argparse.Namespace) -> None:
    study = read_study(args.study)
    path = args.saved or (args.out or Path(DIAGNOSES) / study.name) / REPORT_FILE
    saved = _read_json(path)
    if saved is None:
        raise FileNotFoundError(
            f"{path}: no such report; make one with `diffsim diagnose explain {args.study}`"
        )
    if saved["verdict"] in (RECORD, FIRST_LOOK):
        raise ValueError(
            f"{path} holds no causes to choose from: {saved['headline']} Finish it with "
            f"`diffsim diagnose explain {args.study}`"
        )
    if saved["verdict"] == DESCRIBED:  # its laws are causes of no library, but of the saved model
        study = read_extended(path.parent).framed(study)
    inputs, out = _inputs(args, study, with_bank=True)
    sets, why = rival_sets(saved)
    print(why)
    for line in wanted_columns(saved):
        print(line)
    refined = saved["settings"].get("numerics")
    numerics = Numerics(**refined) if refined else None
    advice: NextRun | Narrowing | None
    if len(sets) > 1:
        advice = advise(inputs, sets, numerics)
        print("noise sd between the nearest two, by run to record:")
        _tell_runs(advice.apart, -1.0)
    else:
        advice = advise_narrowing(inputs, saved, numerics)
        if advice is None:
            return
        print("width of the intervals after a run, over that now:")
        _tell_runs({name: advice.width(name) for name in advice.shares}, 1.0)
    print(advice.words)
    write_json_atomic(out / NEXT_FILE, {"rivals": sets, "why": why, **asdict(advice)})
    print(f"wrote {out / NEXT_FILE}")
    if args.csv:
        best = next(run for run in inputs.setup.bank if run.name == advice.best)
        print(f"wrote {write_text_atomic(out / 'next.csv', command_table(best, inputs.study))}")


def _tell_runs(values: Mapping[str, float], sign: float) -> None:
    """A number for each run of a bank, the best first."""
    width = max(32, *(len(name) for name in values))
    for name, value in sorted(values.items(), key=lambda item: sign * item[1]):
        print(f"{name:<{width}} {figure(value):>12}")


def _read_json(path: Path) -> Mapping[str, Any] | None:
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: not JSON: {error}; remove it") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path}: must be a mapping; remove it")
    return content


STEPS: dict[str, Callable[[argparse.Namespace], None]] = {
    "init": _init,
    "schema": _schema,
    "check": _check,
    "fit": _fit,
    "explain": _explain,
    "extend": _extend,
    "judge": _judge,
    "faults": _faults,
    "export": _export,
    "next": _next,
    "command": command,
    "worth": worth,
}
