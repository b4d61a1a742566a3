"""A multicopter as its recording shows it: arms and propellers at the recorded poses."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from diffsim.copter.vehicle.multicopter import Fleet
from diffsim.core.arrays import Array, IntArray
from diffsim.core.rotation import matrix_from_quaternion, matrix_from_rpy
from diffsim.identify.shape import MovingShape
from diffsim.systems.multicopter.frames import SENSORS
from diffsim.systems.multicopter.readings import RecordedScene
from diffsim.systems.multicopter.scene import CopterScene

_SIDES = 10  # of a propeller's disc
_UP = np.diag([1.0, -1.0, -1.0])  # z up from north-east-down


def figure_of(scene: CopterScene, channels: Tensor) -> MovingShape | None:
    """The vehicle at the poses that channels show.

    Args:
        scene: The run's scene: its sensors, frames and vehicle.
        channels: Measured or predicted, (num_samples, num_channels).

    Returns:
        None where position or attitude are not among the channels.
    """
    position = _pick_group(scene, channels, "position")
    rotation = _pick_rotation(scene, channels)
    if position is None or rotation is None:
        return None
    turn = _UP @ scene.frames.rotation(rotation).numpy()
    place = scene.frames.in_world(position).numpy() @ _UP
    nodes, triangles = _build_stand_in(scene.vehicle)
    return MovingShape(
        triangles=triangles, nodes_m=nodes @ turn.transpose(0, 2, 1) + place[:, None]
    )


def _pick_group(scene: RecordedScene, channels: Tensor, group: str) -> Tensor | None:
    """Readings of a group, (num_samples, width); None where one of them is not recorded."""
    if group not in scene.sensors:
        return None
    start = sum(len(SENSORS[g]) for g in scene.sensors[: scene.sensors.index(group)])
    wanted = list(range(start, start + len(SENSORS[group])))
    known = list(range(channels.shape[1])) if scene.columns is None else list(scene.columns)
    if not set(wanted) <= set(known):
        return None
    return channels[:, [known.index(column) for column in wanted]]


def _pick_rotation(scene: RecordedScene, channels: Tensor) -> Tensor | None:
    """World from body as recorded, (num_samples, 3, 3)."""
    turns = _pick_group(scene, channels, "quaternion")
    if turns is not None:
        return matrix_from_quaternion(turns / turns.norm(dim=-1, keepdim=True))
    angles = _pick_group(scene, channels, "attitude")
    return None if angles is None else matrix_from_rpy(angles)


def _build_stand_in(fleet: Fleet) -> tuple[Array, IntArray]:
    """Nodes (num_nodes, 3) in the body frame [m] and triangles of arms and discs."""
    hubs, axes = fleet.positions[0].numpy(), fleet.directions[0].numpy()
    radii = fleet.radii[0].numpy()
    nodes: list[Array] = []
    triangles: list[IntArray] = []
    for hub, axis, radius in zip(hubs, axes, radii, strict=True):
        # of an arm, where nobody states the propeller's radius
        size = float(radius) if radius > 0.0 else 0.4 * float(np.linalg.norm(hub))
        across = np.cross(axis, hub) if np.linalg.norm(np.cross(axis, hub)) > 0.0 else np.eye(3)[0]
        across = across / np.linalg.norm(across)
        beside = np.cross(axis, across)
        angle = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
        rim = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * beside
        first = sum(len(n) for n in nodes)
        width = 0.08 * size * across  # half the width of an arm, over its propeller's radius
        nodes += [np.array([width, -width, hub - width, hub + width]), hub + size * rim]
        disc = first + 4 + np.arange(_SIDES)
        fan = np.stack([np.full(_SIDES - 2, disc[0]), disc[1:-1], disc[2:]], 1)
        triangles += [first + np.array([[0, 1, 2], [0, 2, 3]]), fan]
    return np.concatenate(nodes), np.concatenate(triangles)
