"""Causes in single instruments of a flight: a camera that is late, a gyro whose scale is off.

With `sensor` stated, lateness, lag, scale and zero are judged for each sensor. What a vehicle has
without a statement (``sensors``) stays, but for the delay of all cameras together.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from diffsim.causes.channel_groups import channel_groups
from diffsim.causes.readings import named_of, paced, sample_of, sensor_causes
from diffsim.causes.signals import affine_scan
from diffsim.data.study import Channel, Run, Study
from diffsim.identify.effect import Effect
from diffsim.systems.multicopter.cutting import Cutter
from diffsim.systems.multicopter.flight import SENSORS
from diffsim.systems.multicopter.scene import CopterScene, amount

TURNS = ("attitude", "quaternion")  # what has no scale, no zero and no lag by itself
JUDGED = ("sensor_delay", "sensor_lag", "sensor_scale", "sensor_offset")
ALREADY = {  # causes of whole groups that every vehicle has
    "sensor_scale": ("position", "accelerometer"),
    "sensor_offset": ("position", "body_rates", "accelerometer", "acceleration"),
}
USUAL = {"m": 0.05, "m/s": 0.05, "rad/s": 0.02, "m/s^2": 0.1}  # a zero that is no surprise


@dataclass(frozen=True)
class _Judged:
    """A channel, its place among the channels, and the group of readings that it is of."""

    channel: Channel
    place: int
    group: str


def states_sensors(study: Study) -> bool:
    """Whether a channel says which sensor shows it."""
    return any(c.sensor is not None for c in study.channels)


def instrument_effects(
    study: Study, cutter: Cutter, clocks: Sequence[tuple[str, ...]]
) -> list[Effect]:
    """Causes in each stated sensor; none where no channel states one.

    Args:
        study: Study with the recordings.
        cutter: Which reading each channel is.
        clocks: Channels whose lateness is known or a base parameter, sensor by sensor.
    """
    if not states_sensors(study):
        return []
    by_name = {j.channel.name: j for j in _judged(study, cutter)}
    out: list[Effect] = []
    for dial in channel_groups(study.channels, late_record=False):
        if len(dial.channels) == len(by_name):
            continue  # of all channels: the clock of the commands
        own = [by_name[name] for name in dial.channels]
        channels = [j.channel for j in own]
        made = sensor_causes(dial.channels, channels[0].unit, USUAL.get(channels[0].unit, 1.0), 1.0)
        for model, _ in made:
            if model.name not in dial.causes or model.name not in JUDGED:
                continue
            if model.name == "sensor_delay" and dial.channels in clocks:
                continue
            if model.name != "sensor_delay" and any(j.group in TURNS for j in own):
                continue
            if _is_there(model.name, own, by_name.values()):
                continue
            apply = partial(_APPLY[model.name], channels=tuple(j.place for j in own))
            out.append(named_of(model, dial.name, channels, apply))
    return list(paced(out, sample_of(study.runs)))


def _judged(study: Study, cutter: Cutter) -> list[_Judged]:
    groups = [group for group in cutter.sensors for _ in SENSORS[group]]
    columns = range(len(groups)) if cutter.columns is None else cutter.columns
    return [
        _Judged(channel, place, groups[column])
        for place, (channel, column) in enumerate(zip(study.channels, columns, strict=True))
    ]


def _is_there(cause: str, own: Sequence[_Judged], every: Iterable[_Judged]) -> bool:
    """Whether a vehicle has the cause anyway, of the whole group that these channels are."""
    groups = {j.group for j in own}
    if len(groups) != 1 or not groups <= set(ALREADY.get(cause, ())):
        return False
    return all(j in own for j in every if j.group in groups)


def _late(scene: CopterScene, size: Tensor, run: Run, *, channels: tuple[int, ...]) -> CopterScene:
    return scene.with_late(channels, amount(size, 0))


def _lagged(
    scene: CopterScene, size: Tensor, run: Run, *, channels: tuple[int, ...]
) -> CopterScene:
    return scene.with_reading(
        channels, partial(lagged_in_windows, dt=scene.dt, tau=amount(size, 0))
    )


def _scaled(
    scene: CopterScene, size: Tensor, run: Run, *, channels: tuple[int, ...]
) -> CopterScene:
    return scene.with_reading(channels, lambda y: y * (1.0 + amount(size, 3)))


def _shifted(
    scene: CopterScene, size: Tensor, run: Run, *, channels: tuple[int, ...]
) -> CopterScene:
    zero = size.reshape(-1, 1, 1, size.shape[-1])
    return scene.with_reading(channels, lambda y: y + zero)


_APPLY = {
    "sensor_delay": _late,
    "sensor_lag": _lagged,
    "sensor_scale": _scaled,
    "sensor_offset": _shifted,
}


def lagged_in_windows(y: Tensor, *, dt: float, tau: Tensor) -> Tensor:
    """First-order lag of readings in windows, each of which it enters in a steady slope.

    Args:
        y: (points, num_windows, length, width), every ``dt``.
        dt: Time between two samples [s].
        tau: Time constant, (points,) [s].
    """
    if y.shape[2] < 2:
        return y
    tau = tau.reshape(-1, 1, 1, 1)
    decay = torch.exp(-dt / tau.clamp(min=1e-3 * dt))
    u = y.movedim(2, -1)
    target = tau * u.diff(dim=-1) / dt
    begun = target[..., :1]
    # e = u - y': e' = u' - e / tau, from one time to the next target + (e - target) * decay
    driven = affine_scan(decay.expand_as(target), target * (1.0 - decay))
    powers = decay ** torch.arange(1, u.shape[-1], dtype=u.dtype)
    error = torch.cat([begun, driven + begun * powers], -1)
    return (u - error).movedim(-1, 2)


__all__ = ["instrument_effects", "lagged_in_windows", "states_sensors"]
