"""Gates on the data of a study: errors that would spoil a diagnosis, seen before any fit."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from diffsim.core.check import LARGEST
from diffsim.core.checked import checked
from diffsim.core.figures import list_first
from diffsim.core.units import factor, to_si
from diffsim.data.record import record_findings
from diffsim.data.shared_rows import SHARED_BITS, bits_of, shared_stretches
from diffsim.data.shown import shown_step
from diffsim.data.signal import GAP, scatter, step_of
from diffsim.data.study import USES, Channel, Run, Study

NO_FIT_RUN = (
    "no run with use: fit; nothing can be fitted, only `judge` works, with a model that was saved"
)
TODO = "TODO"  # what a user is still to fill in
MIN_SAMPLES = 10
BLOCK_OF = "block_of"  # fact of a run that is a declared piece of another
COPIED = 0.5  # of the shorter of two runs
LATE = 1e6  # s: a clock that starts here counts from some other epoch than the run
MANY_SAMPLES = 100_000  # of all runs and channels; what is simulated at each costs time
THINS = ("ode",)  # systems that leave out rows themselves
TOO_LARGE = (
    f"{{}} has values beyond {LARGEST:g}, of which no squares can be taken: `decode: {{{{valid: "
    "[LOW, HIGH]}}` leaves them out"
)
MAX_MISSING = 0.2  # share of a channel's samples
_SUFFIXES = ("mm", "cm", "um", "ms", "us", "deg", "rpm", "mbar", "kPa", "mV", "mA", "mN", "Pa",
             "rad", "Nm", "N", "rad_s", "m_s", "m_s2")  # fmt: skip
MAX_SCATTER = 4.0  # times the stated sd and that of other runs: at most 2.7 in 27 published sets
MAX_COMMAND_SCATTER = 0.02  # rms, of the command's range; repeats of one group must agree to this


@checked(kinds_only=True)
@dataclass(frozen=True)
class Problem:
    """One thing that is wrong with a study.

    Attributes:
        severity: "error": no diagnosis on these data; "warning": possible, with care; "note": what
            was taken for granted.
        where: "study", "channel tip_z_m", "run step_a", ...
        message: What is wrong with the study and how to mend it.
        rule: Of the record, that saw it; "": none did.
    """

    severity: str
    where: str
    message: str
    rule: str = ""

    def __str__(self) -> str:
        return f"{self.severity}: {self.where}: {self.message}"


@checked
def check_study(study: Study) -> list[Problem]:
    """All problems of a study, errors first; an empty list means that it is fit for a diagnosis."""
    problems = [*_check_plan(study), *_check_channels(study)]
    for run in study.runs:
        problems += _check_run(run, study)
    problems += [*_check_groups(study), *_copies(study)]
    if not any(p.severity == "error" and p.where.startswith("run ") for p in problems):
        problems += record_problems(study)
    return sorted(problems, key=lambda p: p.severity != "error")


def record_problems(study: Study) -> Iterator[Problem]:
    """What rules of the record have found: errors are those that stop."""
    for found in record_findings(study):
        severity = "error" if found.stops else "warning" if found.remedy else "note"
        yield Problem(severity, found.where, str(found), found.rule)


def merge_alike(problems: Sequence[Problem]) -> Iterator[str]:
    """A line for each problem; one for all runs, or channels, that have the same, but for its
    numbers and their names."""
    alike: dict[tuple[str, ...], list[Problem]] = {}
    for problem in problems:
        kind, _, name = problem.where.partition(" ")
        key = problem.severity, problem.where, problem.message
        if kind in ("run", "channel"):
            named = re.sub(rf"{re.escape(name)}\b|\w+\[\d+\]", "#", problem.message)
            key = problem.severity, kind, re.sub(r"[-+]?\d[\d.e+-]*( samples?)?", "#", named)
        alike.setdefault(key, []).append(problem)
    for first, *others in alike.values():
        names = dict.fromkeys(p.where.partition(" ")[2] for p in others if p.where != first.where)
        yield f"{first}" + (f" (likewise {list_first([*names])})" if names else "")


def _check_plan(study: Study) -> Iterator[Problem]:
    """Commands, held-out runs and facts."""
    fit_groups = {run.group for run in study.fit_runs}
    if not study.fit_runs:
        yield Problem("error", "study", NO_FIT_RUN)
    elif len(fit_groups) < 2:
        yield Problem(
            "warning",
            "study",
            "all fit runs have one command: causes that differ in frequency or amplitude look "
            "alike; record another, or cut a long run in blocks",
        )
    if not study.test_runs:
        yield Problem(
            "warning",
            "study",
            "no run with use: test, so nothing will show what the causes found are worth on "
            "unseen runs; keep one back",
        )
    elif all(run.group in fit_groups for run in study.test_runs):
        yield Problem(
            "warning",
            "study",
            "every test run repeats a fitted command; an unseen command tests more",
        )
    said = f"{study.model} {study.faults}"
    for name in dict.fromkeys(key for run in study.fit_runs for key in run.setup):
        labels = dict.fromkeys(run.setup.get(name) for run in study.fit_runs)
        is_label = all(isinstance(one, str) and one for one in labels) and name != BLOCK_OF
        is_used = re.search(rf"\b{re.escape(name)}\b", said)
        if is_label and not is_used and 1 < len(labels) < len(study.fit_runs):
            shown = ", ".join(map(str, list(labels)[:3])) + (", ..." if len(labels) > 3 else "")
            yield Problem(
                "warning",
                "study",
                f"no number of the model may differ by {name} ({shown}): if these are other "
                "objects or states, what differs is taken for another cause; "
                f"`per: {name}` gives a number to each",
            )
    for sentence in study.todo:
        yield Problem("warning", "study", f"still to be stated: {sentence}")
    yield from _find_unfilled("model", study.model)
    size = sum(run.measured.size for run in study.runs if run.use != "test")
    if size > MANY_SAMPLES and (study.model or {}).get("system") not in THINS:
        longest = max(study.runs, key=lambda run: len(run.time_s))
        yield Problem(
            "warning",
            "study",
            f"{size} samples to be simulated, run {longest.name} alone has "
            f"{len(longest.time_s)}; use a window or each n-th (until_s, every) to save time",
        )
    orders = Counter(run.order for run in study.runs)
    if any(count > 1 for count in orders.values()):
        yield Problem(
            "warning", "study", "runs share a place in the order; drifts over runs cannot be seen"
        )


def _find_unfilled(where: str, stated: Any) -> Iterator[Problem]:
    """Places of a description that still say TODO."""
    if isinstance(stated, Mapping):
        for key, value in stated.items():
            yield from _find_unfilled(f"{where}.{key}", value)
    elif isinstance(stated, (list, tuple)):
        for i, value in enumerate(stated):
            yield from _find_unfilled(f"{where}[{i}]", value)
    elif isinstance(stated, str) and TODO in stated:
        yield Problem("error", where, f"is still to be filled in: {stated}")


def _check_channels(study: Study) -> Iterator[Problem]:
    if not study.channels:
        yield Problem("error", "study", "no channels; name at least one measured column")
    repeated_groups = [g for g, n in Counter(r.group for r in study.fit_runs).items() if n > 1]
    for channel in study.channels:
        where = f"channel {channel.name}"
        if (said := _said_unit(channel)) is not None:
            yield Problem(
                "error",
                where,
                f"the name ends in {said!r}, but unit is {channel.unit!r}; rename the channel or "
                "mend its unit",
            )
        if channel.sd is not None and not channel.sd > 0.0:
            yield Problem("error", where, f"sd must be above 0, got {channel.sd:g}")
        if channel.sd is None and not repeated_groups:
            yield Problem(
                "error",
                where,
                "noise unknown: no sd and no repeated run; give sd or repeat a command"
                + _jitter(study, channel),
            )
        yield from _steps(study, channel)
        yield from _shaken(study, channel)


def _steps(study: Study, channel: Channel) -> Iterator[Problem]:
    """Readings that lie on steps coarser than the stated noise."""
    if channel.sd is None:
        return
    at = study.channels.index(channel)
    columns = [r.measured[:, at] for r in study.runs]
    step = step_of(np.concatenate(columns)) if columns else None
    if step is not None and step / np.sqrt(12.0) > channel.sd:
        yield Problem(
            "note",
            f"channel {channel.name}",
            f"it shows steps of {shown_step(channel, step)}; their rounding is taken for noise",
        )


def _shaken(study: Study, channel: Channel) -> Iterator[Problem]:
    """Runs that scatter far more than the stated noise and than the others: they hide causes."""
    levels = _scatter_by_run(study, channel, 4) if channel.sd else {}
    usual = max(channel.sd or 0.0, float(np.median([*levels.values(), 0.0])))
    alike = sorted(
        (n for n, v in levels.items() if v > MAX_SCATTER * usual), key=levels.__getitem__
    )
    if alike and channel.sd:
        *others, most = alike
        more = f" (likewise {', '.join(others)})" if others else ""
        yield Problem(
            "note",
            f"channel {channel.name}",
            f"from sample to sample run {most} scatters by {shown_step(channel, levels[most])}, "
            f"{levels[most] / channel.sd:.2g} times the stated sd{more}: state it as it is, or "
            f"leave it out of such runs (columns: {{{channel.name}: null}})",
        )


def _jitter(study: Study, channel: Channel) -> str:
    """Scatter from sample to sample, as a hint for the sd."""
    levels = list(_scatter_by_run(study, channel, 2).values())
    if not levels or not max(levels) > 0.0:
        return ""
    size = shown_step(channel, float(np.median(levels)))
    return f" (from sample to sample it scatters by {size})"


def _scatter_by_run(study: Study, channel: Channel, order: int) -> dict[str, float]:
    """Scatter of a channel behind differences of an order, by name of runs that are long enough."""
    at, found = study.channels.index(channel), dict[str, float]()
    for run in study.runs:
        steps = np.diff(run.measured[:, at], n=order)
        if np.isfinite(steps).sum() >= MIN_SAMPLES:
            found[run.name] = float(scatter(steps, order))
    return found


def _said_unit(channel: Channel) -> str | None:
    """Unit at the end of a channel's name if it contradicts the channel's own."""
    if channel.unit == "-":  # a share or a scaled reading of what the name says
        return None
    for suffix in _SUFFIXES:
        if channel.name.endswith(f"_{suffix}"):
            unit = suffix.replace("_", "/")
            try:
                size = factor(unit, to_si(channel.unit).unit)
            except ValueError:  # another quantity
                return suffix
            shown = channel.shown_unit or channel.unit
            return None if size == 1.0 or factor(unit, shown) == 1.0 else suffix
    return None


def _check_run(run: Run, study: Study) -> Iterator[Problem]:
    where, n = f"run {run.name}", len(run.time_s)
    if run.use not in USES:
        yield Problem("error", where, f"use must be one of {USES}, got {run.use!r}")
    if n < MIN_SAMPLES:
        yield Problem(
            "warning" if n else "error",
            where,
            f"{n} samples; fewer than {MIN_SAMPLES} tell of states at rest only",
        )
    if n > 1:
        yield from _check_clock(run, where)
    if not n:
        return
    if not np.isfinite(run.measured).any():
        yield Problem("error", where, "nothing was measured in this run; leave it out")
        return
    for channel, values in zip(study.channels, run.measured.T, strict=True):
        missing = float(np.isnan(values).mean())
        if (np.abs(values) > LARGEST).any():
            yield Problem("error", where, TOO_LARGE.format(f"channel {channel.name}"))
        elif MAX_MISSING < missing < 1.0:  # what a run did not record at all is no fault
            yield Problem(
                "warning", where, f"{channel.name} is missing in {missing:.0%} of samples"
            )
        elif missing == 1.0:
            yield Problem(
                "note", where, f"{channel.name} was not recorded: all its cells are empty"
            )
        if missing < 1.0 and n >= MIN_SAMPLES and np.nanmin(values) == np.nanmax(values):
            yield Problem("warning", where, f"{channel.name} never changes; is the sensor stuck?")
    for name, values in run.command.items():
        if (np.abs(values) > LARGEST).any():
            yield Problem("error", where, TOO_LARGE.format(f"command {name}"))
        elif not np.isfinite(values).all():
            unknown = int((~np.isfinite(values)).sum())
            share = f"{unknown / n:.0%}" if unknown >= 0.005 * n else f"{unknown} of {n}"
            yield Problem("warning", where, f"command {name} is unknown in {share} of samples")


def _check_clock(run: Run, where: str) -> Iterator[Problem]:
    if run.time_s[0] > LATE:
        yield Problem(
            "warning",
            where,
            f"its clock starts at {run.time_s[0]:.0f} s; zero_time: start (in defaults) makes "
            "every run start at 0 s",
        )
    step = np.diff(run.time_s)
    long = step > GAP * np.median(step)
    if long.any():
        at = int(np.argmax(long))
        yield Problem(
            "warning",
            where,
            f"{int(long.sum())} gaps in the clock, the first after {run.time_s[at]:g} s "
            f"({step[at]:g} s against {np.median(step):g} s)",
        )


def _copies(study: Study) -> Iterator[Problem]:
    """Runs of one use that hold the same samples: a copy repeats nothing, noise included.

    Runs of different uses are compared elsewhere.
    """
    runs, told = [r for r in study.runs if len(r.measured) >= MIN_SAMPLES], set()

    def may_share(a: int, b: int) -> bool:
        return runs[a].use != runs[b].use or BLOCK_OF in runs[b].setup

    for found in shared_stretches([run.measured for run in runs], may_share):
        first, copy = runs[found.first], runs[found.second]
        share = found.length / min(len(first.measured), len(copy.measured))
        part = copy.measured[found.start : found.start + found.length]
        is_whole = found.length == len(first.measured) == len(copy.measured)
        least = 1.0 if is_whole else SHARED_BITS
        if share < COPIED or copy.name in told or bits_of(part) < least:
            continue
        told.add(copy.name)
        yield Problem(
            "error",
            f"run {copy.name}",
            f"it is a copy of run {first.name}: {found.length} samples are equal to the digit; "
            "mend its file, or leave it out",
        )


def _check_groups(study: Study) -> Iterator[Problem]:
    """Commands are known in every run, and equal within a group."""
    names = {frozenset(run.command) for run in study.runs}
    if len(names) > 1:
        yield Problem("error", "study", "runs have different command columns; give all to each")
        return
    groups: dict[str, list[Run]] = {}
    for run in study.runs:
        groups.setdefault(run.group, []).append(run)
    # what a controller gave out differs between repeats: they share what was asked of it
    measured = {c.name for c in study.commands if c.is_measured}
    for group, (reference, *others) in groups.items():
        apart = [
            (scatter, name, run.name)
            for run in others
            for name, values in run.command.items()
            if name not in measured and values.shape == run.time_s.shape
            if (scatter := _scatter(run, reference, name)) > MAX_COMMAND_SCATTER
        ]
        if apart:
            worst, name, run_name = max(apart)
            commands = ", ".join(dict.fromkeys(name for _, name, _ in apart))
            yield Problem(
                "warning",
                f"group {group}",
                f"its runs did not execute one command: {commands} differ, most {name} of run "
                f"{run_name} from that of run {reference.name}, by {worst:.1%} rms of its range; "
                "align the clocks, put runs into groups of their own, or say is_measured: true of "
                "what a controller gave out",
            )


def _scatter(run: Run, reference: Run, name: str) -> float:
    """Rms difference of one command over the common time, as a share of its range."""
    t = run.time_s
    other = np.interp(t, reference.time_s, reference.command[name], left=np.nan, right=np.nan)
    difference = (run.command[name] - other)[np.isfinite(run.command[name] - other)]
    if not len(difference):
        return 0.0
    size = float(np.ptp(run.command[name][np.isfinite(run.command[name])]))
    level = size if size > 0.0 else max(abs(float(run.command[name][0])), 1e-300)
    return float(np.sqrt(np.mean(difference**2))) / level
