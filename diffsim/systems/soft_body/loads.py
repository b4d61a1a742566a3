"""Loads of a soft body: what hangs from it, stops, a base that shakes, another size."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from diffsim.data.study import Run
from diffsim.systems.soft_body.kept import OfScene, OfTime
from diffsim.systems.soft_body.places import spread_evenly
from diffsim.systems.soft_body.scene import Force, Moment, SoftScene

if TYPE_CHECKING:
    from diffsim.systems.soft_body.keys import Stop, Vibration


class HungWeight(Force):
    """Weight of what hangs from the body, by the scene's ``hung_mass``."""

    leading_axes, of_state, reads = True, True, ("gravity",)

    def __init__(self) -> None:
        self._weight = OfScene(_weigh_hung)

    def __call__(self, scene: SoftScene, moment: Moment) -> Tensor:
        return self._weight(scene).expand(moment.x.shape)


def _weigh_hung(scene: SoftScene) -> Tensor:
    """(num_nodes, 3) [N]."""
    assert scene.hung_mass is not None
    return scene.hung_mass[:, None] * scene.number("gravity")


def attach_load(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """Attach the share ``size`` of what hangs: it weighs as much as before, and is inert."""
    if scene.hung_mass is None:
        return scene
    moved = size[0] * scene.hung_mass.clamp(min=0.0)
    heavier = scene.with_parameter("attached_mass", scene.number("attached_mass") + moved)
    return heavier.changed(hung_mass=scene.hung_mass - moved)


def load_free_end(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """A mass of ``size`` at the free end [kg]."""
    mass = scene.number("attached_mass") + size[0] * free_end(scene)
    return scene.with_parameter("attached_mass", mass.clamp(min=0.0))


def free_end(scene: SoftScene) -> Tensor:
    """(num_nodes,) shares of the nodes farthest from where the body is held; they sum to 1."""
    body = scene.body
    x, held = body.x_rest, body.fixed.any(-1)
    from_point = x[held].mean(0) if bool(held.any()) else x.mean(0)
    spread = x.amax(0) - x.amin(0)
    axis = int((x - from_point).abs().amax(0).argmax())
    away = (x[:, axis] - from_point[axis]).abs()
    end = away > away.max() - 1e-3 * spread[axis]
    volume = torch.where(end, body.nodal_volume, 0.0)
    return volume / volume.sum()


def stop_nodes(scene: SoftScene, size: Tensor, run: Run, *, stop: Stop) -> SoftScene:
    """A stop in the way of some nodes, which their mean place meets after a gap."""
    shares = spread_evenly(scene.body.nodal_volume, stop.where.nodes(scene.body.mesh))
    unit = torch.tensor(stop.direction, dtype=torch.float64)
    unit = unit / unit.norm()
    return scene.with_hook(lambda: _StopForce(size[0], shares, unit, stop.gap))


class _StopForce(Force):
    leading_axes, of_state, reads = True, True, ()

    def __init__(self, stiffness: Tensor, shares: Tensor, direction: Tensor, gap_m: float):
        self._stiffness, self._shares = stiffness, shares
        self._direction, self._gap = direction, gap_m

    def __call__(self, scene: SoftScene, moment: Moment) -> Tensor:
        moved = (moment.x - scene.body.x_rest) @ self._direction
        depth = (moved @ self._shares - self._gap).clamp(min=0.0)
        force = -self._stiffness * depth[..., None] * self._shares
        return force[..., None] * self._direction


def shake_base(scene: SoftScene, size: Tensor, run: Run, *, shaken: Vibration) -> SoftScene:
    """A base that shakes along axes at one frequency: its acceleration, cosine and sine."""
    return scene.with_hook(lambda: _Shaking(size, shaken.frequency, shaken.axes))


class _Shaking(Force):
    """Inertia in the frame of the base."""

    leading_axes, reads = True, ("density", "attached_mass", "added_mass")

    def __init__(self, size: Tensor, frequency_hz: float, axes: str):
        parts, rate = size.reshape(len(axes), 2), 2.0 * math.pi * frequency_hz
        idx = torch.tensor(["xyz".index(a) for a in axes])

        def acceleration(times: Tensor) -> Tensor:
            angle = rate * times
            now = torch.stack([angle.cos(), angle.sin()], -1) @ parts.T
            return now.new_zeros(len(times), 3).index_copy(1, idx, now)

        self._acceleration = OfTime(acceleration)
        self._mass = OfScene(lambda scene: -scene.inert_mass[:, None])

    def __call__(self, scene: SoftScene, moment: Moment) -> Tensor:
        return (self._mass(scene) * self._acceleration(moment)).expand(moment.x.shape)


def enlarge_body(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """All lengths (1 + size) times as drawn, by similarity, on the mesh as drawn.

    With k = 1 + size: forces of the solid grow with k^2, its mass with k^3. In lengths of the drawn
    body that is E / k^2 and g / k; masses and cables that do not grow are divided by k^3 and k^4.
    """
    k = 1.0 + size[0]
    small = scene
    for name, power in (
        ("youngs_modulus", 2), ("gravity", 1), ("attached_mass", 3), ("fiber_stiffness", 4)
    ):  # fmt: skip
        small = small.with_parameter(name, small.number(name) / k**power)
    if small.hung_mass is not None:
        small = small.changed(hung_mass=small.hung_mass / k**3)
    rest = small.observe(small.body.x_rest)
    return small.with_places(lambda y, t: rest + k * (y - rest))
