"""Channels of a study as groups of readings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.core.check import did_you_mean
from diffsim.core.units import factor
from diffsim.data.study import Study
from diffsim.data.study_check import Problem
from diffsim.systems.multicopter.frames import SENSORS
from diffsim.systems.multicopter.keys import SensorKeys

# Key of the description -> group of readings, unit, noise while a channel states none.
_KINDS = {
    "position": ("position", "m", 2e-3),
    "velocity": ("velocity", "m/s", 0.02),
    "roll_pitch_yaw": ("attitude", "rad", 5e-3),
    "quaternion": ("quaternion", "-", 2.5e-3),
    "body_rates": ("body_rates", "rad/s", 1e-2),
    "specific_force": ("accelerometer", "m/s^2", 0.1),
    "specific_force_in_world": ("specific_force_in_world", "m/s^2", 0.1),
    "acceleration": ("acceleration", "m/s^2", 0.1),
}
_ORDERS = {"wxyz": (0, 1, 2, 3), "xyzw": (1, 2, 3, 0)}


@dataclass(frozen=True, eq=False)
class SensorColumns:
    """Which reading each channel of a study is."""

    groups: tuple[str, ...]  # groups of readings, keys of ``SENSORS``
    columns: tuple[int, ...]  # reading of each channel, counted over the groups
    sd: Tensor  # noise of the channels, (num_channels,)


def sensing_of(keys: SensorKeys, study: Study) -> SensorColumns:
    """Readings of a study's channels, all of which the keys name."""
    groups: list[str] = []
    place: dict[str, tuple[int, float]] = {}
    start = 0
    for key, (group, _, sd) in _KINDS.items():
        names = _list_columns(keys, key)
        if not any(names):
            continue
        order = (
            range(len(names))
            if keys.quaternion is None or key != "quaternion"
            else (_ORDERS[keys.quaternion.order])
        )
        for name, entry in zip(names, order, strict=True):
            if name is not None:
                place[name] = start + entry, sd
        groups.append(group)
        start += len(SENSORS[group])
    found = [(place[c.name], c.sd) for c in study.channels]
    return SensorColumns(
        tuple(groups),
        tuple(column for (column, _), _ in found),
        torch.tensor([default if sd is None else sd for (_, default), sd in found]).double(),
    )


def are_means(keys: SensorKeys, study: Study) -> list[bool]:
    """Which channels show the mean over the step before: accelerations do."""
    named = {
        name
        for key in ("specific_force", "specific_force_in_world", "acceleration")
        for name in _list_columns(keys, key)
    }
    return [c.name in named for c in study.channels]


def sensor_problems(keys: SensorKeys, study: Study) -> Iterator[Problem]:
    """Channels that are not there, not named, or of another unit."""
    units = {c.name: c.unit for c in study.channels}
    for key, (_, unit, _) in _KINDS.items():
        for name in _list_columns(keys, key):
            if name is None:
                continue
            where = f"model.sensors.{key}"
            if name not in units:
                yield Problem(
                    "error",
                    where,
                    f"no channel {name!r}{did_you_mean(name, units)}; the study has "
                    f"{', '.join(units)}",
                )
            elif not _is_in_unit(units[name], unit):
                yield Problem(
                    "error",
                    where,
                    f"channel {name} must be in {unit}, the study says {units[name]}",
                )
    for name in units:
        if name not in keys.names:
            yield Problem(
                "error",
                f"channel {name}",
                "model.sensors does not name it; name it there, or take it out of channels",
            )


def _is_in_unit(have: str, want: str) -> bool:
    """Whether numbers of a study are in a unit; studies are in SI units when they are read."""
    try:
        return abs(factor(have, want) - 1.0) < 1e-9
    except ValueError:
        return False


def _list_columns(keys: SensorKeys, key: str) -> tuple[str | None, ...]:
    if key == "quaternion":
        return () if keys.quaternion is None else keys.quaternion.columns
    given: tuple[str | None, ...] | None = getattr(keys, key)
    return given or ()
