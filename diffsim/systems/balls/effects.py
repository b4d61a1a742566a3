"""Candidate causes of the balls: the table, the impact, the camera, and the tracker."""

from __future__ import annotations

from collections.abc import Callable

from diffsim.identify.effect import Effect
from diffsim.systems.adding import AddingEffect


class SlidingFriction(AddingEffect):
    """Coulomb friction with the table while a ball slips, before it rolls."""

    name, family, kind, unit, typical = "sliding_friction", "table", "force", "-", 0.25
    signed, adds_to = False, ("table_friction",)
    also_looks_like = ("felt dragging on the cloth",)


class RollingResistance(AddingEffect):
    """Constant deceleration along the motion, over gravity."""

    name, family, kind, unit, typical = "rolling_resistance", "table", "force", "-", 0.02
    signed, adds_to = False, ("rolling_resistance",)


class TableTilt(AddingEffect):
    """Slope of the table."""

    name, family, kind, unit, typical = "table_tilt", "table", "environment", "rad", 0.01
    components, adds_to = ("x", "y"), ("tilt_x", "tilt_y")


class AirDrag(AddingEffect):
    """Deceleration k v^2; a ball's k is about 0.02 1/m."""

    name, family, kind, unit, typical = "air_drag", "table", "environment", "1/m", 0.02
    signed, adds_to = False, ("air_drag",)


class BallFriction(AddingEffect):
    """Coulomb friction between the balls: turns spin into lift and sideways motion."""

    name, family, kind, unit, typical = "ball_friction", "impact", "force", "-", 0.4
    signed, adds_to = False, ("ball_friction",)


class UnequalMasses(AddingEffect):
    """The struck ball is heavier by this share."""

    name, family, kind, unit, typical = "unequal_masses", "impact", "material", "-", 0.03
    adds_to = ("mass_ratio",)


class Inertia(AddingEffect):
    """Change of I / (m r^2) from 0.52: a solid ball has 0.40, a thin shell 0.67."""

    name, family, kind, unit, typical = "inertia_ratio", "impact", "material", "-", 0.07
    adds_to = ("inertia",)


class Hop(AddingEffect):
    """Upward velocity of the coming ball after the impact."""

    name, family, kind, unit, typical = "hop", "impact", "force", "m/s", 0.15
    signed, adds_to = False, ("hop",)


class LensDistortion(AddingEffect):
    """Radial distortion k r^2, r in focal lengths."""

    name, family, kind, unit, typical = "lens_distortion", "camera", "sensor", "-", 0.1
    adds_to = ("radial",)


class PrincipalPoint(AddingEffect):
    """The optical axis misses the middle of the picture."""

    name, family, kind, unit, typical = "principal_point", "camera", "sensor", "px", 10.0
    components, adds_to = ("u", "v"), ("centre_u", "centre_v")


class FrameRate(AddingEffect):
    """The camera's second is longer by this share."""

    name, family, kind, unit, typical = "frame_rate", "camera", "sensor", "-", 0.01
    adds_to = ("clock",)
    also_looks_like = ("scale of all friction coefficients, exactly",)


class RollingShutter(AddingEffect):
    """Time from reading the first row of the picture to the last."""

    name, family, kind, unit, typical = "rolling_shutter", "camera", "sensor", "s", 0.01
    signed, adds_to = False, ("readout",)


class MergedRegions(AddingEffect):
    """Touching regions: each centre is pulled towards the other ball while the gap is small."""

    name, family, kind, unit, typical = "merged_regions", "tracker", "sensor", "px", 2.0
    adds_to = ("merge",)


class LitCentre(AddingEffect):
    """The centre of the lit part lies off the ball's centre by this share of its radius."""

    name, family, kind, unit, typical = "lit_centre", "tracker", "sensor", "-", 0.1
    components, adds_to = ("u", "v"), ("lit_u", "lit_v")


BALL_EFFECTS: tuple[Callable[[], Effect], ...] = (
    SlidingFriction,
    RollingResistance,
    TableTilt,
    AirDrag,
    BallFriction,
    UnequalMasses,
    Inertia,
    Hop,
    LensDistortion,
    PrincipalPoint,
    FrameRate,
    RollingShutter,
    MergedRegions,
    LitCentre,
)
