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
    quaternion_product,
    rpy_from_matrix,
)
from diffsim.data.study import Run
from diffsim.identify.extended import ExtendedModel
from diffsim.systems.multicopter.effects import torque_allocation
from diffsim.systems.multicopter.scene import CopterScene, Flyer
from diffsim.systems.multicopter.shooting import Windows

AHEAD = 50
DT = 0.01  # of a sample [s]
_CHUNK = 1500  # starts that are flown at once
_SHORT = 5  # steps of a way that tells the balance of the rotors
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

    def at_step(self, step: int) -> Record:
        """One step of flights (num_starts, num_steps, ...)."""
        return Record(*(v[:, step] for v in self.parts))

    @property
    def parts(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """All four, in the order of ``COLUMNS``."""
        return self.position, self.velocity, self.quaternion, self.rates


Predict = Callable[[Tensor], Record]


@dataclass(frozen=True, eq=False)
class Balance:
    """How the flight before a start tells what the rotors give beyond the model.

    The model flies short ways from the recorded states before the start. What it lacks on average
    in angular acceleration, and in acceleration along the thrust, is held as constant thrusts. The
    average is that of the last samples, drawn towards that of the whole flight before.
    """

    flies: Tensor  # samples in flight, (num_samples,) bool: the others tell nothing
    window: int = 100  # samples before a start that are asked
    prior: int = 30  # samples for which the whole flight before counts


class Scores(NamedTuple):
    """Errors of several predictions over the starts that all of them can fly."""

    errors: dict[str, Tensor]  # mean error by the number of samples ahead, (AHEAD, 4) each, by name
    failed: dict[str, int]  # starts that a prediction cannot fly, by its name; only those with any
    num_starts: int  # starts that were asked for


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


def errors_ahead(
    predict: Predict, truth: Record, every: int = 1, starts: Tensor | None = None
) -> Tensor:
    """Mean error by the number of samples ahead, (AHEAD, 4) in the order of ``COLUMNS``; arguments
    as of ``compared``."""
    return compared({"": predict}, truth, every, starts).errors[""]


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


def coasting(truth: Record) -> Predict:
    """Velocity and body rates stay as they are."""

    def predict(starts: Tensor) -> Record:
        p, v, q, w = truth.at(starts).parts
        times = DT * torch.arange(1, AHEAD + 1, dtype=p.dtype)[:, None]
        turned = quaternion_from_rotation_vector(times * w[:, None])
        q = quaternion_product(q[:, None].expand_as(turned), turned)
        velocity, rates = (x[:, None].expand(-1, AHEAD, -1) for x in (v, w))
        return Record(p[:, None] + times * v[:, None], velocity, q, rates)

    return predict


def flown(
    model: ExtendedModel,
    run: Run,
    q: Tensor | None = None,
    *,
    is_past_known: bool = True,
    balance: Balance | None = None,
) -> Predict:
    """Flights of a described multicopter from the recorded states.

    Args:
        model: Plain or extended model of a multicopter whose channels are those of ``Record``.
        run: Recorded run; nothing is fitted to it.
        q: Standardized parameters; None: in the middle of the priors.
        is_past_known: Whether errors of an estimator follow from the record until each start; else
            from the state at the start alone.
        balance: How the record until each start tells the balance of the rotors; None: it does not.
    """
    scene = model.scene(run, model.at_prior() if q is None else q)
    assert isinstance(scene, CopterScene)
    flights = model.inner.flights  # type: ignore[attr-defined]
    states = flights.cutter.record(run).states.clone()
    frames = scene.frames
    channels = torch.as_tensor(run.measured, dtype=torch.float64)
    shown = matrix_from_quaternion(Record.of(channels).quaternion)
    offset = matrix_from_quaternion(
        quaternion_from_rotation_vector(-scene.vector("attitude_offset")[:1])
    )
    states[:, 3:6] = rpy_from_matrix(frames.rotation(shown @ offset))
    states[:, 9:12] = frames.in_body(channels[:, 10:13] - scene.vector("body_rates_offset"))
    scale = scene.scalar("position_scale")[:1] * scene.scalar("ground_scale")[:1]
    states[:, :2] /= scale  # the place that was shown, not the true one, is recorded
    states[:, 2] /= scene.scalar("position_scale")[0]
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
    past = scene.commands.values[..., 0]
    thrusts = scene.delivered(past)[0]
    # delivered at a sample: over the step before it; the last step has none
    thrusts = torch.cat([thrusts, thrusts[-1:]])

    def fly(starts: Tensor, steps: int, more: Tensor) -> Record:
        """Flights of some steps under the recorded commands and thrusts ``more`` beside them."""
        rows = starts[:, None] + torch.arange(1, steps + 1)
        there = Windows(
            guess=torch.cat([states[starts], past.expand(len(starts), -1)], 1),
            measured=channels[rows],
            sd=torch.ones(channels.shape[1], dtype=torch.float64),
            rows=starts,
        )
        flyer = Flyer(scene.changed(windows=there), 1)
        with torch.no_grad():
            # below zero, too: they stand for torques
            given = thrusts[rows] + more[:, None]
            read = flyer.fly_thrusts(states[starts][None], given[None])
        return Record.of(read[0])

    none = thrusts.new_zeros(len(thrusts), thrusts.shape[1])
    more = none
    if balance is not None:
        more = _lacking(scene, Record.of(channels), balance, lambda s: fly(s, _SHORT, none[s]))
    return lambda starts: fly(starts, AHEAD, more[starts])


def _lacking(scene: CopterScene, truth: Record, balance: Balance, fly: Predict) -> Tensor:
    """Thrusts that the flight before each sample asks for beside the model's, (num_samples,
    n_rotors) [N]."""
    vehicle, frames, seconds = scene.vehicle, scene.frames, _SHORT * scene.dt
    last = len(balance.flies) - _SHORT
    flies = balance.flies.unfold(0, _SHORT + 1, 1).all(-1)[:last]
    rows = flies.nonzero().squeeze(-1)
    got = fly(rows).at_step(-1)
    want = truth.at(rows + _SHORT)
    turning = frames.in_body(want.rates - got.rates) / seconds
    rotation = matrix_from_quaternion(truth.at(rows).quaternion)
    up = rotation[..., 2] if frames.body == "FLU" else -rotation[..., 2]
    lift = ((want.velocity - got.velocity) * up).sum(-1) / seconds
    torque = turning @ vehicle.inertia[0].mT
    push = vehicle.mass[0] * lift / vehicle.num_rotors
    shares = torque @ torque_allocation(vehicle)[0].mT + push[:, None]
    # of the ways that end at a sample or before, and begin within the window or at all
    whole = shares.new_zeros(last, shares.shape[1])
    whole[rows] = shares
    sums, counts = (
        torch.cat([v.new_zeros(1, *v.shape[1:]), v.cumsum(0)]) for v in (whole, flies.double())
    )
    samples = torch.arange(len(balance.flies))
    ends = (samples - _SHORT + 1).clamp(0, last)
    begins = torch.minimum((samples - balance.window).clamp(0, last), ends)
    usual = sums[ends] / counts[ends].clamp(min=1.0)[:, None]
    told = (counts[ends] - counts[begins])[:, None]
    total = sums[ends] - sums[begins] + balance.prior * usual
    return total / (told + balance.prior).clamp(min=1.0)
