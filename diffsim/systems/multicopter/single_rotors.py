"""Causes in a single rotor: what it lacks of thrust, of torque, of both, and a tilted axis.

A cut or chipped propeller loses thrust and torque alike (``weak_rotor``). Dirt, or a propeller of
another pitch, changes one of them alone (``thrust_loss``, ``torque_loss``), a bent arm the axis
(``rotor_tilt``). Causes that depend on a rotor's speed take the lost thrust for lost speed, an
error of second order.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import torch
from torch import Tensor

from diffsim.core.rotation import cross
from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.multicopter.scene import CopterScene, amount, vector


def _only(scene: CopterScene, index: int) -> Tensor:
    """1 for a certain rotor, else 0, (n_rotors,)."""
    share = torch.zeros(scene.vehicle.num_rotors, dtype=torch.float64)
    share[index] = 1.0
    return share


def _weak_rotor(scene: CopterScene, size: Tensor, run: Run, *, index: int) -> CopterScene:
    share = _only(scene, index)
    return scene.with_command(lambda u, dt: u * (1.0 - amount(size, 2) * share))


def _torque_times(scene: CopterScene, factor: Tensor) -> CopterScene:
    """A copy whose reaction torques per thrust are larger by factors, (points, n_rotors)."""
    vehicle = scene.vehicle
    return scene.changed(vehicle=vehicle.replace(torque_ratios=vehicle.torque_ratios * factor))


def _thrust_loss(scene: CopterScene, size: Tensor, run: Run, *, index: int) -> CopterScene:
    """Less thrust for the same torque: the torque per thrust grows as the thrust falls."""
    kept = 1.0 - amount(size, 1) * _only(scene, index)
    return _torque_times(_weak_rotor(scene, size, run, index=index), 1.0 / kept)


def _torque_loss(scene: CopterScene, size: Tensor, run: Run, *, index: int) -> CopterScene:
    return _torque_times(scene, 1.0 - amount(size, 1) * _only(scene, index))


def _rotor_tilt(scene: CopterScene, size: Tensor, run: Run, *, index: int) -> CopterScene:
    turn = vector(size)[:, None] * _only(scene, index)[:, None]
    directions = scene.vehicle.directions
    turned = directions + cross(turn, directions)
    turned = turned / turned.norm(dim=-1, keepdim=True)
    return scene.changed(vehicle=scene.vehicle.replace(directions=turned))


def weak_rotor(index: int) -> Effect:
    """Loss of thrust and torque of a rotor, counted from 0; named weak_rotor_1 for the first."""
    return Effect(
        name=f"weak_rotor_{index + 1}",
        form="One rotor gives the share 1 - size of its thrust, and of its torque.",
        family="balance",
        kind="actuator",
        unit="-",
        shown_unit="%",
        typical=0.05,
        also_looks_like=("center of mass without yaw data", "damaged or swapped propeller"),
        apply=partial(_weak_rotor, index=index),
    )


def thrust_loss(index: int) -> Effect:
    """Loss of thrust alone of a rotor, counted from 0; named thrust_loss_1 for the first."""
    return Effect(
        name=f"thrust_loss_{index + 1}",
        form="One rotor gives the share 1 - size of its thrust, for the same torque.",
        family="balance",
        kind="actuator",
        unit="-",
        shown_unit="%",
        typical=0.05,
        also_looks_like=("center of mass in flights near hover", "another pitch of a propeller"),
        apply=partial(_thrust_loss, index=index),
    )


def torque_loss(index: int) -> Effect:
    """Loss of torque alone of a rotor, counted from 0; named torque_loss_1 for the first."""
    return Effect(
        name=f"torque_loss_{index + 1}",
        form="One rotor takes the share 1 - size of its torque, for the same thrust.",
        family="torque",
        kind="actuator",
        unit="-",
        shown_unit="%",
        typical=0.1,
        also_looks_like=("torque of another rotor near hover", "rotors tilted to one side"),
        apply=partial(_torque_loss, index=index),
    )


def rotor_tilt(index: int) -> Effect:
    """Tilted axis of a rotor, counted from 0; named rotor_tilt_1 for the first."""
    return Effect(
        name=f"rotor_tilt_{index + 1}",
        form="The axis of one rotor is turned about the body's x and y by a small angle.",
        family="balance",
        kind="material",
        unit="rad",
        typical=0.02,
        components=("roll", "pitch"),
        also_looks_like=("a bent arm", "body tilt with a torque of the rotors"),
        apply=partial(_rotor_tilt, index=index),
    )


def of_each_rotor(num_rotors: int) -> Iterator[Effect]:
    """All causes of single rotors, rotor after rotor."""
    for i in range(num_rotors):
        for cause in (weak_rotor, thrust_loss, torque_loss, rotor_tilt):
            yield cause(i)
