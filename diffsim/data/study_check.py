"""Gates on the data of a study: errors that would spoil a diagnosis, seen before any fit."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from diffsim.core.units import factor, to_si
from diffsim.data.study import SYSTEMS, USES, Channel, Run, Study

MIN_SAMPLES = 10
MAX_STEP = 1.5  # of the median step; a longer one is a gap in the clock
MAX_MISSING = 0.2  # share of a channel's samples
_SUFFIXES = ("mm", "cm", "um", "ms", "us", "deg", "rpm", "mbar", "kPa", "mV", "mA", "mN", "Pa",
             "rad", "Nm", "N", "rad_s", "m_s", "m_s2")  # fmt: skip
MAX_COMMAND_SCATTER = 0.02  # rms, of the command's range; repeats of one group must agree to this


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong with a study.

    Attributes:
        severity: "error": no diagnosis on these data; "warning": possible, with care.
        where: "study", "channel tip_z_m", "run step_a", ...
        message: What is wrong with the study and how to mend it.
    """

    severity: str
    where: str
    message: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.where}: {self.message}"


def check_study(study: Study) -> list[Problem]:
    """All problems of a study, errors first; an empty list means that it is fit for a diagnosis."""
    problems = [*_check_plan(study), *_check_channels(study)]
    for run in study.runs:
        problems += _check_run(run, study)
    problems += _check_groups(study)
    return sorted(problems, key=lambda p: p.severity != "error")


def _check_plan(study: Study) -> Iterator[Problem]:
    """Commands, held-out runs and names."""
    if study.model is None and study.system not in SYSTEMS:
        yield Problem("error", "study", f"system must be one of {SYSTEMS}, got {study.system!r}")
    names = Counter(run.name for run in study.runs)
    for name in (n for n, count in names.items() if count > 1):
        yield Problem("error", f"run {name}", "the name is used twice; names must be unique")
    fit_groups = {run.group for run in study.fit_runs}
    if len(fit_groups) < 2:
        yield Problem(
            "error",
            "study",
            f"at least two commands are needed among the fit runs, got {len(fit_groups)}; "
            "with one, causes that differ in frequency or amplitude look alike",
        )
    if not study.test_runs:
        yield Problem(
            "error", "study", "no held-out run; mark one with use: test, to test the verdict on"
        )
    elif all(run.group in fit_groups for run in study.test_runs):
        yield Problem(
            "warning",
            "study",
            "every held-out run repeats a fitted command; an unseen command tests more",
        )
    orders = Counter(run.order for run in study.runs)
    if any(count > 1 for count in orders.values()):
        yield Problem(
            "warning", "study", "runs share a place in the order; drifts over runs cannot be seen"
        )


def _check_channels(study: Study) -> Iterator[Problem]:
    if not study.channels:
        yield Problem("error", "study", "no channels; name at least one measured column")
    names = Counter([c.name for c in study.channels])
    repeated_groups = [g for g, n in Counter(r.group for r in study.fit_runs).items() if n > 1]
    for channel in study.channels:
        where = f"channel {channel.name}"
        if names[channel.name] > 1:
            yield Problem("error", where, "the name is used twice; names must be unique")
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
                "noise unknown: no sd and no repeated run; give sd or repeat a command",
            )


def _said_unit(channel: Channel) -> str | None:
    """Unit at the end of a channel's name if it contradicts the channel's own."""
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
    if run.measured.shape != (n, len(study.channels)):
        yield Problem(
            "error",
            where,
            f"measured must have shape (num_samples, num_channels) = "
            f"({n}, {len(study.channels)}), got {run.measured.shape}",
        )
        return
    if n < MIN_SAMPLES:
        yield Problem("error", where, f"{n} samples; at least {MIN_SAMPLES} are needed")
        return
    yield from _check_clock(run, where)
    if not np.isfinite(run.measured).any():
        yield Problem("error", where, "nothing was measured in this run; leave it out")
        return
    for channel, values in zip(study.channels, run.measured.T, strict=True):
        missing = float(np.isnan(values).mean())
        if np.isinf(values).any():
            yield Problem("error", where, f"{channel.name} has infinite values")
        elif missing > MAX_MISSING:
            yield Problem(
                "warning", where, f"{channel.name} is missing in {missing:.0%} of samples"
            )
        if missing < 1.0 and np.nanmin(values) == np.nanmax(values):
            yield Problem("warning", where, f"{channel.name} never changes; is the sensor stuck?")
    for name, values in run.command.items():
        if values.shape != (n,):
            yield Problem(
                "error", where, f"command {name} must have shape ({n},), got {values.shape}"
            )
        elif not np.isfinite(values).all():
            share = float((~np.isfinite(values)).mean())
            yield Problem("warning", where, f"command {name} is unknown in {share:.0%} of samples")


def _check_clock(run: Run, where: str) -> Iterator[Problem]:
    if not np.isfinite(run.time_s).all():
        yield Problem("error", where, "time_s has missing values; every sample needs a time")
        return
    step = np.diff(run.time_s)
    if (step <= 0.0).any():
        at = int(np.argmax(step <= 0.0)) + 1
        yield Problem(
            "error", where, f"time_s does not increase at sample {at} ({run.time_s[at]:g} s)"
        )
        return
    long = step > MAX_STEP * np.median(step)
    if long.any():
        at = int(np.argmax(long))
        yield Problem(
            "warning",
            where,
            f"{int(long.sum())} gaps in the clock, the first after {run.time_s[at]:g} s "
            f"({step[at]:g} s against {np.median(step):g} s)",
        )


def _check_groups(study: Study) -> Iterator[Problem]:
    """Commands are known in every run, and equal within a group."""
    names = {frozenset(run.command) for run in study.runs}
    if len(names) > 1:
        yield Problem("error", "study", "runs have different command columns; give all to each")
        return
    first: dict[str, Run] = {}
    for run in study.runs:
        reference = first.setdefault(run.group, run)
        for name, values in run.command.items():
            if reference is run or values.shape != run.time_s.shape:
                continue
            scatter = _scatter(run, reference, name)
            if scatter > MAX_COMMAND_SCATTER:
                yield Problem(
                    "warning",
                    f"run {run.name}",
                    f"command {name} differs from that of run {reference.name} in the same group "
                    f"{run.group!r} by {scatter:.1%} rms of its range; align the clocks, "
                    "or make it another group",
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
