"""``diffsim diagnose check``: every mistake that can be seen before a simulation, at once."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from diffsim.causes.scene import PLAY_START
from diffsim.cli.diagnose_trial import trial_problems
from diffsim.core.errors import DiffsimError
from diffsim.core.figures import list_first
from diffsim.data.columns_beside import outputs_of
from diffsim.data.header_units import header_units
from diffsim.data.record.clocks import TIMELESS
from diffsim.data.run_files import BLOCK_OF
from diffsim.data.shown import resolution_words, shown, shown_change, shown_step
from diffsim.data.study import Channel, Command, Run, Study
from diffsim.data.study_check import NO_FIT_RUN, TODO, Problem, check_study, merge_alike
from diffsim.data.study_file import read_whole
from diffsim.data.study_schema import StudyFile
from diffsim.diagnose.checks.gates import alike_channels, cut_in_two, require_separate
from diffsim.diagnose.checks.noise import UNREPEATABLE, repeat_deviations
from diffsim.diagnose.checks.whole_record import model_problems
from diffsim.diagnose.faults.given import take_apart
from diffsim.systems.ode.repeat import write_out
from diffsim.systems.registry import description_of, setup_of

MAX_RUNS = 24  # rows of the table
MAX_LEFT_OUT = 8  # sentences on what is not used
MAX_FACTS = 3  # of a run that are shown
NAMES_ITS_COLUMNS = ("ode", "bench", "soft_body", "rigid_body", "multicopter", "flow_network")


class StudyError(DiffsimError):
    """Recordings that cannot be diagnosed."""


def check(study: Study, given: str, *, accept_record: bool = False) -> None:
    """Show a study and what is wrong with it.

    Args:
        study: Study as it was read.
        given: What the user called it, for messages.
        accept_record: Whether faults of the record itself are no errors.

    Raises:
        StudyError: the study has errors, printed above.
    """
    for line in (*_summary(study), ""):
        print(line)
    only_judged = bool(study.test_runs) and not study.fit_runs
    problems = [_as_note(p) if only_judged else p for p in problems_of(study)]
    problems = accepted(problems) if accept_record else problems
    if not any(p.severity == "error" for p in problems) and study.model is not None:
        found, made = _of_setup(study)
        problems += accepted(found) if accept_record else found
        print(made) if made else None
    _tell(problems, given)
    if only_judged:
        print(f"ready to be judged: diffsim diagnose judge {given} --model FOLDER")
    else:
        print("ready for a diagnosis: diffsim diagnose explain", given)


def _as_note(problem: Problem) -> Problem:
    """Of a study of test runs alone: that nothing can be fitted is no mistake."""
    return replace(problem, severity="note") if problem.message == NO_FIT_RUN else problem


def accepted(problems: Sequence[Problem]) -> list[Problem]:
    """Problems of which those of the record keep nobody from a diagnosis."""
    return [replace(p, severity="warning") if p.rule and is_error(p) else p for p in problems]


def certain_faults(study: Study) -> list[Problem]:
    """Faults of the record that keep physics from being asked, if there is no other mistake."""
    errors = [p for p in check_study(study) if is_error(p)]
    return errors if all(p.rule for p in errors) else []


def is_error(problem: Problem) -> bool:
    """Whether a problem keeps a study from a diagnosis."""
    return problem.severity == "error"


def require_ready(
    study: Study, given: str, *, plan: bool = True, accept_record: bool = False
) -> None:
    """Print what is wrong with a study, and refuse one with errors.

    Args:
        given: What the user called it, for messages.
        plan: Whether uses and commands of its runs matter, as they do for a fit.
        accept_record: Whether faults of the record itself are no errors.

    Raises:
        StudyError: the study has errors, printed above.
    """
    problems = [p for p in problems_of(study) if plan or p.rule or p.where != "study"]
    _tell(accepted(problems) if accept_record else problems, given)


def _tell(problems: Sequence[Problem], given: str) -> None:
    ordered = sorted(problems, key=lambda p: p.severity != "error")
    for line in merge_alike(ordered):
        print(line)
    errors = [problem for problem in ordered if is_error(problem)]
    if errors:
        by_record = all(problem.rule for problem in errors)
        goes_on = "; --accept-record goes on as it is" if by_record else ""
        raise StudyError(
            f"{len(errors)} of {len(ordered)} problems keep {given} from a diagnosis{goes_on}"
        )


def problems_of(study: Study) -> list[Problem]:
    """All that is wrong with the recordings, with the description, and between both."""
    found = check_study(study)
    try:
        require_separate(study)
    except ValueError as error:
        found.append(Problem("error", "study", str(error)))
    else:
        for first, second, names in alike_channels(study):
            are = "is" if len(names) == 1 else "are"
            found.append(
                Problem(
                    "warning",
                    f"run {second.name}",
                    f"{list_first(names)} {are} equal to the last digit to run {first.name} (use: "
                    f"{first.use}): if that is one recording in two frames, give both the same use",
                )
            )
    # without a clock rows are counted over the whole file, whatever they hold
    for first, second in cut_in_two(study) if _has_clock(study) else ():
        if BLOCK_OF in first.setup and BLOCK_OF in second.setup:
            continue  # pieces of two recordings, whose clocks happen to meet
        found.append(
            Problem(
                "warning",
                f"run {second.name}",
                f"it goes on where run {first.name} ends: it tests little beyond that one",
            )
        )
    if study.file is not None:
        found += header_units(study.file)
    return [*found, *_of_model(study)]


def _has_clock(study: Study) -> bool:
    """Whether a column of the files tells the time: a step alone numbers rows."""
    if study.file is None:
        return True
    clocks = StudyFile.model_validate(read_whole(study.file)).time
    return not clocks or any(clock.column is not None or clock.step is None for clock in clocks)


def _of_model(study: Study) -> Iterator[Problem]:
    if study.model is None:
        yield Problem(
            "warning", "model", "is missing: only own setups (--setup FILE.py) can be judged"
        )
        return
    try:
        description = description_of(study)
    except ImportError as error:
        yield Problem("error", "model", f"this installation cannot read it: {error}")
        return
    except ValueError as error:
        for line in str(error).splitlines():
            where, _, message = line.partition(": model")
            key, _, what = message.partition(": ")
            if TODO in what:  # told already
                continue
            yield Problem("error", f"model{key}" if message else where, what or line)
        return
    try:
        yield from description.problems(study)
    except ValueError as error:  # what only the numbers of a record show
        yield Problem("error", "model", str(error))
        return
    if study.model.get("system") in NAMES_ITS_COLUMNS:
        yield from _not_mentioned(study)
    if study.model.get("system") in ("ode", "bench"):
        yield from _without_use(study.model)


def _not_mentioned(study: Study) -> Iterator[Problem]:
    """Columns of which no word of the description speaks."""
    every = set(_words(study.model))
    words = {w for w in every if len(w) > 1}  # a letter may stand in any name
    commands = {name: "command" for run in study.runs for name in run.command}
    for name, what in {**commands, **{c.name: "channel" for c in study.channels}}.items():
        if name not in every and not any(w in name or name in w for w in words):
            yield Problem(
                "warning", f"{what} {name}", "the model does not mention it; is it of any use?"
            )


def _without_use(model: Mapping[str, Any]) -> Iterator[Problem]:
    """Parameters that no formula has."""
    model = write_out(model)
    words = {w for key, part in model.items() if key != "parameters" for w in _words(part)}
    for name in model.get("parameters") or ():
        if str(name) not in words:
            yield Problem("warning", f"model.parameters.{name}", "no formula uses it")


def _words(stated: Any) -> Iterator[str]:
    if isinstance(stated, Mapping):
        for key, value in stated.items():
            yield from (str(key), *_words(value))
    elif isinstance(stated, (list, tuple)):
        for value in stated:
            yield from _words(value)
    elif isinstance(stated, str):
        yield from re.findall(r"\w+", stated)


def _of_setup(study: Study) -> tuple[list[Problem], str]:
    """What making the model brings to light, and what the model is made of; nothing is run."""
    try:
        setup = setup_of(study)
    except (ValueError, KeyError, TypeError, OSError, DiffsimError) as error:
        return [Problem("error", "model", f"{type(error).__name__}: {error}")], ""
    # a number of a cause's formula is only fitted beside the cause
    base = [p for p in setup.model.base if not p.of_effect]
    causes = [e.name for e in setup.effects]
    if study.faults is not None:
        try:
            take_apart(study, setup)
        except ValueError as error:
            return [Problem("error", "study.yaml", str(error))], ""
    # where a play begins is only fitted beside a play
    shown = [p.name for p in base if not p.name.startswith(PLAY_START)]
    more = len(base) - len(shown)
    starts = f"; {PLAY_START}, {more} more, one per run: only beside a play" if more else ""
    told = [f"{line}\n" for line in done_by_setup(study, setup.study or study)]
    problems = [*trial_problems(study, setup), *model_problems(study, setup)]
    return problems, "".join(told) + (
        f"model: {len(shown)} base parameters ({list_first(shown)}{starts}), "
        f"{len(causes)} candidate causes ({list_first(causes)})"
    )


def _summary(study: Study) -> Iterator[str]:
    """What the study holds, as tables, and what its uses of runs imply."""
    yield f"{study.name}: {_count(study.runs, 'run')}, {_count(study.channels, 'channel')}"
    yield ""
    yield from _table(
        ["channel", "unit", "kind", "noise sd", "smallest", "largest", "missing"],
        [_channel_row(study, i, c) for i, c in enumerate(study.channels)],
    )
    known = {c.name: c for c in study.commands}
    names = dict.fromkeys(name for run in study.runs for name in run.command)
    if names:
        yield ""
        yield from _table(
            ["command", "unit", "smallest", "largest", "limits", "rate"],
            [_command_row(study, name, known.get(name, Command(name))) for name in names],
        )
    yield ""
    rows = [_run_row(run) for run in sorted(study.runs, key=lambda r: r.order)]
    yield from _table(["run", "use", "group", "samples", "step", "from .. to", "facts"], rows)
    if (study.model or {}).get("system") not in TIMELESS and (fine := resolution_words(study)):
        yield fine
    yield ""
    yield from _describe_uses(study)
    repeats = {g: n for g, n in Counter(r.group for r in study.runs).items() if n > 1}
    if repeats:
        yield f"repeats: {list_first([f'{n} runs of {g}' for g, n in repeats.items()])}"
        yield from _scatter_rows(study)
    outputs = outputs_of(study)
    if beside := [c for c in study.columns if c.name not in outputs]:
        shown = [f"{c.name} [{c.unit}]" if c.unit else c.name for c in beside]
        yield f"recorded beside: {list_first(shown)}; what is left may depend on them"
    if outputs:
        yield f"outputs, told by channels: {list_first(sorted(outputs))}; no cause acts by them"
    yield from done_by_setup(replace(study, mended=(), left_out=()), study)


def done_by_setup(given: Study, used: Study) -> Iterator[str]:
    """Lines on what was done to a record, and what of it is not used, the first of them in full.

    Args:
        used: The same as a setup uses it.
    """
    mended = used.mended[len(given.mended) :]
    yield from (f"done to the record: {sentence}" for sentence in mended)
    sentences = used.left_out[len(given.left_out) :]
    for sentence in sentences[:MAX_LEFT_OUT]:
        yield f"not used: {sentence}"
    if (more := len(sentences) - MAX_LEFT_OUT) > 0:
        yield f"not used: ... and {more} more"


def _describe_uses(study: Study) -> Iterator[str]:
    """Which runs do what."""
    fit, select, test = (study.runs_for(use) for use in ("fit", "select", "test"))
    yield f"fit: {_count(fit, 'run')}; parameters are fitted to these"
    yield (
        f"select: {list_first([r.name for r in select])}; these choose between causes"
        if select
        else "select: none; causes are chosen by leaving out one fit run (or block) at a time"
    )
    yield (
        f"test: {list_first([r.name for r in test])}; touched once, when the answer is frozen"
        if test
        else "test: none; nothing will show what the causes found are worth on unseen runs"
    )


def _scatter_rows(study: Study) -> Iterator[str]:
    """Channels whose repeats differ, as they were recorded, by more than the stated noise."""
    runs = study.fit_runs
    deviations = repeat_deviations(runs, {run.name: run.measured for run in runs})
    if not deviations:
        return
    scatter = np.sqrt(np.nanmean(np.concatenate(deviations) ** 2, axis=0))
    for channel, size in zip(study.channels, scatter.tolist(), strict=True):
        if channel.sd is not None and size > UNREPEATABLE * channel.sd:
            yield (
                f"repeats of {channel.name} differ by {shown_step(channel, size)} as they were "
                f"recorded, {size / channel.sd:.2g} times its sd: causes are only judged if the "
                "model tells them apart, by its starts for one, or if sd holds the difference"
            )


def _channel_row(study: Study, at: int, channel: Channel) -> list[str]:
    values = np.concatenate([r.measured[:, at] for r in study.runs] or [np.empty(0)])
    sd = "from repeats"
    if channel.sd is not None:  # of a scaled reading: that of small ones
        sd = f"{shown_change(channel, np.zeros(()), np.array(channel.sd)):.3g}"
    missing = float(np.isnan(values).mean()) if len(values) else 0.0
    share = f"{100.0 * missing:.2g} %" if missing else "-"
    ends = _range(shown(channel, values))
    return [channel.name, channel.shown_unit or channel.unit, channel.kind, sd, *ends, share]


def _command_row(study: Study, name: str, command: Command) -> list[str]:
    values = np.concatenate([r.command[name] for r in study.runs if name in r.command])
    unit, scale = command.shown_unit or command.unit or "?", float(shown(command, np.ones(())))
    ends = [command.lower, command.upper]
    known = any(v is not None for v in ends)
    limits = " .. ".join("?" if v is None else f"{v * scale:.4g}" for v in ends) if known else "-"
    limits = "measured" if command.is_measured else limits
    rate = "-" if command.rate is None else f"{command.rate * scale:.4g}"
    return [name, unit, *_range(values * scale), limits, rate]


def _range(values: np.ndarray) -> list[str]:
    there = values[np.isfinite(values)]
    return [f"{there.min():.4g}", f"{there.max():.4g}"] if len(there) else ["-", "-"]


def _run_row(run: Run) -> list[str]:
    t = run.time_s
    step = f"{float(np.median(np.diff(t))):.3g} s" if len(t) > 1 else "-"
    facts = [f"{k}={v:.4g}" if isinstance(v, float) else f"{k}={v}" for k, v in run.setup.items()]
    group = run.group if run.group != run.name else "-"
    ends = f"{_format_time(t[0])} .. {_format_time(t[-1])} s" if len(t) else "-"
    return [run.name, run.use, group, str(len(t)), step, ends, list_first(facts, MAX_FACTS)]


def _format_time(time_s: float) -> str:
    """A time; of a clock that counts from long ago all seconds are shown."""
    return f"{time_s:.4g}" if abs(time_s) < 1e4 else f"{time_s:.2f}"


def _table(header: list[str], rows: list[list[str]]) -> Iterator[str]:
    shown = rows[:MAX_RUNS]
    widths = [max(len(r[i]) for r in (header, *shown)) for i in range(len(header))]
    for row in (header, *shown):
        yield "  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip()
    if len(rows) > MAX_RUNS:
        yield f"... and {len(rows) - MAX_RUNS} more"


def _count(of: Sequence[Any], what: str) -> str:
    return f"{len(of)} {what}{'' if len(of) == 1 else 's'}"
