"""A frozen model on runs that it has not seen: errors in the recordings' unit, gain, distance.

Nothing is fitted to these runs but what the study declares unknown for each of them ("offset@run"),
for the plain and the extended model alike.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim.core.errors import DiffsimError
from diffsim.core.units import factor
from diffsim.data.study import Channel, Command, Run
from diffsim.diagnose.checks.noise import without_spikes
from diffsim.diagnose.judge.gain import Gain, compared
from diffsim.diagnose.judge.outside import Span, outside_rows
from diffsim.diagnose.judge.own_values import Frozen, held_out_point, own_names
from diffsim.diagnose.judge.records import ErrorRow, OutsideRow

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Unseen:
    """A model and its extension on runs that no fit has seen.

    Attributes:
        runs: Names of the runs.
        errors: Error before and after by run and kind of channel.
        gain: Share of the error above the noise that is removed, over all runs; None without any.
        gains: The same by run.
        outside: Where the runs lie outside of what was fitted.
        num_spikes: Samples that were left out as spikes, for both models.
        failed: Runs that a model cannot simulate, with why; nothing is known of a gain then.
        predicted: By run, what plain and extended model say of it, with the run's own values
            fitted, each (num_samples, num_channels) [unit of the channel].
    """

    runs: tuple[str, ...]
    errors: tuple[ErrorRow, ...]
    gain: Gain | None
    gains: Mapping[str, Gain]
    outside: tuple[OutsideRow, ...]
    num_spikes: int = 0
    failed: Mapping[str, str] = field(default_factory=dict)
    predicted: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Content of ``judge.json``."""
        return {
            "runs": list(self.runs),
            "errors": [asdict(row) for row in self.errors],
            "gain": None if self.gain is None else gain_to_dict(self.gain),
            "gains": {name: gain_to_dict(g) for name, g in self.gains.items()},
            "outside": [asdict(row) for row in self.outside],
            "num_spikes": self.num_spikes,
            "failed": dict(self.failed),
        }


def gain_to_dict(gain: Gain) -> dict[str, Any]:
    """A gain with its status, in types that JSON has."""
    return {**asdict(gain), "status": gain.status}


def on_unseen(
    plain: Frozen,
    extended: Frozen,
    runs: Sequence[Run],
    channels: Sequence[Channel],
    sd: Array,
    spans: Mapping[str, Span],
    *,
    seed: int,
    use: str = "test",
    commands: Sequence[Command] = (),
    unmet: Collection[str] = (),
) -> Unseen:
    """Judge a model and its extension on runs; each at its own coordinates, which stay.

    Args:
        plain: Plain model at its own fit.
        extended: Extended model at its fit; the plain one where nothing was named.
        runs: Runs that no fit has seen.
        channels: Columns of their ``measured``.
        sd: Standard deviation of the noise, (num_channels,) [unit of the channel].
        spans: What the fitted runs covered, as ``spans_of`` returns it.
        seed: Seed of the bootstraps.
        use: What the runs are for, as the rows say it.
        commands: What is known of commands: their units.
        unmet: Parameters of facts that no fitted run has: a run with such a fact tells its own.
    """
    errors: list[ErrorRow] = []
    failed: dict[str, str] = {}
    predicted: dict[str, tuple[Array, Array]] = {}
    cleaned, before, after, num_spikes = [], [], [], 0
    for given in runs:
        try:
            run, count = _without_spikes((plain, extended), given)
            points = [_alone(frozen, run, unmet) for frozen in (plain, extended)]
            said = (_predicted(points[0], run), _predicted(points[1], run))
            whitened = [point.problem.residual(point.x) for point in points]
        except DiffsimError as error:  # of one run: the answer to all others stands
            failed[given.name] = str(error)
            continue
        num_spikes += count
        left = [run.measured - prediction for prediction in said]
        errors += _error_rows(run, left, channels, sd, _num_own(extended, run, unmet), use)
        predicted[run.name] = said
        before.append(whitened[0])
        after.append(whitened[1])
        cleaned.append(run)
    gains = {
        run.name: compared([run], plain, [b], [a], seed=seed)
        for run, b, a in zip(cleaned, before, after, strict=True)
    }
    return Unseen(
        runs=tuple(run.name for run in runs),
        errors=tuple(errors),
        # a gain without the runs that fail would be one over chosen runs
        gain=compared(cleaned, plain, before, after, seed=seed) if cleaned and not failed else None,
        gains=gains,
        outside=outside_rows(cleaned, channels, spans, commands),
        num_spikes=num_spikes,
        failed=failed,
        predicted=predicted,
    )


@dataclass(frozen=True, eq=False)
class At:
    """A problem at a point that is not fitted any more."""

    problem: Any
    x: Array


def shown_unit(channel: Channel) -> tuple[str, float]:
    """Unit of the recordings' file, and what one SI unit is in it."""
    unit = channel.shown_unit or channel.unit
    return (unit, 1.0) if unit == channel.unit else (unit, factor(channel.unit, unit))


def _alone(frozen: Frozen, run: Run, unmet: Collection[str]) -> At:
    """A model on one run, with the values that are the run's own fitted to it."""
    return At(replace(frozen.problem, runs=(run,)), held_out_point(frozen, run, unmet))


def _predicted(frozen: Frozen, run: Run) -> Array:
    """What a model says of a run, (num_samples, num_channels) [unit of the channel]."""
    with torch.no_grad():
        return np.asarray(frozen.problem.predict(run, torch.from_numpy(frozen.x)).numpy())


def _without_spikes(models: Sequence[Frozen], run: Run) -> tuple[Run, int]:
    """The run without isolated spikes; a spike is one in the record itself and to every model."""
    is_spike = np.isfinite(run.measured)
    left = (run.measured - _predicted(frozen, run) for frozen in models)
    for record in (run.measured, *left):
        cleaned, _ = without_spikes(run, record)
        is_spike &= ~np.isfinite(cleaned.measured)
    count = int(is_spike.sum())
    measured = np.where(is_spike, np.nan, run.measured)
    return (replace(run, measured=measured), count) if count else (run, 0)


def _num_own(frozen: Frozen, run: Run, unmet: Collection[str]) -> int:
    """Values that are fitted to one run: what the study declares unknown, and start states that a
    model fits away."""
    declared = len(own_names(frozen.problem.names, run, unmet))
    inside = getattr(frozen.problem.model, "num_fitted_inside", None)
    return declared + (int(inside(run)) if callable(inside) else 0)


def _error_rows(
    run: Run,
    left: Sequence[Array],
    channels: Sequence[Channel],
    sd: Array,
    num_fitted: int,
    use: str,
) -> list[ErrorRow]:
    """One row by kind and unit of the channels."""
    members: dict[tuple[str, str], list[int]] = {}
    for c, channel in enumerate(channels):
        members.setdefault((channel.kind, shown_unit(channel)[0]), []).append(c)
    rows = []
    for (kind, unit), own in members.items():
        scale = np.array([shown_unit(channels[c])[1] for c in own])
        valid = np.isfinite(run.measured[:, own])
        count = int(valid.sum())
        if not count:
            continue
        before, after = (_rms((x[:, own] * scale)[valid]) for x in left)
        noise = _rms(np.broadcast_to(sd[own] * scale, valid.shape)[valid])
        rows.append(ErrorRow(run.name, kind, unit, before, after, noise, count, num_fitted, use))
    return rows


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
