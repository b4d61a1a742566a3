"""Candidate causes of bodies that fly, bounce and roll, and of what films them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from diffsim.causes.catalogue import rows
from diffsim.causes.ports import on_numbers
from diffsim.causes.readings import instrument_causes
from diffsim.causes.scales import Scales
from diffsim.data.study import Channel, Study
from diffsim.identify.effect import Effect, Needs
from diffsim.systems.rigid_body.parts import Body

RIGID_BODY = "rigid_body"  # the table
AIR = "air"  # what plain magnitudes are of
LIFT, DRAG = 0.05, 0.02  # m/s^2 and 1/m: air around a body whose mass or shape is not stated
#: Of a body that is tossed; all of them.
TOSS = (
    "length_scale",
    "clock_scale",
    "weaker_gravity",
    "board_tilt",
    "specific_linear_drag",
    "specific_quadratic_drag",
    "spin_drag",
    "ground_height",
    "ground_slope",
    "half_width",
    "center_offset",
    "contact_time",
    "tracking_smoothing",
    "restitution_slope",
    "tangential_rebound",
    "friction_slope",
    "moment_of_inertia",
    "unequal_inertia",
)
_OF_IMPACT = (
    "ground_slope",
    "contact_time",
    "tracking_smoothing",
    "restitution_slope",
    "tangential_rebound",
    "friction_slope",
    "moment_of_inertia",
)
#: Of balls, by what a study must have for them to act.
EVERYWHERE = ("table_tilt", "air_drag")
GROUND = ("sliding_friction", "rolling_resistance")
BOUNCES = ("restitution_slope", "tangential_rebound", "ground_height")
PAIR = ("ball_friction", "unequal_masses", "inertia_ratio", "hop", "contact_time")
CAMERA = ("lens_distortion", "principal_point", "frame_rate", "rolling_shutter", "lit_center")
POSITIONS = ("length_scale", "clock_scale")
# what the start of each run, which is free, takes up
_IN_STARTS = ("sensor_offset", "sensor_drift")


def measure_scales(study: Study, bodies: Sequence[Body], gravity: float) -> Scales:
    """Usual magnitudes of the recordings, and of the air around the first body that states them.

    Args:
        study: Study whose runs to fit are looked at, unless its frame has the record.
        bodies: The bodies.
        gravity: [m/s^2].
    """
    kept = Scales.kept_in(study)
    if kept is not None:
        return kept
    in_air = next((a for b in bodies if (a := b.in_air()) is not None), None)
    lift, drag = (LIFT, DRAG) if in_air is None else (in_air[0] * gravity, in_air[1])
    return replace(Scales.of_runs(study), plain={AIR: {"lift": lift, "drag": drag}})


def toss_causes(scales: Scales, without: Iterable[str]) -> list[Effect]:
    """Causes of a tossed body.

    Args:
        scales: Usual magnitudes.
        without: Names of those that a prior already holds, or that nothing could show.
    """
    left_out = {*without}
    return [
        _make_cause(name, scales, "toss", needs_impact if name in _OF_IMPACT else None)
        for name in TOSS
        if name not in left_out
    ]


def ball_causes(scales: Scales, names: Iterable[str]) -> list[Effect]:
    """Causes of balls by name.

    Args:
        scales: Usual magnitudes.
        names: Names of their rows.
    """
    return [_make_cause(name, scales, "balls") for name in names]


def sensor_causes(channels: Sequence[Channel], scales: Scales) -> Iterator[Effect]:
    """Causes in each instrument, where a study says which sensors there are.

    Args:
        channels: Channels of the study, the first ones.
        scales: Usual magnitudes.
    """
    if all(c.sensor is None for c in channels):
        return
    is_one = len({c.sensor or c.kind for c in channels}) == 1
    # one scale of all that is seen is that of length; starts in time are free
    without = (*_IN_STARTS, "sensor_scale") if is_one else _IN_STARTS
    yield from instrument_causes(channels, scales, late_record=False, without=without)


def needs_impact(study: Study) -> str | None:
    """Tosses that go on through their impact."""
    if not any(run.setup.get("_hits") for run in study.runs):
        return "tosses recorded through their impact"
    return None


def _make_cause(name: str, scales: Scales, system: str, needs: Needs | None = None) -> Effect:
    row = rows(RIGID_BODY)[name]
    own: dict[str, Any] = {} if needs is None else {"needs": needs}
    return row.effect(on_numbers(row), scales.plain[AIR], system=system, **own)
