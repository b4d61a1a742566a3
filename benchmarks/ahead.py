"""Errors of a flight model 1 to 50 samples ahead, from every sample of a recording.

The rule of the nano-drone benchmark (Busetto et al., Control Engineering Practice 172 (2026)
106871): from the recorded state at a sample the model flies under the recorded commands; the mean
length of the error over all starts is summed over the number of samples ahead.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.core.errors import DiffsimError
from diffsim.core.rotation import (
    matrix_from_quaternion,
    quaternion_from_rotation_vector,
    rpy_from_matrix,
)
from diffsim.data.study import Run
from diffsim.identify.extended import ExtendedModel
from diffsim.systems.multicopter.flight import CopterFlight
from diffsim.systems.multicopter.flying import Flyer
from diffsim.systems.multicopter.shooting import Windows

AHEAD = 50
_CHUNK = 1500  # starts that are flown at once
# Errors of an estimator over those of a steady swing, on average over the kinds of the fit flights:
# 0.60 (square), 0.86 (random), 0.89 (multisine); python -m studies.nano_drone_estimator.
SWING_SHARE = 0.78
COLUMNS = ("p", "v", "R", "rates")


@dataclass(frozen=True, eq=False)
class Record:
    """What the rule compares, world z up, body x ahead and y left.

    Attributes:
        position, velocity, rates: (..., 3) [m], [m/s], [rad/s].
        quaternion: World from body, (w, x, y, z), (..., 4), of unit length.
    """

    position: Tensor
    velocity: Tensor
    quaternion: Tensor
    rates: Tensor

    @classmethod
    def of(cls, channels: Tensor) -> Record:
        """From 13 channels in the order position, velocity, quaternion, rates, (..., 13)."""
        position, velocity, quaternion, rates = channels.split((3, 3, 4, 3), -1)
        unit = quaternion / quaternion.norm(dim=-1, keepdim=True)
        return cls(position, velocity, unit, rates)

    def after(self, starts: Tensor) -> Record:
        """What followed each start, (num_starts, AHEAD, ...)."""
        rows = starts[:, None] + torch.arange(1, AHEAD + 1)
        return Record(*(v[rows] for v in self.parts))

    def at(self, rows: Tensor) -> Record:
        """Some rows."""
        return Record(*(v[rows] for v in self.parts))

    @property
    def parts(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """All four, in the order of ``COLUMNS``."""
        return self.position, self.velocity, self.quaternion, self.rates


Predict = Callable[[Tensor], Record]


class Scores(NamedTuple):
    """Errors of several predictions over the starts that all of them can fly.

    Attributes:
        errors: Mean error by the number of samples ahead, (AHEAD, 4) each, by name.
        failed: Starts that a prediction cannot fly, by its name; only those with any.
        num_starts: Starts that were asked for.
    """

    errors: dict[str, Tensor]
    failed: dict[str, int]
    num_starts: int


def compared(
    predictions: Mapping[str, Predict],
    truth: Record,
    every: int = 1,
    starts: Tensor | None = None,
) -> Scores:
    """Errors over starts that every prediction can fly: a start that one of them fails is left out
    of all, and counted.

    Args:
        predictions: Functions of starts (num_starts,): what follows them, (num_starts, AHEAD, ...).
        truth: Recording, (num_samples, ...).
        every: Samples from start to start; 1 is the rule.
        starts: Samples to start from, in place of these.

    Raises:
        DiffsimError: no start can be flown by all.
    """
    chosen = torch.arange(0, len(truth.position) - AHEAD, every) if starts is None else starts
    total = {name: torch.zeros(AHEAD, 4, dtype=torch.float64) for name in predictions}
    failed, count = dict.fromkeys(predictions, 0), 0
    for some in chosen.split(_CHUNK):
        found = {name: _errors_from(p, truth, some) for name, p in predictions.items()}
        flies = {name: torch.isfinite(e).all(-1).all(-1) for name, e in found.items()}
        by_all = torch.stack(list(flies.values())).all(0)
        count += int(by_all.sum())
        for name, errors in found.items():
            total[name] += errors[by_all].sum(0)
            failed[name] += int((~flies[name]).sum())
    if not count:
        raise DiffsimError("no start can be flown by all models; look at their sizes")
    means = {name: value / count for name, value in total.items()}
    return Scores(means, {name: n for name, n in failed.items() if n}, len(chosen))


def errors_ahead(predict: Predict, truth: Record, every: int = 1) -> Tensor:
    """Mean error by the number of samples ahead, (AHEAD, 4) in the order of ``COLUMNS``; arguments
    as of ``compared``."""
    return compared({"": predict}, truth, every).errors[""]


def _errors_from(predict: Predict, truth: Record, starts: Tensor) -> Tensor:
    """Errors after each start, (num_starts, AHEAD, 4); NaN of those that cannot be flown.

    One start ends the flight of all that are flown with it: they are halved until it is alone.
    """
    try:
        return _lengths(predict(starts), truth.after(starts))
    except DiffsimError:
        if len(starts) == 1:
            return torch.full((1, AHEAD, 4), torch.nan, dtype=torch.float64)
        half = len(starts) // 2
        return torch.cat(
            [_errors_from(predict, truth, s) for s in starts.split([half, len(starts) - half])]
        )


def _lengths(a: Record, b: Record) -> Tensor:
    """(num_starts, AHEAD, 4)."""
    # the angle between attitudes by the chord, exact for small ones, too
    sign = (a.quaternion * b.quaternion).sum(-1, keepdim=True).sign()
    chord = (a.quaternion - sign * b.quaternion).norm(dim=-1)
    angle = 4.0 * (0.5 * chord).clamp(max=1.0).asin()
    return torch.stack(
        [
            (a.position - b.position).norm(dim=-1),
            (a.velocity - b.velocity).norm(dim=-1),
            angle,
            (a.rates - b.rates).norm(dim=-1),
        ],
        -1,
    )


def naive(truth: Record) -> Predict:
    """Everything stays as it is."""
    return lambda starts: Record(*(v[starts][:, None].expand(-1, AHEAD, -1) for v in truth.parts))


def flown(
    model: ExtendedModel, run: Run, q: Tensor | None = None, *, is_past_known: bool = True
) -> Predict:
    """Flights of a described multicopter from the recorded states.

    Args:
        model: Plain or extended model of a multicopter whose channels are those of ``Record``.
        run: Recorded run; nothing is fitted to it.
        q: Standardized parameters; None: in the middle of the priors.
        is_past_known: Whether errors of an estimator follow from the record until each start; else
            from the state at the start alone.
    """
    scene = model.scene(run, model.at_prior() if q is None else q)
    assert isinstance(scene, CopterFlight)
    flights = model.inner.flights  # type: ignore[attr-defined]
    states = flights.cutter.record(run).states.clone()
    frames = scene.frames
    channels = torch.as_tensor(run.measured, dtype=torch.float64)
    shown = matrix_from_quaternion(Record.of(channels).quaternion)
    offset = matrix_from_quaternion(quaternion_from_rotation_vector(-scene.attitude_offset[:1]))
    states[:, 3:6] = rpy_from_matrix(frames.rotation(shown @ offset))
    states[:, 9:12] = frames.in_body(channels[:, 10:13] - scene.body_rates_offset)
    scale = scene.position_scale[:1] * scene.ground_scale[:1]
    states[:, :2] /= scale  # the place that was shown, not the true one, is recorded
    states[:, 2] /= scene.position_scale[0]
    blind = scene.estimator
    if blind is not None:
        if not is_past_known:
            recorded = scene.windows.states, scene.force_by_record()
            blind = blind.by_state_alone(*recorded, SWING_SHARE)
            scene = scene.changed(estimator=blind)
        error, turned = blind.errors[0].unbind(-2)
        states[:, 6:9] -= error
        right = matrix_from_quaternion(quaternion_from_rotation_vector(-turned))
        states[:, 3:6] = rpy_from_matrix(right @ frames.rotation(shown @ offset))
    past = scene.commands[:, 0]
    thrusts = scene.delivered(past)[0]
    # delivered at a sample: over the step before it; the last step has none
    thrusts = torch.cat([thrusts, thrusts[-1:]])

    def predict(starts: Tensor) -> Record:
        rows = starts[:, None] + torch.arange(1, AHEAD + 1)
        there = Windows(
            guess=torch.cat([states[starts], past.expand(len(starts), -1)], 1),
            measured=channels[rows],
            sd=torch.ones(channels.shape[1], dtype=torch.float64),
            rows=starts,
        )
        flyer = Flyer(scene.changed(windows=there), 1)
        with torch.no_grad():
            read = flyer.fly_thrusts(states[starts][None], thrusts[rows][None])
        return Record.of(read[0])

    return predict
