"""Candidate causes of a bent body: chamber and supply, material, gravity and air, markers.

Pressures are in units of ``Layout.unit`` (100 kPa, or the one step that was recorded).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from diffsim.data.study import Study
from diffsim.identify.effect import Effect
from diffsim.systems.adding import AddingEffect


class BendingEffect(AddingEffect):
    """Makes numbers of the scene larger, where enough levels of pressure were recorded."""

    unit: ClassVar[str] = "-"
    needs_levels: ClassVar[int] = 1

    def needs(self, study: Study) -> str | None:
        levels = {run.group for run in study.fit_runs}
        if len(levels) < self.needs_levels:
            return f"runs at {self.needs_levels} levels of pressure or more"
        return None


class Lag(BendingEffect):
    """First-order lag of the chamber's pressure, filling and venting alike."""

    name, family, kind, unit, typical = "lag", "supply", "actuator", "s", 0.05
    signed, adds_to = False, ("fill_lag", "vent_lag")
    also_looks_like = ("resistance of the supply line",)


class FillLag(BendingEffect):
    """First-order lag while filling only."""

    name, family, kind, unit, typical = "fill_lag", "supply", "actuator", "s", 0.05
    signed, adds_to = False, ("fill_lag",)


class FlowLimit(BendingEffect):
    """Filling lag in proportion to the level: a supply of limited flow, a growing chamber."""

    name, family, kind, unit, typical = "flow_limit", "supply", "actuator", "s", 0.2
    signed, adds_to, needs_levels = False, ("flow_limit",), 2


class SlowFill(BendingEffect):
    """This share of the pressure arrives with ``slow_time``; venting is at once. Negative: leak."""

    name, family, kind, typical = "slow_fill", "slow", "actuator", 0.1
    adds_to = ("slow_fill",)
    also_looks_like = ("regulator that creeps to its set point", "leak, if negative")


class Creep(BendingEffect):
    """Compliance that comes with ``slow_time``, and goes as slowly (standard linear solid)."""

    name, family, kind, typical = "creep", "slow", "material", 0.1
    signed, adds_to = False, ("creep",)
    also_looks_like = ("stress softening of the rubber (Mullins)",)


class DeadBand(BendingEffect):
    """Nothing happens below this pressure."""

    name, family, kind, unit, typical = "dead_band", "moment", "actuator", "100 kPa", 0.03
    signed, smooth, adds_to = False, False, ("dead_band",)


class MomentGrowth(BendingEffect):
    """Moment p (1 + k p): the chamber grows with its pressure, stiffness and frequency do not."""

    name, family, kind, unit, typical = "moment_growth", "moment", "actuator", "1/100 kPa", 2.0
    adds_to = ("moment_growth",)
    also_looks_like = ("ballooning of the chamber, a little of it", "saturation, if negative")


class Ballooning(BendingEffect):
    """Moment p / (1 - k p): the chamber's wall gives way as its pressure grows, the body does not.

    A wall of stiffness K under a pressure on an area that grows with its own bulge.
    """

    name, family, kind, unit, typical = "ballooning", "moment", "material", "1/100 kPa", 1.0
    adds_to = ("ballooning",)
    also_looks_like = ("softening of the stretched rubber, of the wall only",)


class StiffnessLoss(BendingEffect):
    """Bending stiffness 1 - k p: more bend per pressure, and a lower frequency while it is on."""

    name, family, kind, unit, typical = "stiffness_loss", "stiffness", "material", "1/100 kPa", 1.0
    adds_to = ("stiffness_loss",)
    also_looks_like = ("softening of the stretched wall", "follower pressure on the bent chamber")


class Stiffening(BendingEffect):
    """Stiffness 1 + k q^2 at the bending angle q."""

    name, family, kind, unit, typical = "stiffening", "stiffness", "material", "1/rad^2", 0.3
    adds_to = ("stiffening",)


class SecondMode(BendingEffect):
    """The second natural mode, seen as this share of the first one's angle."""

    name, family, kind, typical = "second_mode", "modes", "material", 0.05
    adds_to = ("second_mode",)


class DampingGrowth(BendingEffect):
    """Damping 1 + k p: more while the chamber is under pressure."""

    name, family, kind, unit, typical = "damping_growth", "damping", "material", "1/100 kPa", 2.0
    adds_to = ("damping_growth",)


class QuadraticDrag(BendingEffect):
    """Damping that grows with the speed of bending."""

    name, family, kind, typical = "quadratic_drag", "damping", "environment", 0.5
    signed, adds_to = False, ("quadratic_drag",)
    also_looks_like = ("air drag",)


class Hanging(BendingEffect):
    """Gravity along the body, of this share of the stiffness; negative: it stands."""

    name, family, kind, typical = "gravity_along", "gravity", "environment", 0.1
    adds_to = ("hanging",)


class Sideways(BendingEffect):
    """Gravity across the body: a moment with the cosine of the angle."""

    name, family, kind, unit, typical = "gravity_across", "gravity", "environment", "rad", 0.1
    adds_to = ("sideways",)


class OrderDrift(BendingEffect):
    """Bend per pressure changes by this share from trial to trial."""

    name, family, kind, unit, typical = "order_drift", "drift", "material", "1/trial", 0.02
    adds_to, needs_levels = ("drift",), 2
    also_looks_like = ("moment growth, where the levels were taken in order",)


class DirectionDrift(BendingEffect):
    """The plane of bending turns with the angle."""

    name, family, kind, unit, typical = "direction_drift", "direction", "material", "rad/rad", 0.1
    adds_to = ("direction_drift",)


class Twist(BendingEffect):
    """The end turns about the body's axis in proportion to the angle."""

    name, family, kind, unit, typical = "twist", "direction", "material", "rad/rad", 0.1
    adds_to = ("twist",)


class MarkerScale(BendingEffect):
    """Scale of measured displacements."""

    name, family, kind, typical = "marker_scale", "markers", "sensor", 0.01
    adds_to = ("scale",)


class FrameTilt(BendingEffect):
    """The body's axis is not an axis of the laboratory."""

    name, family, kind, unit, typical = "frame_tilt", "markers", "sensor", "rad", 0.05
    components, adds_to = ("first", "second"), ("frame_along", "frame_across")


BENDING_EFFECTS: tuple[Callable[[], Effect], ...] = (
    Lag,
    FillLag,
    FlowLimit,
    SlowFill,
    Creep,
    DeadBand,
    MomentGrowth,
    Ballooning,
    StiffnessLoss,
    Stiffening,
    SecondMode,
    DampingGrowth,
    QuadraticDrag,
    Hanging,
    Sideways,
    OrderDrift,
    DirectionDrift,
    Twist,
    MarkerScale,
    FrameTilt,
)
