"""Candidate causes of the balls: air, ground, impact, the camera, and the tracker."""

from __future__ import annotations

from diffsim.identify.effect import Effect
from diffsim.systems.adding import adding

SLIDING_FRICTION = Effect(
    name="sliding_friction",
    form="Coulomb friction with the table while a ball slips, before it rolls.",
    family="table",
    kind="force",
    unit="-",
    typical=0.25,
    signed=False,
    also_looks_like=("felt dragging on the cloth",),
    apply=adding("table_friction"),
)
ROLLING_RESISTANCE = Effect(
    name="rolling_resistance",
    form="Constant deceleration along the motion, over gravity.",
    family="table",
    kind="force",
    unit="-",
    typical=0.02,
    signed=False,
    apply=adding("rolling_resistance"),
)
TABLE_TILT = Effect(
    name="table_tilt",
    form="Slope of the table.",
    family="table",
    kind="environment",
    unit="rad",
    typical=0.01,
    components=("x", "y"),
    apply=adding("tilt_x", "tilt_y"),
)
AIR_DRAG = Effect(
    name="air_drag",
    form="Deceleration k v^2.",
    family="table",
    kind="environment",
    unit="1/m",
    typical=0.02,
    signed=False,
    apply=adding("air_drag"),
)
BALL_FRICTION = Effect(
    name="ball_friction",
    form="Coulomb friction between the balls: turns spin into lift and sideways motion.",
    family="impact",
    kind="force",
    unit="-",
    typical=0.4,
    signed=False,
    apply=adding("ball_friction"),
)
UNEQUAL_MASSES = Effect(
    name="unequal_masses",
    form="The struck ball is heavier by this share.",
    family="impact",
    kind="material",
    unit="-",
    shown_unit="%",
    typical=0.03,
    apply=adding("mass_ratio"),
)
INERTIA = Effect(
    name="inertia_ratio",
    form="Change of I / (m r^2): a solid ball has 0.40, a thin shell 0.67.",
    family="impact",
    kind="material",
    unit="-",
    typical=0.07,
    apply=adding("inertia"),
)
HOP = Effect(
    name="hop",
    form="Upward velocity of the coming ball after the impact.",
    family="impact",
    kind="force",
    unit="m/s",
    typical=0.15,
    signed=False,
    apply=adding("hop"),
)
CONTACT_TIME = Effect(
    name="contact_time",
    form="The blow takes size: balls that give way.",
    family="contact",
    kind="force",
    unit="s",
    typical=0.005,
    signed=False,
    smooth=False,
    also_looks_like=("smaller diameter", "merged regions"),
    apply=adding("contact_time"),
)
LENS_DISTORTION = Effect(
    name="lens_distortion",
    form="Radial distortion k r^2, r in focal lengths.",
    family="camera",
    kind="sensor",
    unit="-",
    typical=0.1,
    apply=adding("radial"),
)
PRINCIPAL_POINT = Effect(
    name="principal_point",
    form="The optical axis misses the middle of the picture.",
    family="camera",
    kind="sensor",
    unit="px",
    typical=10.0,
    components=("u", "v"),
    apply=adding("center_u", "center_v"),
)
FRAME_RATE = Effect(
    name="frame_rate",
    form="The camera's second is longer by this share.",
    family="camera",
    kind="sensor",
    unit="-",
    shown_unit="%",
    typical=0.01,
    also_looks_like=("scale of all friction coefficients, exactly",),
    apply=adding("clock"),
)
ROLLING_SHUTTER = Effect(
    name="rolling_shutter",
    form="Time from reading the first row of the picture to the last.",
    family="camera",
    kind="sensor",
    unit="s",
    typical=0.01,
    signed=False,
    apply=adding("readout"),
)
MERGED_REGIONS = Effect(
    name="merged_regions",
    form="Touching regions: each center is pulled towards the other ball while the gap is small.",
    family="tracker",
    kind="sensor",
    unit="px",
    typical=2.0,
    apply=adding("merge"),
)
LIT_CENTER = Effect(
    name="lit_center",
    form="The center of the lit part lies off the ball's center by this share of its radius.",
    family="tracker",
    kind="sensor",
    unit="-",
    shown_unit="%",
    typical=0.1,
    components=("u", "v"),
    apply=adding("lit_u", "lit_v"),
)

LIFT = Effect(
    name="weaker_gravity",
    form="Gravity is weaker by size; typical: what air carries, with its added mass.",
    family="gravity",
    kind="environment",
    unit="m/s^2",
    typical=0.05,
    also_looks_like=("buoyancy and added mass of air",),
    apply=adding("lift"),
)
GROUND_HEIGHT = Effect(
    name="ground_height",
    form="The ground lies higher by size.",
    family="ground",
    kind="environment",
    unit="m",
    typical=0.001,
    also_looks_like=("radius of the ball",),
    apply=adding("ground_height"),
)
RESTITUTION_SLOPE = Effect(
    name="restitution_slope",
    form="Restitution grows by exp(size) per m/s of the approach, stated for 1 m/s.",
    family="impact",
    kind="material",
    unit="s/m",
    typical=0.1,
    also_looks_like=("plastic deformation", "viscous losses in the ball"),
    apply=adding("restitution_slope"),
)
REBOUND = Effect(
    name="tangential_rebound",
    form="A contact that sticks leaves at -size times its tangential velocity.",
    family="impact",
    kind="material",
    unit="-",
    typical=0.2,
    apply=adding("rebound"),
)
LENGTH_SCALE = Effect(
    name="length_scale",
    form="All tracked positions are (1 + size) times the true ones.",
    family="scale",
    kind="sensor",
    unit="-",
    shown_unit="%",
    typical=0.01,
    also_looks_like=("focal length of the cameras",),
    apply=adding("length_scale"),
)
CLOCK_SCALE = Effect(
    name="clock_scale",
    form="Samples are (1 + size) times as far apart as stated.",
    family="scale",
    kind="sensor",
    unit="-",
    shown_unit="%",
    typical=0.01,
    apply=adding("clock"),
)

#: By what a study must have for them to act.
GROUND = (SLIDING_FRICTION, ROLLING_RESISTANCE)
BOUNCES = (RESTITUTION_SLOPE, REBOUND, GROUND_HEIGHT)
EVERYWHERE = (TABLE_TILT, AIR_DRAG)
PAIR = (BALL_FRICTION, UNEQUAL_MASSES, INERTIA, HOP, CONTACT_TIME)
CAMERA = (LENS_DISTORTION, PRINCIPAL_POINT, FRAME_RATE, ROLLING_SHUTTER, LIT_CENTER)
POSITIONS = (LENGTH_SCALE, CLOCK_SCALE)
BALL_EFFECTS: tuple[Effect, ...] = (
    *(*GROUND, *EVERYWHERE, *PAIR, *CAMERA, MERGED_REGIONS),
    *(LIFT, *BOUNCES, *POSITIONS),
)
