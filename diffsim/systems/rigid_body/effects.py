"""What a tossed cube and its cameras may have beyond gravity, friction and restitution."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.systems.rigid_body.model import TossScene

_UP = torch.tensor([0.0, 0.0, 1.0])
_LEVEL = torch.eye(3)[:2]


class TossEffect(Effect):
    """Grows one term of ``model.TERMS``."""

    unit, kind = "-", "environment"
    term: ClassVar[str]
    needs_impact: ClassVar[bool] = False

    def needs(self, study: Study) -> str | None:
        if self.needs_impact and not any(run.setup["hits"] for run in study.runs):
            return "tosses recorded through their impact"
        return None

    def apply(self, scene: TossScene, size: Tensor, run: Run) -> Any:
        return scene.with_term(self.term, size)


class LengthScale(TossEffect):
    """All tracked positions are (1 + size) times the true ones."""

    name = term = "length_scale"
    family, typical, kind = "scale", 0.01, "sensor"
    also_looks_like = ("size of the tags", "focal length of the cameras")


class ClockScale(TossEffect):
    """Frames are (1 + size) times as far apart as stated."""

    name = term = "clock_scale"
    family, typical, kind = "scale", 0.01, "sensor"


class Gravity(TossEffect):
    """Gravity is weaker by size: buoyancy of air would be 0.037 m/s^2."""

    name, term = "weaker_gravity", "gravity"
    family, typical, unit = "gravity", 0.05, "m/s2"
    also_looks_like = ("buoyancy and added mass of air",)

    def apply(self, scene: TossScene, size: Tensor, run: Run) -> Any:
        return scene.with_term(self.term, size[..., :1] * _UP.to(size))


class Tilt(TossEffect):
    """The board is not level: gravity has components along it."""

    name, term, components = "board_tilt", "gravity", ("x", "y")
    family, typical, unit = "gravity", 0.05, "m/s2"
    also_looks_like = ("cameras that do not know where down is",)

    def apply(self, scene: TossScene, size: Tensor, run: Run) -> Any:
        return scene.with_term(self.term, size @ _LEVEL.to(size))


class LinearDrag(TossEffect):
    """Deceleration size times the velocity."""

    name, term = "linear_drag", "drag"
    family, typical, unit, signed, kind = "drag", 0.03, "1/s", False, "force"


class QuadraticDrag(TossEffect):
    """Deceleration size |v| v, |v| that of mid flight; a cube of C_d = 1: about 0.02 1/m."""

    name = term = "quadratic_drag"
    family, typical, unit, signed, kind = "drag", 0.02, "1/m", False, "force"


class SpinDrag(TossEffect):
    """The spin decays at the rate size."""

    name = term = "spin_drag"
    family, typical, unit, signed, kind = "drag", 0.1, "1/s", False, "force"


class GroundHeight(TossEffect):
    """The board lies at z = size."""

    name = term = "ground_height"
    family, typical, unit = "ground", 1e-3, "m"
    also_looks_like = ("height of the tags on the cube", "half width of the cube")


class GroundSlope(TossEffect):
    """The board rises by size per metre along x and y."""

    needs_impact = True
    name, term, components = "ground_slope", "ground_slope", ("x", "y")
    family, typical = "ground", 0.005


class HalfWidth(TossEffect):
    """The cube is larger by the share size."""

    name = term = "half_width"
    family, typical = "ground", 0.01


class CentreOffset(TossEffect):
    """The tracked point lies off the centre of mass, in the body."""

    name, term, components = "centre_offset", "centre", ("x", "y", "z")
    family, typical, unit, kind = "centre", 5e-4, "m", "sensor"
    also_looks_like = ("tags that are not where they are believed to be",)


class ContactTime(TossEffect):
    """The impulse takes size: a board that gives way."""

    needs_impact = True
    name, term = "contact_time", "contact_time"
    family, typical, unit, signed, kind = "contact", 5e-3, "s", False, "force"
    smooth = False  # nothing but the frame at the impact feels a small one
    also_looks_like = ("compliance of the board", "lagging filter of the tracking")


class Smoothing(TossEffect):
    """The tracked motion is averaged over size, half before and half after."""

    needs_impact = True
    name, term = "tracking_smoothing", "smoothing"
    family, typical, unit, signed, kind = "contact", 5e-3, "s", False, "sensor"
    smooth = False
    also_looks_like = ("exposure of the cameras",)


class RestitutionSlope(TossEffect):
    """Restitution grows by exp(size) per m/s of the corner."""

    needs_impact = True
    name, term = "restitution_slope", "restitution_slope"
    family, typical, unit, kind = "impact", 1.0, "s/m", "material"


class Rebound(TossEffect):
    """A sticking corner leaves at -size times its tangential velocity."""

    needs_impact = True
    name, term = "tangential_rebound", "rebound"
    family, typical, kind = "impact", 0.2, "material"


class FrictionSlope(TossEffect):
    """Friction grows by exp(size) per m/s of slip."""

    needs_impact = True
    name, term = "friction_slope", "friction_slope"
    family, typical, unit, kind = "impact", 0.5, "s/m", "material"


class Inertia(TossEffect):
    """Moment of inertia larger by the share size: a hollow cube would be 0.67 times larger."""

    needs_impact = True
    name = term = "inertia"
    family, typical, kind = "inertia", 0.1, "material"
    also_looks_like = ("mass that is not spread evenly",)


TOSS: tuple[type[TossEffect], ...] = (
    LengthScale,
    ClockScale,
    Gravity,
    Tilt,
    LinearDrag,
    QuadraticDrag,
    SpinDrag,
    GroundHeight,
    GroundSlope,
    HalfWidth,
    CentreOffset,
    ContactTime,
    Smoothing,
    RestitutionSlope,
    Rebound,
    FrictionSlope,
    Inertia,
)
