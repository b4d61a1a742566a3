"""Causes in the cameras that watch a soft body, and in their clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from diffsim.causes import readings as instrument
from diffsim.core.rotation import matrix_from_rotation_vector
from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.soft_body.scene import SoftScene


def _clock_offset(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    return scene.changed(clock_offset=scene.clock_offset + size[0])


def _clock_rate(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    return scene.changed(time_scale=scene.time_scale * (1.0 + size[0]))


def _sensor_scale(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    return scene.with_output(lambda y, t: y * (1.0 + size[0]))


def _placement(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    axes = list(scene.axes)
    return scene.with_output(lambda y, t: y + size[axes])


def _sensor_tilt(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    if scene.rest_places is None:
        cross = torch.linalg.cross
        return _on_points(scene, "sensor_tilt", lambda u: u + cross(size.expand_as(u), u))
    return _on_points(scene, "sensor_tilt", lambda u: u @ matrix_from_rotation_vector(size).T)


def _lens(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    return _on_points(scene, "lens", lambda u: u * (1.0 + size[0] * (u * u).sum(-1, keepdim=True)))


def _on_points(scene: SoftScene, effect: str, change: Callable[[Tensor], Tensor]) -> SoftScene:
    """Change displacements (num_samples, num_points, 3): of markers, else of the channels."""
    rest = scene.rest_places
    if rest is None:
        _require_triples(scene, effect)
        return scene.with_output(lambda y, t: change(_triples(y)).reshape(y.shape))
    return scene.with_places(lambda y, t: rest + change(_triples(y - rest)).reshape(y.shape))


def _triples(y: Tensor) -> Tensor:
    return y.reshape(len(y), -1, 3)


def _require_triples(scene: SoftScene, effect: str) -> None:
    if scene.axes != (0, 1, 2) * (len(scene.axes) // 3):
        raise ValueError(
            f"{effect} needs channels in triples x, y, z, got the axes {scene.axes}; leave it out "
            "of the library or give all three"
        )


CLOCK_OFFSET = Effect(
    name="delay",
    form="The record is late by size: what it shows at t happened at t - size.",
    family="timing",
    kind="sensor",
    unit="s",
    typical=0.02,
    also_looks_like=("delay of the command, exactly", "lag at low frequency"),
    apply=_clock_offset,
)
CLOCK_RATE = Effect(
    name="clock_rate",
    form="The record misses a share of time: its seconds are (1 + size) true ones.",
    family="timing",
    kind="sensor",
    unit="-",
    shown_unit="%",
    typical=0.01,
    also_looks_like=("dropped frames", "wrong frame rate", "Young's modulus, in free swing"),
    apply=_clock_rate,
)
SENSOR_SCALE = replace(instrument.SENSOR_SCALE, typical=0.02, apply=_sensor_scale)
PLACEMENT = Effect(
    name="placement",
    form="Everything measured is displaced by size, per axis of space.",
    family="sensor",
    kind="sensor",
    unit="m",
    typical=0.001,
    components=("x", "y", "z"),
    also_looks_like=("wrong origin", "drift of the held state"),
    apply=_placement,
)
SENSOR_TILT = Effect(
    name="sensor_tilt",
    form="Measured in axes that are turned by size, a small rotation vector.",
    family="sensor",
    kind="sensor",
    unit="rad",
    typical=0.02,
    components=("x", "y", "z"),
    also_looks_like=("tilted camera or calibration square",),
    apply=_sensor_tilt,
)
LENS = Effect(
    name="lens",
    form="Radial distortion y (1 + size |y|^2) of each point about the origin of the channels.",
    family="sensor",
    kind="sensor",
    unit="1/m^2",
    typical=20.0,
    also_looks_like=("stiffening", "perspective"),
    apply=_lens,
)

SENSOR: tuple[Effect, ...] = (
    CLOCK_OFFSET,
    CLOCK_RATE,
    SENSOR_SCALE,
    PLACEMENT,
    SENSOR_TILT,
    LENS,
)
