"""Effects on a tossed body and its cameras, beyond gravity, friction and restitution."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.systems.rigid_body.model import TossScene

_UP = torch.tensor([0.0, 0.0, 1.0])
_LEVEL = torch.eye(3)[:2]


def _growing(term: str) -> Callable[[TossScene, Tensor, Run], TossScene]:
    """Grows one term of ``model.TERMS``."""
    return partial(_grown, term=term)


def _grown(scene: TossScene, size: Tensor, run: Run, *, term: str) -> TossScene:
    return scene.with_term(term, size)


def _weaker_gravity(scene: TossScene, size: Tensor, run: Run) -> TossScene:
    return scene.with_term("gravity", size[..., :1] * _UP.to(size))


def _tilted(scene: TossScene, size: Tensor, run: Run) -> TossScene:
    return scene.with_term("gravity", size @ _LEVEL.to(size))


def _impact(study: Study) -> str | None:
    if not any(run.setup.get("_hits") for run in study.runs):
        return "tosses recorded through their impact"
    return None


LENGTH_SCALE = Effect(
    name="length_scale",
    form="All tracked positions are (1 + size) times the true ones.",
    family="scale",
    kind="sensor",
    unit="-",
    shown_unit="%",
    typical=0.01,
    also_looks_like=("size of the tags", "focal length of the cameras"),
    apply=_growing("length_scale"),
)
CLOCK_SCALE = Effect(
    name="clock_scale",
    form="Frames are (1 + size) times as far apart as stated.",
    family="scale",
    kind="sensor",
    unit="-",
    shown_unit="%",
    typical=0.01,
    apply=_growing("clock_scale"),
)
GRAVITY = Effect(
    name="weaker_gravity",
    form="Gravity is weaker by size; typical: what air carries, with its added mass.",
    family="gravity",
    kind="environment",
    unit="m/s^2",
    typical=0.05,
    also_looks_like=("buoyancy and added mass of air",),
    apply=_weaker_gravity,
)
TILT = Effect(
    name="board_tilt",
    form="The ground is not level: gravity has components along it.",
    family="gravity",
    kind="environment",
    unit="m/s^2",
    typical=0.05,
    components=("x", "y"),
    also_looks_like=("cameras that do not know where down is",),
    apply=_tilted,
)
SPECIFIC_LINEAR_DRAG = Effect(
    name="specific_linear_drag",
    form="Deceleration size times the velocity.",
    family="drag",
    kind="force",
    unit="1/s",
    typical=0.03,
    signed=False,
    apply=_growing("drag"),
)
SPECIFIC_QUADRATIC_DRAG = Effect(
    name="specific_quadratic_drag",
    form="Deceleration size |v| v, |v| that of mid flight.",
    family="drag",
    kind="force",
    unit="1/m",
    typical=0.02,
    signed=False,
    apply=_growing("quadratic_drag"),
)
SPIN_DRAG = Effect(
    name="spin_drag",
    form="The spin decays at the rate size.",
    family="drag",
    kind="force",
    unit="1/s",
    typical=0.1,
    signed=False,
    apply=_growing("spin_drag"),
)
GROUND_HEIGHT = Effect(
    name="ground_height",
    form="The ground lies at z = size.",
    family="ground",
    kind="environment",
    unit="m",
    typical=0.001,
    also_looks_like=("height of the tags on the body", "half width of the body"),
    apply=_growing("ground_height"),
)
GROUND_SLOPE = Effect(
    name="ground_slope",
    form="The ground rises by size per meter along x and y.",
    family="ground",
    kind="environment",
    unit="-",
    typical=0.005,
    components=("x", "y"),
    needs=_impact,
    apply=_growing("ground_slope"),
)
HALF_WIDTH = Effect(
    name="half_width",
    form="The body is larger by the share size.",
    family="ground",
    kind="environment",
    unit="-",
    shown_unit="%",
    typical=0.01,
    apply=_growing("half_width"),
)
CENTER_OFFSET = Effect(
    name="center_offset",
    form="The tracked point lies off the center of mass, in the body.",
    family="center",
    kind="sensor",
    unit="m",
    typical=0.0005,
    components=("x", "y", "z"),
    also_looks_like=("tags that are not where they are believed to be",),
    apply=_growing("center"),
)
CONTACT_TIME = Effect(
    name="contact_time",
    form="The impulse takes size: a ground that gives way.",
    family="contact",
    kind="force",
    unit="s",
    typical=0.005,
    signed=False,
    smooth=False,
    also_looks_like=("compliance of the ground", "lagging filter of the tracking"),
    needs=_impact,
    apply=_growing("contact_time"),
)
SMOOTHING = Effect(
    name="tracking_smoothing",
    form="The tracked motion is averaged over size, half before and half after.",
    family="contact",
    kind="sensor",
    unit="s",
    typical=0.005,
    signed=False,
    smooth=False,
    also_looks_like=("exposure of the cameras",),
    needs=_impact,
    apply=_growing("smoothing"),
)
RESTITUTION_SLOPE = Effect(
    name="restitution_slope",
    form="Restitution grows by exp(size) per m/s of the corner.",
    family="impact",
    kind="material",
    unit="s/m",
    typical=1.0,
    needs=_impact,
    apply=_growing("restitution_slope"),
)
REBOUND = Effect(
    name="tangential_rebound",
    form="A sticking corner leaves at -size times its tangential velocity.",
    family="impact",
    kind="material",
    unit="-",
    typical=0.2,
    needs=_impact,
    apply=_growing("rebound"),
)
FRICTION_SLOPE = Effect(
    name="friction_slope",
    form="Friction grows by exp(size) per m/s of slip.",
    family="impact",
    kind="material",
    unit="s/m",
    typical=0.5,
    needs=_impact,
    apply=_growing("friction_slope"),
)
MOMENT_OF_INERTIA = Effect(
    name="moment_of_inertia",
    form="Moment of inertia larger by the share size: a hollow cube's is 0.67 times larger.",
    family="inertia",
    kind="material",
    unit="-",
    shown_unit="%",
    typical=0.1,
    also_looks_like=("mass that is not spread evenly",),
    needs=_impact,
    apply=_growing("inertia"),
)
UNEQUAL_INERTIA = Effect(
    name="unequal_inertia",
    form="Moments of inertia about the body's x and y larger than stated by the shares size.",
    family="inertia",
    kind="material",
    unit="-",
    shown_unit="%",
    typical=0.1,
    components=("x", "y"),
    also_looks_like=("mass that is not spread evenly",),
    apply=_growing("unequal_inertia"),
)

TOSS: tuple[Effect, ...] = (
    LENGTH_SCALE,
    CLOCK_SCALE,
    GRAVITY,
    TILT,
    SPECIFIC_LINEAR_DRAG,
    SPECIFIC_QUADRATIC_DRAG,
    SPIN_DRAG,
    GROUND_HEIGHT,
    GROUND_SLOPE,
    HALF_WIDTH,
    CENTER_OFFSET,
    CONTACT_TIME,
    SMOOTHING,
    RESTITUTION_SLOPE,
    REBOUND,
    FRICTION_SLOPE,
    MOMENT_OF_INERTIA,
    UNEQUAL_INERTIA,
)
