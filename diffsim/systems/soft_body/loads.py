"""Loads of a soft body: what hangs from it, stops, a base that shakes, another size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.soft_body.kept import OfScene, OfTime
from diffsim.systems.soft_body.places import Region, spread_evenly
from diffsim.systems.soft_body.scene import Force, Moment, SoftScene


class HungWeight(Force):
    """Weight of what hangs from the body, by the scene's ``hung_mass``."""

    leading_axes, reads = True, ("gravity",)

    def __init__(self) -> None:
        self._weight = OfScene(_hung_weight)

    def __call__(self, scene: SoftScene, moment: Moment) -> Tensor:
        return self._weight(scene).expand(moment.x.shape)


def _hung_weight(scene: SoftScene) -> Tensor:
    """(num_nodes, 3) [N]."""
    assert scene.hung_mass is not None
    return scene.hung_mass[:, None] * scene.parameter("gravity")


def _load_inertia(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """Attach the share ``size`` of what hangs: it weighs as much as before, and is inert."""
    if scene.hung_mass is None:
        return scene
    moved = size[0] * scene.hung_mass.clamp(min=0.0)
    heavier = scene.with_parameter("attached_mass", scene.parameter("attached_mass") + moved)
    return heavier.changed(hung_mass=scene.hung_mass - moved)


LOAD_INERTIA = Effect(
    name="load_inertia",
    form="What hangs from the body moves with it: inertia of size times the hung mass.",
    family="load",
    kind="force",
    unit="-",
    typical=1.0,
    signed=False,
    scanned=True,  # a descent from zero follows the phase of the first swings into another valley
    also_looks_like=("a heavier tip", "a softer body, at one load"),
    apply=_load_inertia,
)


def tip_mass(typical_kg: float) -> Effect:
    """The effect of a mass that nobody recorded; ``typical_kg`` would be no surprise [kg]."""
    return Effect(
        name="tip_mass",
        form="A mass of size at the free end, where loads and markers are.",
        family="load",
        kind="force",
        unit="kg",
        typical=typical_kg,
        signed=False,  # no mass is below zero; central slopes across that are half of the true ones
        also_looks_like=("density", "markers and cables that weigh something"),
        apply=_tip_mass,
    )


def _tip_mass(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    mass = scene.parameter("attached_mass") + size[0] * free_end(scene)
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


def one_sided_stop(where: Region, direction: Sequence[float], gap_m: float) -> Effect:
    """The effect of a stop in the way of some nodes.

    Args:
        where: Nodes whose mean place meets it.
        direction: In which it stops them, (3,).
        gap_m: How far they move freely [m].
    """
    return Effect(
        name="one_sided_stop",
        form=f"A spring of stiffness size that is met after {1e3 * gap_m:g} mm.",
        family="stop",
        kind="force",
        unit="N/m",
        typical=10.0,
        signed=False,
        smooth=False,
        also_looks_like=("stiffening", "a cable that comes taut"),
        apply=partial(_stopped, where=where, direction=tuple(direction), gap_m=gap_m),
    )


def _stopped(
    scene: SoftScene,
    size: Tensor,
    run: Run,
    *,
    where: Region,
    direction: tuple[float, ...],
    gap_m: float,
) -> SoftScene:
    shares = spread_evenly(scene.body.nodal_volume, where.nodes(scene.body.mesh))
    unit = torch.tensor(direction, dtype=torch.float64)
    unit = unit / unit.norm()
    return scene.with_force(lambda: _Stop(size[0], shares, unit, gap_m))


class _Stop(Force):
    leading_axes, reads = True, ()

    def __init__(self, stiffness: Tensor, shares: Tensor, direction: Tensor, gap_m: float):
        self._stiffness, self._shares = stiffness, shares
        self._direction, self._gap = direction, gap_m

    def __call__(self, scene: SoftScene, moment: Moment) -> Tensor:
        moved = (moment.x - scene.body.x_rest) @ self._direction
        depth = (moved @ self._shares - self._gap).clamp(min=0.0)
        force = -self._stiffness * depth[..., None] * self._shares
        return force[..., None] * self._direction


def base_vibration(frequency_hz: float, axes: str) -> Effect:
    """The effect of a base that shakes at one frequency: its acceleration, cosine and sine."""
    return Effect(
        name="base_vibration",
        form=f"The base shakes at {frequency_hz:g} Hz; size is its acceleration.",
        family="support",
        kind="environment",
        unit="m/s^2",
        typical=0.2,
        components=tuple(f"{a}_{s}" for a in axes for s in ("cos", "sin")),
        also_looks_like=("a second mode", "a fan, a motor or a person nearby"),
        apply=partial(_shaken, frequency_hz=frequency_hz, axes=axes),
    )


def _shaken(
    scene: SoftScene, size: Tensor, run: Run, *, frequency_hz: float, axes: str
) -> SoftScene:
    return scene.with_force(lambda: _Shaking(size, frequency_hz, axes))


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


def _body_scale(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """All lengths (1 + size) times as drawn, by similarity, on the mesh as drawn.

    With k = 1 + size: forces of the solid grow with k^2, its mass with k^3. In lengths of the drawn
    body that is E / k^2 and g / k; masses and cables that do not grow are divided by k^3 and k^4.
    """
    k = 1.0 + size[0]
    small = scene
    for name, power in (
        ("youngs_modulus", 2), ("gravity", 1), ("attached_mass", 3), ("fiber_stiffness", 4)
    ):  # fmt: skip
        small = small.with_parameter(name, small.parameter(name) / k**power)
    if small.hung_mass is not None:
        small = small.changed(hung_mass=small.hung_mass / k**3)
    rest = small.observe(small.body.x_rest)
    return small.with_places(lambda y, t: rest + k * (y - rest))


BODY_SCALE = Effect(
    name="body_scale",
    form="The body is (1 + size) times as large as drawn.",
    family="geometry",
    kind="material",
    unit="-",
    shown_unit="%",
    typical=0.03,
    also_looks_like=("Young's modulus", "scale of the cameras"),
    apply=_body_scale,
)
