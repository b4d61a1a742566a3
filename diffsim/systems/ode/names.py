"""Names that formulas of a description may use in a study, and the facts behind some of them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping

import numpy as np
import torch
from torch import Tensor

from diffsim.core.check import did_you_mean
from diffsim.core.expression import FUNCTIONS, Expression, parse_expression
from diffsim.data.study import Run, Study
from diffsim.data.study_check import Problem
from diffsim.systems.ode.keys import FormulaKeys, Rest
from diffsim.systems.ode.network import TIME

RUN_ORDER = "run_order"
RESTS = "rests"  # place in a study's frame
ALIKE = 0.02  # of the range of a channel: means at rest that differ by less are one
_RESERVED = (TIME, RUN_ORDER, "reading", "size", "slow_time", "pi", "e", *FUNCTIONS)


def where_of(study: Study) -> str:
    """How messages call the description of a study."""
    return "study.yaml: model" if study.file is None else f"{study.file}: model"


def facts_of(run: Run) -> dict[str, float]:
    """Numbers that are known of a run: its facts, its place in the order."""
    numbers = {
        k: float(v)
        for k, v in run.setup.items()
        if isinstance(v, (int, float)) and not isinstance(v, bool)
    }
    return {**numbers, RUN_ORDER: float(run.order)}


def fact_names(study: Study) -> tuple[str, ...]:
    """Names of the numbers that every run has."""
    shared: dict[str, None] = dict.fromkeys(facts_of(study.runs[0]))
    for run in study.runs:
        own = facts_of(run)
        shared = {name: None for name in shared if name in own}
    return tuple(shared)


def data_names(study: Study, rest: Rest | None) -> tuple[str, ...]:
    """Names of what is taken from the measured samples."""
    names = [f"first_{c.name}" for c in study.channels]
    return (*names, *(f"rest_{c.name}" for c in study.channels)) if rest else tuple(names)


def data_values(study: Study, run: Run, rest: Rest | None) -> dict[str, float]:
    """First samples of the channels, and their means while the system rests.

    They are facts of the recording: those of the whole run also where a part of it is left out.
    A mean that the run states among its facts is no longer taken from samples. A run that begins
    after its rest has the mean of the runs that were fitted, if that is in the study's frame.

    Raises:
        ValueError: nothing was measured while it should rest.
    """
    out = {}
    run = next((r for r in study.runs if r.name == run.name), run)
    for channel, column in zip(study.channels, run.measured.T, strict=True):
        seen = column[np.isfinite(column)]
        out[f"first_{channel.name}"] = float(seen[0]) if len(seen) else 0.0
        if rest is not None and f"rest_{channel.name}" not in facts_of(run):
            low = -math.inf if rest.from_s is None else _evaluate_fact(rest.from_s, run)
            high = _evaluate_fact(rest.until_s, run)
            inside = column[(run.time_s >= low) & (run.time_s <= high) & np.isfinite(column)]
            kept = study.frame.get(RESTS, {}).get(channel.name)
            if not len(inside) and kept is None:
                raise ValueError(
                    f"{where_of(study)}.rest: run {run.name} has no sample of {channel.name} "
                    f"from {low:g} to {high:g} s; where the run begins later, state it: "
                    f"`setup: {{rest_{channel.name}: ...}}`"
                )
            out[f"rest_{channel.name}"] = float(inside.mean()) if len(inside) else float(kept)
    return out


def rests_of(study: Study, rest: Rest | None) -> dict[str, float]:
    """Means at rest of the channels in which all runs rest at the same reading, by name.

    Those that the study's frame holds, if it has one.
    """
    if rest is None or RESTS in study.frame:
        return dict(study.frame.get(RESTS, {}))
    found = {}
    for i, channel in enumerate(study.channels):
        name = f"rest_{channel.name}"
        means = [({**facts_of(r), **data_values(study, r, rest)})[name] for r in study.runs]
        seen = [r.measured[np.isfinite(r.measured[:, i]), i] for r in study.runs]
        width = max((float(np.ptp(values)) for values in seen if len(values)), default=0.0)
        if np.ptp(means) <= ALIKE * width:
            found[channel.name] = float(np.mean(means))
    return found


def _evaluate_fact(formula: str, run: Run) -> float:
    facts = facts_of(run)
    values = {k: torch.tensor(v, dtype=torch.float64) for k, v in facts.items()}
    return float(parse_expression(formula, facts)(values))


def scalars(values: Mapping[str, float]) -> dict[str, Tensor]:
    """The same numbers as tensors (), which may be kept for a gradient whoever asks first."""
    with torch.inference_mode(False):
        return {k: torch.tensor(v, dtype=torch.float64) for k, v in values.items()}


class Reader:
    """Parses formulas of a description; mistakes are collected with their place in the file.

    Args:
        study: Study with the description as its ``model``.
    """

    def __init__(self, study: Study):
        self.study = study
        self.problems: list[Problem] = []

    def report(self, key: str, message: str, severity: str = "error") -> None:
        """Add a mistake at a key such as "rates.v", or what was taken for granted ("note")."""
        self.problems.append(Problem(severity, f"{where_of(self.study)}.{key}", message))

    def parse(self, key: str, text: str, known: Iterable[str]) -> Expression:
        """The formula; that of zero where it is mistaken."""
        known = tuple(known)
        try:
            return parse_expression(text, known)
        except ValueError as error:
            self.report(key, f"{error}{self._find_unstated_facts(text, known)}")
            return parse_expression("0")

    def _find_unstated_facts(self, text: str, known: Iterable[str]) -> str:
        """Facts that a formula names and that are no numbers in all runs, as the end of a message.

        It is said of the first one; may be empty.
        """
        runs = self.study.runs
        for name in sorted(set(re.findall(r"[A-Za-z_]\w*", text)) - set(known)):
            if name in {c.name for c in self.study.channels}:
                return f"; {name} is a channel: write what its reading is made of"
            stated = [run for run in runs if name in run.setup]
            for run in stated:
                if isinstance(run.setup[name], str):
                    return (
                        f"; setup of run {run.name} states {name} as text, {run.setup[name]!r}: "
                        "write a number, or with its unit {value: 3, unit: mm}"
                    )
            if stated and len(stated) < len(runs):
                lacks = next(run.name for run in runs if name not in run.setup)
                return f"; setup of run {lacks} does not state {name}"
        return ""

    def require_names(self, groups: Mapping[str, Iterable[str]]) -> None:
        """Names must be plain words, and one thing each.

        Args:
            groups: Names by the key that gives them.
        """
        given: dict[str, str] = {}
        for key, names in groups.items():
            for name in names:
                if not name.isidentifier():
                    self.report(key, f"{name!r} cannot stand in a formula; use letters, digits, _")
                elif name in _RESERVED:
                    self.report(key, f"{name!r} has a meaning of its own in formulas; rename it")
                elif name in given:
                    self.report(key, f"{name!r} is also a name of {given[name]}; names must differ")
                given.setdefault(name, key)

    def require_channels(self, keys: FormulaKeys) -> None:
        """Every channel has a reading, every reading a channel."""
        channels = [c.name for c in self.study.channels]
        for name in keys.readings:
            if name not in channels:
                self.report(
                    f"readings.{name}",
                    f"no channel {name!r}{did_you_mean(name, channels)}; "
                    f"the study has {', '.join(channels)}",
                )
        for name, (low, high) in keys.ranges.items():
            if name not in channels:
                self.report(f"ranges.{name}", f"no channel {name!r}{did_you_mean(name, channels)}")
            elif not low < high:
                self.report(f"ranges.{name}", f"{low:g} is not below {high:g}")
        for name in channels:
            if name not in keys.readings:
                self.report("readings", f"channel {name} has no formula; add `{name}: ...`")

    def require_per(self, key: str, per: str | None) -> None:
        """``per`` names a fact that every run states."""
        if per is None or per == "run":
            return
        for run in self.study.runs:
            if per not in run.setup:
                hint = did_you_mean(per, [str(k) for k in run.setup])
                self.report(key, f"per: run {run.name} states no {per} in its setup{hint}")
                return

    @property
    def has_errors(self) -> bool:
        """Whether anything reported makes the description unusable."""
        return any(p.severity == "error" for p in self.problems)

    def finish(self) -> None:
        """Raise what was collected.

        Raises:
            ValueError: a line for each mistake.
        """
        errors = [p for p in self.problems if p.severity == "error"]
        if errors:
            raise ValueError("\n".join(f"{p.where}: {p.message}" for p in errors))


def longest(runs: Iterable[Run]) -> float:
    """Duration of the longest run [s]."""
    return max((float(r.time_s[-1] - r.time_s[0]) for r in runs), default=math.nan)
