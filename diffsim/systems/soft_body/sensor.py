"""Causes in the cameras that watch a soft body, and in their clock."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.soft_body.scene import SoftScene


class ClockOffset(Effect):
    """The record is late by size: what it shows at t happened at t - size.

    With a command this is the same as a delay of the actuators, to the last digit.
    """

    name, family, kind, unit, typical = "delay", "timing", "sensor", "s", 0.02
    also_looks_like = ("delay of the command, exactly", "lag at low frequency")

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        return scene.changed(clock_offset=scene.clock_offset + size[0])


class ClockRate(Effect):
    """The record misses a share of time: its seconds are (1 + size) true ones."""

    name, family, kind, unit, typical = "clock_rate", "timing", "sensor", "-", 0.01
    also_looks_like = ("dropped frames", "wrong frame rate", "Young's modulus, in free swing")

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        return scene.changed(time_scale=scene.time_scale * (1.0 + size[0]))


class SensorScale(Effect):
    """Everything measured is larger by the share size."""

    name, family, kind, unit, typical = "sensor_scale", "sensor", "sensor", "-", 0.02
    also_looks_like = ("gain of the actuator", "scale of the calibration")

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        return scene.with_output(lambda y, t: y * (1.0 + size[0]))


class Placement(Effect):
    """Everything measured is displaced by size, per axis of space."""

    name, family, kind, unit, typical = "placement", "sensor", "sensor", "m", 1e-3
    components = ("x", "y", "z")
    also_looks_like = ("wrong origin", "drift of the held state")

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        axes = list(scene.axes)
        return scene.with_output(lambda y, t: y + size[axes])


class SensorTilt(Effect):
    """Measured in axes that are turned by size, a small rotation vector.

    Needs channels in triples x, y, z.
    """

    name, family, kind, unit, typical = "sensor_tilt", "sensor", "sensor", "rad", 0.02
    components = ("x", "y", "z")
    also_looks_like = ("tilted camera or calibration square",)

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        _require_triples(scene, self.name)

        def turned(y: Tensor, t: Tensor) -> Tensor:
            points = y.reshape(y.shape[0], -1, 3)
            return (points + torch.linalg.cross(size.expand_as(points), points)).reshape(y.shape)

        return scene.with_output(turned)


class Lens(Effect):
    """Radial distortion y (1 + size |y|^2) of each point about the origin of the channels."""

    name, family, kind, unit, typical = "lens", "sensor", "sensor", "1/m^2", 20.0
    also_looks_like = ("stiffening", "perspective")

    def apply(self, scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
        _require_triples(scene, self.name)

        def distorted(y: Tensor, t: Tensor) -> Tensor:
            points = y.reshape(y.shape[0], -1, 3)
            radius = (points * points).sum(-1, keepdim=True)
            return (points * (1.0 + size[0] * radius)).reshape(y.shape)

        return scene.with_output(distorted)


def _require_triples(scene: SoftScene, effect: str) -> None:
    if scene.axes != (0, 1, 2) * (len(scene.axes) // 3):
        raise ValueError(
            f"{effect} needs channels in triples x, y, z, got the axes {scene.axes}; leave it out "
            "of the library or give all three"
        )


SENSOR: tuple[Callable[[], Effect], ...] = (
    ClockOffset,
    ClockRate,
    SensorScale,
    Placement,
    SensorTilt,
    Lens,
)
