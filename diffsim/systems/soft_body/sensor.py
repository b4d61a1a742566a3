"""What cameras that watch a soft body do to what they show."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from diffsim.core.rotation import matrix_from_rotation_vector
from diffsim.data.study import Run
from diffsim.systems.soft_body.scene import SoftScene


def displace(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """Everything measured, displaced by ``size``, (3,) [m]."""
    axes = list(scene.axes)
    return scene.with_reading((), lambda y, grid: y + size[axes][:, None])


def tilt_camera(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """Measured in axes that are turned by ``size``, a rotation vector (3,) [rad]."""
    if scene.rest_places is None:
        cross = torch.linalg.cross
        return _change_points(scene, "sensor_tilt", lambda u: u + cross(size.expand_as(u), u))
    return _change_points(scene, "sensor_tilt", lambda u: u @ matrix_from_rotation_vector(size).T)


def distort(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """Radial distortion y (1 + size |y|^2) of each point, (1,) [1/m^2]."""

    def bend(u: Tensor) -> Tensor:
        return u * (1.0 + size[0] * (u * u).sum(-1, keepdim=True))

    return _change_points(scene, "lens", bend)


def _change_points(scene: SoftScene, effect: str, change: Callable[[Tensor], Tensor]) -> SoftScene:
    """Change displacements (num_samples, num_points, 3): of markers, else of the channels."""
    rest = scene.rest_places
    if rest is None:
        _require_triples(scene, effect)
        return scene.with_reading((), lambda y, grid: change(_split_triples(y.mT)).flatten(1).mT)
    return scene.with_places(lambda y, t: rest + change(_split_triples(y - rest)).reshape(y.shape))


def _split_triples(y: Tensor) -> Tensor:
    return y.reshape(len(y), -1, 3)


def _require_triples(scene: SoftScene, effect: str) -> None:
    if scene.axes != (0, 1, 2) * (len(scene.axes) // 3):
        raise ValueError(
            f"{effect} needs channels in triples x, y, z, got the axes {scene.axes}; leave it out "
            "of the library or give all three"
        )
