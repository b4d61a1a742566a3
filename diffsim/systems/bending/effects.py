"""Candidate causes of a bent body: chamber and supply, material, gravity and air, markers.

Pressures are in units of ``Layout.unit`` (100 kPa, or the one step that was recorded).
"""

from __future__ import annotations

from diffsim.data.study import Study
from diffsim.identify.effect import Effect
from diffsim.systems.adding import adding


def _two_levels(study: Study) -> str | None:
    if len({run.group for run in study.fit_runs}) < 2:
        return "runs at 2 levels of pressure or more"
    return None


PRESSURE_LAG = Effect(
    name="pressure_lag",
    form="First-order lag of the chamber's pressure, filling and venting alike.",
    family="supply",
    kind="actuator",
    unit="s",
    typical=0.05,
    signed=False,
    also_looks_like=("resistance of the supply line",),
    apply=adding("fill_lag", "vent_lag"),
)
FILL_LAG = Effect(
    name="fill_lag",
    form="First-order lag while filling only.",
    family="supply",
    kind="actuator",
    unit="s",
    typical=0.05,
    signed=False,
    apply=adding("fill_lag"),
)
FLOW_LIMIT = Effect(
    name="flow_limit",
    form="Filling lag in proportion to the level: a supply of limited flow, a growing chamber.",
    family="supply",
    kind="actuator",
    unit="s",
    typical=0.2,
    signed=False,
    needs=_two_levels,
    apply=adding("flow_limit"),
)
SLOW_FILL = Effect(
    name="slow_fill",
    form="A share size of the pressure arrives with ``slow_time``; venting is at once.",
    family="slow",
    kind="actuator",
    unit="-",
    typical=0.1,
    also_looks_like=("regulator that creeps to its set point", "leak, if negative"),
    apply=adding("slow_fill"),
)
SLOW_COMPLIANCE = Effect(
    name="slow_compliance",
    form="Compliance that comes with ``slow_time``, and goes as slowly (standard linear solid).",
    family="slow",
    kind="material",
    unit="-",
    typical=0.1,
    signed=False,
    also_looks_like=("stress softening of the rubber (Mullins)",),
    apply=adding("creep"),
)
PRESSURE_DEAD_BAND = Effect(
    name="pressure_dead_band",
    form="Nothing happens below this pressure.",
    family="moment",
    kind="actuator",
    unit="100 kPa",
    typical=0.03,
    signed=False,
    smooth=False,
    apply=adding("dead_band"),
)
MOMENT_GROWTH = Effect(
    name="moment_growth",
    form="Moment p (1 + k p): the chamber grows with its pressure, stiffness and frequency do not.",
    family="moment",
    kind="actuator",
    unit="1/100 kPa",
    typical=2.0,
    also_looks_like=("ballooning of the chamber, a little of it", "saturation, if negative"),
    apply=adding("moment_growth"),
)
BALLOONING = Effect(
    name="ballooning",
    form="Moment p / (1 - k p): the chamber's wall gives way under pressure, the body does not.",
    family="moment",
    kind="material",
    unit="1/100 kPa",
    typical=1.0,
    also_looks_like=("softening of the stretched rubber, of the wall only",),
    apply=adding("ballooning"),
)
PRESSURE_SOFTENING = Effect(
    name="pressure_softening",
    form="Bending stiffness 1 - k p: more bend per pressure, and a lower frequency while it is on.",
    family="stiffness",
    kind="material",
    unit="1/100 kPa",
    typical=1.0,
    also_looks_like=("softening of the stretched wall", "follower pressure on the bent chamber"),
    apply=adding("stiffness_loss"),
)
BENDING_STIFFENING = Effect(
    name="bending_stiffening",
    form="Stiffness 1 + k q^2 at the bending angle q.",
    family="stiffness",
    kind="material",
    unit="1/rad^2",
    typical=0.3,
    apply=adding("stiffening"),
)
SECOND_MODE = Effect(
    name="second_mode",
    form="The second natural mode, seen as this share of the first one's angle.",
    family="modes",
    kind="material",
    unit="-",
    typical=0.05,
    apply=adding("second_mode"),
)
DAMPING_GROWTH = Effect(
    name="damping_growth",
    form="Damping 1 + k p: more while the chamber is under pressure.",
    family="damping",
    kind="material",
    unit="1/100 kPa",
    typical=2.0,
    apply=adding("damping_growth"),
)
BENDING_DRAG = Effect(
    name="bending_drag",
    form="Damping that grows with the speed of bending.",
    family="damping",
    kind="environment",
    unit="-",
    typical=0.5,
    signed=False,
    also_looks_like=("air drag",),
    apply=adding("quadratic_drag"),
)
HANGING = Effect(
    name="gravity_along",
    form="Gravity along the body, of this share of the stiffness; negative: it stands.",
    family="gravity",
    kind="environment",
    unit="-",
    typical=0.1,
    apply=adding("hanging"),
)
SIDEWAYS = Effect(
    name="gravity_across",
    form="Gravity across the body: a moment with the cosine of the angle.",
    family="gravity",
    kind="environment",
    unit="rad",
    typical=0.1,
    apply=adding("sideways"),
)
ORDER_DRIFT = Effect(
    name="order_drift",
    form="Bend per pressure changes by this share from trial to trial.",
    family="drift",
    kind="material",
    unit="1/trial",
    typical=0.02,
    also_looks_like=("moment growth, where the levels were taken in order",),
    needs=_two_levels,
    apply=adding("drift"),
)
DIRECTION_DRIFT = Effect(
    name="direction_drift",
    form="The plane of bending turns with the angle.",
    family="direction",
    kind="material",
    unit="rad/rad",
    typical=0.1,
    apply=adding("direction_drift"),
)
TWIST = Effect(
    name="twist",
    form="The end turns about the body's axis in proportion to the angle.",
    family="direction",
    kind="material",
    unit="rad/rad",
    typical=0.1,
    apply=adding("twist"),
)
MARKER_SCALE = Effect(
    name="marker_scale",
    form="Scale of measured displacements.",
    family="markers",
    kind="sensor",
    unit="-",
    typical=0.01,
    apply=adding("scale"),
)
FRAME_TILT = Effect(
    name="frame_tilt",
    form="The body's axis is not an axis of the laboratory.",
    family="markers",
    kind="sensor",
    unit="rad",
    typical=0.05,
    components=("first", "second"),
    apply=adding("frame_along", "frame_across"),
)

BENDING_EFFECTS: tuple[Effect, ...] = (
    PRESSURE_LAG,
    FILL_LAG,
    FLOW_LIMIT,
    SLOW_FILL,
    SLOW_COMPLIANCE,
    PRESSURE_DEAD_BAND,
    MOMENT_GROWTH,
    BALLOONING,
    PRESSURE_SOFTENING,
    BENDING_STIFFENING,
    SECOND_MODE,
    DAMPING_GROWTH,
    BENDING_DRAG,
    HANGING,
    SIDEWAYS,
    ORDER_DRIFT,
    DIRECTION_DRIFT,
    TWIST,
    MARKER_SCALE,
    FRAME_TILT,
)
