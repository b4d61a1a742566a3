"""Effects between the starfish's command and its motion, beside the common causes.

Commands are contractions as shares of the full tendon (65 mm).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.systems import actuator
from diffsim.systems.actuator import BACKLASH, DEAD_BAND, LAG, SATURATION
from diffsim.systems.signals import straight
from diffsim.systems.soft_body.forces import DRY_FRICTION
from diffsim.systems.soft_body.scene import Force, Moment, SoftScene
from diffsim.systems.starfish.body import LEAD, TENDON

QUARTERS = 4.0
FASTEST = 0.8 / TENDON  # what the commands ask for at most [1/s]


def _rail_friction(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    return DRY_FRICTION.apply(scene, size / QUARTERS, run)


def _rail_drag(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    return scene.with_force(lambda: _RailDrag(size[0] / QUARTERS))


class _RailDrag(Force):
    leading_axes, reads = True, ()

    def __init__(self, coefficient: Tensor):
        self._coefficient = coefficient

    def __call__(self, scene: SoftScene, moment: Moment) -> Tensor:
        shares = scene.friction_shares
        assert shares is not None
        force = -self._coefficient * shares[:, None] * moment.v
        return force * torch.tensor([1.0, 0.0, 0.0], dtype=force.dtype)


def _rail_tilt(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    return scene.with_force(lambda: _Push(size[None, :] / QUARTERS, 1e9))


class _Push(Force):
    """Along x, knots in time (n, 1 or 2): evenly by volume, and growing from the center [N].

    None before the record begins.
    """

    leading_axes, reads = True, ()

    def __init__(self, knots: Tensor, spacing: float):
        self._knots, self._spacing = knots, spacing

    def __call__(self, scene: SoftScene, moment: Moment) -> Tensor:
        x = scene.body.mesh.x_rest
        out = x[:, 1:].amax(1) / x.max()
        shapes = torch.stack([torch.ones_like(out), out]) * scene.body.nodal_volume
        shapes = shapes / shapes.sum(1, keepdim=True)
        time = torch.tensor([moment.time], dtype=torch.float64)
        now = straight(self._knots, self._spacing, time)[0] * (moment.time >= LEAD)
        along = now @ shapes[: self._knots.shape[1]]
        unit = torch.tensor([1.0, 0.0, 0.0], dtype=along.dtype)
        return (along[:, None] * unit).expand(moment.x.shape)


def _travels(study: Study) -> str | None:
    if not any(c.name == "travel_x_m" for c in study.channels):
        return "the travel along the rail among the channels"
    return None


def _unknown_push(scene: SoftScene, size: Tensor, run: Run, *, spacing: float) -> SoftScene:
    return scene.with_force(lambda: _Push(size.reshape(2, -1).T, spacing))


def _unknown_pull(scene: SoftScene, size: Tensor, run: Run, *, spacing: float) -> SoftScene:
    def changed(u: Tensor, dt: float) -> Tensor:
        times = dt * torch.arange(len(u), dtype=u.dtype)
        return u + straight(size[:, None], spacing, times)

    return scene.with_command(changed)


RATE_LIMIT = replace(actuator.RATE_LIMIT, typical=2.0 / FASTEST)
COMMAND_GAIN = replace(actuator.COMMAND_GAIN, typical=0.2)
RAIL_FRICTION = replace(
    DRY_FRICTION,
    name="rail_friction",
    form="Coulomb friction of the whole robot on its rail.",
    also_looks_like=("sticking on the twine", "drag at small speed"),
    needs=_travels,
    apply=_rail_friction,
)
RAIL_DRAG = Effect(
    name="rail_drag",
    form="Force -size v of the rail on the center.",
    family="damping",
    kind="force",
    unit="N s/m",
    typical=0.3,
    signed=False,
    also_looks_like=("drag of the core", "cable that is towed along"),
    needs=_travels,
    apply=_rail_drag,
)
RAIL_TILT = Effect(
    name="rail_tilt",
    form="Constant force along the rail, from where the record begins.",
    family="gravity",
    kind="environment",
    unit="N",
    typical=0.01,
    also_looks_like=(
        "pull of the cable",
        "current",
        "a tilted rail of a robot that is not quite buoyant",
    ),
    needs=_travels,
    apply=_rail_tilt,
)


def unknown_push(num_knots: int, spacing: float) -> Effect:
    """A force along the rail, on the whole quarter and more towards the tips, knots in time."""
    return Effect(
        name="unknown_push",
        family="unknown",
        kind="force",
        unit="N",
        typical=0.01,
        apply=partial(_unknown_push, spacing=spacing),
        components=tuple(f"{s}_{k}" for s in ("even", "out") for k in range(num_knots)),
    )


def unknown_pull(num_knots: int, spacing: float) -> Effect:
    """Pull of the tendons that the command does not explain, knots in time."""
    return Effect(
        name="unknown_pull",
        family="unknown",
        kind="actuator",
        unit="-",
        typical=0.01,
        apply=partial(_unknown_pull, spacing=spacing),
        components=tuple(f"knot_{k}" for k in range(num_knots)),
    )


STARFISH_EFFECTS: tuple[Effect, ...] = (
    LAG,
    RATE_LIMIT,
    DEAD_BAND,
    BACKLASH,
    SATURATION,
    COMMAND_GAIN,
    RAIL_FRICTION,
    RAIL_DRAG,
    RAIL_TILT,
)
