"""Columns in another unit, or exchanged: only a model can tell, and is asked where it is far off.

The model simulates the beginning of some runs at its priors, as they are and with a column changed.
A column is at fault where that alone brings the model from far off to near, and where its numbers,
moved as far as they may, do not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, islice, product

import numpy as np
import torch

from diffsim.core.arrays import Array
from diffsim.core.unit_slips import UNIT_SLIPS
from diffsim.data.study import Run, Study
from diffsim.data.study_check import Problem
from diffsim.diagnose.checks.one_run import NUDGE, run_problems
from diffsim.diagnose.checks.starts import start_problems
from diffsim.identify.model import SimModel
from diffsim.identify.ranges import SURE_SD
from diffsim.identify.setup import DiagnosisSetup

RULE = "columns"
FAR_SHARE = 0.5  # of the squares of a channel, that the model leaves where it is far off
NEAR_SHARE = 0.02  # of them, that it leaves with the right unit: a gain of that size is rare
NEAR_HINTED = 0.15  # likewise where two channels come near at once, or a unit counts no turns
RUNS, ROWS = 2, 600  # that are simulated, of the beginning
FORMULAS = ("ode", "bench")  # systems of which a simulation is a moment's work


@dataclass(frozen=True)
class _Way:
    """A record with some columns changed: scaled, or one in place of the other."""

    where: str
    says: str
    remedy: str
    scale: float
    names: tuple[str, ...]
    # share of the squares of a channel that it leaves where it is the fault
    near: float = NEAR_SHARE

    def of(self, run: Run, channels: Sequence[str]) -> Run:
        """The run with its columns as they should be."""
        signals = {**run.command, **dict(zip(channels, run.measured.T, strict=True))}
        changed = dict(zip(self.names, reversed([signals[n] for n in self.names]), strict=True))
        signals |= {name: self.scale * values for name, values in changed.items()}
        measured = np.stack([signals[name] for name in channels], axis=1)
        return replace(
            run, command={name: signals[name] for name in run.command}, measured=measured
        )


def model_problems(study: Study, setup: DiagnosisSetup) -> list[Problem]:
    """Faults of a record that only its model can tell: of columns, of single runs, of where they
    begin; the first kind that is found.
    """
    for ask in (column_problems, run_problems, start_problems):
        if found := [*ask(study, setup)]:
            return found
    return []


def column_problems(study: Study, setup: DiagnosisSetup) -> Iterator[Problem]:
    """Columns in another unit, or exchanged, as whole-record rows.

    Args:
        study: Study with the description; only systems of formulas are asked.
    """
    if (study.model or {}).get("system") not in FORMULAS:
        return
    runs = [run.part(slice(ROWS)) for run in study.fit_runs if len(run.time_s) > 2][:RUNS]
    model, q = setup.model, setup.model.at_prior()
    plain = _PlainModel(model, study, runs)
    if not runs or not (plain.left(q, runs) > FAR_SHARE).any():
        return
    names = [channel.name for channel in study.channels]
    found = []
    for way in islice(_ways(study, runs), 300):
        left = plain.left(q, [way.of(run, names) for run in runs]).max()
        if left <= way.near:
            found.append((float(left), way))
    if not found or plain.numbers_explain(q):
        return
    found.sort(key=lambda pair: pair[0])
    best, first = found[0]
    # what leaves at most three times as much explains as much
    twins = [way for left, way in found[1:] if left <= 3.0 * max(best, 1e-3)]
    beside = f" (as well: {'; '.join(way.says for way in twins[:2])})" if twins else ""
    yield Problem("error", first.where, f"{first.says}{beside}: {first.remedy}", RULE)


@dataclass(frozen=True)
class _PlainModel:
    """The plain model, asked how much of the squares of each channel it leaves."""

    model: SimModel
    study: Study
    runs: Sequence[Run]

    def left(self, q: torch.Tensor, runs: Sequence[Run]) -> Array:
        """Share that is left of each channel, (num_channels,); inf where there is no number.

        Args:
            q: Standardized base parameters.
            runs: Parts of runs, as recorded or changed.
        """
        with torch.no_grad():
            predicted = [self.model.predict(run, q).numpy() for run in runs]
        out = []
        for i in range(len(self.study.channels)):
            y = np.concatenate([run.measured[:, i] for run in runs])
            off = y - np.concatenate([p[:, i] for p in predicted])
            seen = np.isfinite(y)
            total = float(np.var(y[seen])) if seen.any() else 0.0
            share = float(np.mean(off[seen] ** 2)) / total if total > 0.0 else 0.0
            out.append(share if np.isfinite(share) else np.inf)
        return np.array(out)

    def numbers_explain(self, q: torch.Tensor) -> bool:
        """Whether the numbers of the model, moved as far as they may, bring it to half the way:
        three steps of Gauss and Newton, each held within ``SURE_SD``."""
        at, which = q.clone(), range(min(len(q), 40))  # numbers that are moved
        measured = np.concatenate([run.measured for run in self.runs])
        weight = 1.0 / np.maximum(np.nanstd(measured, axis=0), 1e-300)
        seen = np.isfinite(measured)
        for _ in range(3 if len(which) else 0):
            plain, ways = self._predict(at), []
            for k in which:
                moved = at.clone()
                moved[k] += NUDGE
                ways.append(((self._predict(moved) - plain) * weight)[seen] / NUDGE)
            off = ((measured - plain) * weight)[seen]
            if not (np.isfinite(off).all() and np.isfinite(ways).all()):
                return False
            step = torch.zeros_like(q)
            found = np.linalg.lstsq(np.stack(ways, axis=1), off, rcond=None)[0]
            step[: len(which)] = torch.from_numpy(found)
            # of a step: the nearest is taken
            tried = [
                (at + share * step).clamp(q - SURE_SD, q + SURE_SD)
                for share in (1.0, 0.3, 0.1, 0.03)
            ]
            at = min(tried, key=lambda x: float(self.left(x, self.runs).max()))
            if not (self.left(at, self.runs) > FAR_SHARE).any():
                return True
        return False

    def _predict(self, q: torch.Tensor) -> Array:
        with torch.no_grad():
            return np.concatenate([self.model.predict(run, q).numpy() for run in self.runs])


def _reads_a_turn(study: Study, channel: str) -> bool:
    """Whether a channel reads, as it is, how fast a place turns on which torques act."""
    model = study.model or {}
    read = str((model.get("readings") or {}).get(channel, "")).strip()
    turning = (
        place.get("velocity")
        for place in model.get("places") or ()
        if str(place.get("unit", "")).startswith("N m") or place.get("position_unit") == "rad"
    )
    return read in turning


def _ways(study: Study, runs: Sequence[Run]) -> Iterator[_Way]:
    """Changes of columns: exchanges first, then units, commands before channels."""
    commands = [n for n, values in runs[0].command.items() if len(values) == len(runs[0].time_s)]
    channels = [channel.name for channel in study.channels]
    for role, names in (("command", commands), ("channel", channels)):
        for a, b in combinations(names, 2):
            yield _Way(
                f"{role} {a}",
                f"its column and that of {role} {b} are exchanged, as the model sees it",
                f"`column:` of {role} {a} names the column of {b}, and the other way round",
                1.0,
                (a, b),
                NEAR_HINTED,
            )
    for channel in study.channels:
        if channel.unit in ("Hz", "1/s") and _reads_a_turn(study, channel.name):
            yield _Way(
                f"channel {channel.name}",
                f"its unit counts no turns: channel {channel.name} times 2 pi is what the model "
                "expects",
                f"`unit: rpm`, or `rev/s`, in channel {channel.name}",
                2.0 * np.pi,
                (channel.name,),
                NEAR_HINTED,
            )
    for slip, (role, names) in product(UNIT_SLIPS, (("command", commands), ("channel", channels))):
        for name, scale in product(names, (1.0 / slip.ratio, slip.ratio)):
            yield _Way(
                f"{role} {name}",
                f"it is in another unit, by {slip.words}: {role} {name} times {scale:.6g} is what "
                "the model expects",
                f"`unit:` of {role} {name} states that of the file, or `scale: {scale:.6g}`",
                scale,
                (name,),
            )
