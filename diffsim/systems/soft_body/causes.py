"""Candidate causes of a described soft body: the rows that its parts allow, and their functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from diffsim.causes.catalogue import rows
from diffsim.causes.channel_groups import ChannelGroup, channel_groups, channels_of
from diffsim.causes.commands import CommandGroup, command_causes
from diffsim.causes.ports import on_clock, on_numbers, on_readings
from diffsim.causes.readings import (
    SENSOR,
    instrument_of,
    pace,
    reading_cause,
    reading_causes,
    usual_sample,
)
from diffsim.causes.row import spell_plainly
from diffsim.causes.scales import SCALES, Scales
from diffsim.identify.effect import Apply, Effect, needs_nothing
from diffsim.identify.unknown import Unknown, UnknownForce, smooth_covariance
from diffsim.systems.soft_body import forces, loads, material, sensor
from diffsim.systems.soft_body.hanging import hang_slack
from diffsim.systems.soft_body.pulling import unknown_pull
from diffsim.systems.soft_body.readings import main_axis
from diffsim.systems.soft_body.support import needs_record, support_of
from diffsim.systems.soft_body.unknown import unknown_force

if TYPE_CHECKING:
    from diffsim.data.study import Study
    from diffsim.systems.soft_body.body_keys import SoftBodyKeys

SYSTEM = "soft_body"
SUPPORT = ("support_x_m", "support_z_m")  # places of a support that nobody names otherwise
BODY, TIMED = "body", "is_timed"  # of the scales: magnitudes of the body; whether time matters
MOST_KNOTS = 16
KNOTS_PER_S = 6.0
SLIP_SPEED = 1e-2  # below which dry friction grows linearly [m/s]
PULL_SHARE = 0.1  # of the command's range: a pull that nothing explains and is no surprise
# from the motor to the body: the slack of a tendon lies behind what limits the motor
ON_THE_WAY = (
    *("quantization", "lag", "dead_band", "backlash", "saturation", "command_gain", "rate_limit"),
    *("slack", "delay", "gain_slope", "command_offset"),
)
# of commands and of readings: what poses without a past do not show
OVER_TIME = ("lag", "delay", "rate_limit", "backlash")
READ_OVER_TIME = ("sensor_delay", "sensor_lag", "sensor_drift", "sensor_backlash")

#: What causes do that no port says, by the names of their rows.
ACTS: Mapping[str, Apply] = MappingProxyType(
    {
        "loss_factor": material.lose_in_motion,
        "creep": material.creep,
        "stiffening": material.stiffen_by_strain,
        "stiffness_loss": material.lose_stiffness,
        "temperature_drift": material.drift_with_order,
        "body_scale": loads.enlarge_body,
        "dry_friction": forces.dry_friction(SLIP_SPEED),
        "linear_drag": forces.drag(forces.areas_of, quadratic=False),
        "quadratic_drag": forces.drag(forces.areas_of, quadratic=True),
        "added_mass": forces.add_fluid_mass,
        "current": forces.move_fluid,
        "weight": forces.change_weight,
        "tilt": forces.tilt_gravity,
        "tip_mass": loads.load_free_end,
        "load_inertia": loads.attach_load,
        "slack_string": hang_slack,
        "placement": sensor.displace,
        "sensor_tilt": sensor.tilt_camera,
        "lens": sensor.distort,
    }
)
_UNITS = {"dry_friction": "N"}
_TABLES = ("material", "surroundings", "force", "load", "camera")


def body_cause(
    name: str, scales: Mapping[str, float] | None = None, apply: Apply | None = None, **own: Any
) -> Effect:
    """A cause in a soft body, around it or in the cameras.

    Args:
        name: Name of its row.
        scales: Usual magnitudes that the row may use.
        apply: How it acts where that depends on the description; None: as ``ACTS`` or the row says.
        **own: Fields of the effect that differ, as for :meth:`diffsim.causes.Row.effect`.
    """
    row = next(rows(table)[name] for table in _TABLES if name in rows(table))
    acts = apply or ACTS.get(name) or on_numbers(row)
    unit = {"unit": _UNITS[name]} if name in _UNITS else {}
    return row.effect(acts, scales, system=SYSTEM, **{**unit, **own})


def library(given: SoftBodyKeys, study: Study, scales: Scales) -> tuple[Effect, ...]:
    """Causes that the description leaves room for.

    What is a base parameter already is no cause beside it: the two could not be told apart.

    Args:
        given: Description of the body.
        study: Study with the recordings.
        scales: Usual magnitudes, see ``scales_of``.
    """
    still = given.numerics.motion == "quasi_static"
    # stiffening goes by iteration, which large poses leave
    found = [] if still else ["loss_factor", "creep", "stiffness_damping", "stiffening"]
    if given.material.rayleigh_beta.is_fitted and not still:
        found.remove("stiffness_damping")
    found += ["stiffness_loss", "temperature_drift", *_list_surroundings(given, still)]
    causes = [body_cause(name) for name in found]
    if given.water is not None and not still:
        causes.append(body_cause("current", needs=needs_nothing))
        if not given.water.added_mass.is_fitted:
            causes.append(body_cause("added_mass"))
    causes.append(body_cause("body_scale"))
    causes += _list_loads(given, scales, still)
    causes += _list_commands(given, study, scales)
    return (*causes, *_list_cameras(given, study, scales), *_list_instruments(given, study, scales))


def scales_of(given: SoftBodyKeys, study: Study, mass_kg: float) -> Scales:
    """Usual magnitudes; of a study with a ``frame``, those of the saved model.

    Args:
        given: Description of the body.
        study: Study with the recordings.
        mass_kg: Mass of the body [kg].

    Raises:
        ValueError: the frame has none.
    """
    if not study.frame:
        facts = {TIMED: is_timed(given, study)}
        return replace(Scales.of_runs(study), plain={BODY: {"mass": mass_kg}}, facts=facts)
    kept = Scales.kept_in(study)
    if kept is None:
        raise ValueError(f"the saved model has no {SCALES}, as older ones have none; fit it again")
    return kept


def usual_motion(given: SoftBodyKeys, scales: Scales) -> dict[str, float]:
    """How far markers move: the widest channel; how fast: as far in a tenth of the longest run.

    Args:
        given: Description of the body.
        scales: Usual magnitudes of the recordings.
    """
    seen = [name for name, reading in given.channels.items() if reading.axis is not None]
    distance = max((scales.of_channels([name])["width"] for name in seen), default=1.0)
    return {"distance": distance, "speed": 10.0 * distance / (scales.longest_s or 1.0)}


def is_timed(given: SoftBodyKeys, study: Study) -> bool:
    """Whether time matters: something moves by itself, or commands were recorded over time."""
    is_still = given.numerics.motion == "quasi_static"
    is_long = any(len(r.time_s) > 2 for r in study.runs)
    return not is_still or (bool(given.commands) and is_long)


def _list_surroundings(given: SoftBodyKeys, still: bool) -> list[str]:
    found = [] if still else ["linear_drag", "quadratic_drag", "dry_friction"]
    if any(given.gravity.vector):
        found.append("weight")
        if not given.gravity.roll.is_fitted and not given.gravity.pitch.is_fitted:
            found.append("tilt")
    return found


def _list_loads(given: SoftBodyKeys, scales: Scales, still: bool) -> list[Effect]:
    weighs = any(given.gravity.vector) or not still
    found = [body_cause("tip_mass", scales.plain[BODY])] if weighs else []
    if any(load.acts_as == "weight" for load in given.masses) and not still:
        found.append(body_cause("load_inertia"))
    if given.slack_string is not None:
        found.append(replace(body_cause("slack_string"), typical=given.slack_string))
    if given.support is not None:
        found.append(support_motion(given.support.x, given.support.z, given.support.faster_than))
    if given.vibration is not None and not still:
        hertz, axes = given.vibration.frequency, given.vibration.axes
        parts = tuple(f"{a}_{s}" for a in axes for s in ("cos", "sin"))
        acts = loads.shaking_of(hertz, axes)
        found.append(body_cause("base_vibration", {"frequency": hertz}, acts, components=parts))
    for stop in given.stops:
        acts = loads.stop_of(stop.where, stop.direction, stop.gap)
        found.append(body_cause("one_sided_stop", {"gap": 1e3 * stop.gap}, acts))
    return found


def _list_commands(given: SoftBodyKeys, study: Study, scales: Scales) -> list[Effect]:
    if not given.commands:
        return []
    # of a command that only pulls, slack and dead band are one
    pulls_only = bool(given.tendons) and scales.is_one_sided(given.commands)
    units = {c.name: c.unit for c in study.commands}
    unit = (units.get(given.commands[0]) if len(given.commands) == 1 else None) or "-"
    group = CommandGroup(
        given.commands,
        scales.of_commands(given.commands),
        is_one_sided=pulls_only,
        unit=unit,
        shown="mm" if unit == "m" else None,
    )
    without = [] if pulls_only else ["slack"]
    drives = (*given.tendons, *given.muscles, *given.chambers)
    if all(d.gain.is_fitted for d in drives):
        without.append("command_gain")
    if given.clock.offset.is_fitted:
        without.append("delay")
    if not scales.facts[TIMED]:
        without += OVER_TIME
    found = command_causes(group, system=SYSTEM, without=without)
    return sorted(found, key=lambda cause: ON_THE_WAY.index(cause.name))


def _list_cameras(given: SoftBodyKeys, study: Study, scales: Scales) -> list[Effect]:
    """Causes in what all channels share."""
    readings = given.channels.values()
    turns = (given.camera.roll, given.camera.pitch, given.camera.yaw)
    every = ChannelGroup("", tuple(c.name for c in study.channels))
    whole = instrument_of(every, study.channels, scales)
    found = []
    if scales.facts[TIMED]:
        if not given.clock.offset.is_fitted and not _begins_with_command(given):
            found.append(reading_cause("sensor_delay", whole, system=SYSTEM))
        found += [] if given.clock.rate.is_fitted else [body_cause("clock_rate")]
    if not given.camera.scale.is_fitted and not all(r.scale.is_fitted for r in readings):
        found.append(reading_cause("sensor_scale", whole, system=SYSTEM))
    if not all(r.zero.is_fitted for r in readings) and given.camera.relative_to != "first":
        found.append(body_cause("placement"))
    if not any(q.is_fitted for q in turns):
        found.append(body_cause("sensor_tilt"))
    return [*found, body_cause("lens")]


def _begins_with_command(given: SoftBodyKeys) -> bool:
    """Whether all motion comes from commands, so that a late record is a late command."""
    is_still = given.numerics.motion == "quasi_static" or given.start.shape == "equilibrium"
    return bool(given.commands) and is_still and given.support is None


def _list_instruments(given: SoftBodyKeys, study: Study, scales: Scales) -> list[Effect]:
    """Causes in each stated sensor, but what is a base parameter of theirs already."""
    if all(c.sensor is None for c in study.channels):
        return []
    readings = given.channels.items()
    fitted = {
        "sensor_offset": {name for name, r in readings if r.zero.is_fitted},
        "sensor_scale": {name for name, r in readings if r.scale.is_fitted},
    }
    clocks = [channels_of(study.channels, name) for name in given.clocks]
    found: list[Effect] = []
    for group in channel_groups(study.channels, late_record=False):
        if len(group.channels) == len(study.channels):
            continue  # of all channels: causes of the whole record
        left_out = {name for name, own in fitted.items() if set(group.channels) <= own}
        left_out |= {"sensor_delay"} if group.channels in clocks else set()
        left_out |= set() if scales.facts[TIMED] else set(READ_OVER_TIME)
        tried = tuple(name for name in group.causes if name not in left_out)
        instrument = instrument_of(replace(group, causes=tried), study.channels, scales)
        ending = f"_of_{spell_plainly(group.name)}"
        found += reading_causes(replace(instrument, ending=ending), system=SYSTEM)
    return list(pace(found, usual_sample(study.runs)))


def soft_body_library(reach: float = 0.1) -> tuple[Effect, ...]:
    """Causes in soft bodies, around them, in their actuators and in the cameras, of any body.

    Args:
        reach: Greatest magnitude of the command, in its unit.
    """
    named = (
        *("stiffness_damping", "loss_factor", "creep", "stiffening", "stiffness_loss"),
        *("temperature_drift", "linear_drag", "quadratic_drag", "added_mass", "weight", "tilt"),
        *("current", "dry_friction"),
    )
    sensors = rows(SENSOR)
    return (
        *(body_cause(name) for name in named),
        support_motion(*SUPPORT),
        *command_causes(CommandGroup((), dict.fromkeys(("reach", "width", "rate"), reach))),
        sensors["sensor_delay"].effect(on_clock(())),
        sensors["sensor_scale"].effect(on_readings(sensors["sensor_scale"], ())),
        *(body_cause(name) for name in ("clock_rate", "placement", "sensor_tilt", "lens")),
    )


def support_motion(x: str, z: str, faster_hz: float | None = None) -> Effect:
    """The effect of a support that moves as its markers show.

    Args:
        x, z: Commands with its places along the body and up [m].
        faster_hz: What is faster is noise [Hz]; None: nothing is.
    """
    acts = support_of((x, z), faster_hz)
    return body_cause("support_motion", apply=acts, needs=partial(needs_record, names=(x, z)))


def command_reach(scales: Scales, names: Sequence[str]) -> tuple[float, float]:
    """Least and greatest command of what was fitted, 0 included."""
    own = [scales.commands[name] for name in names if name in scales.commands]
    return min([0.0, *(c.low for c in own)]), max([0.0, *(c.high for c in own)])


def unknowns(given: SoftBodyKeys, study: Study, scales: Scales) -> tuple[Unknown, ...]:
    """A smooth force along the axes that are seen, and a smooth change of a single command."""
    until_s = max(float(r.time_s[-1] - r.time_s[0]) for r in study.runs)
    if given.numerics.motion == "quasi_static" or until_s <= 0.0:
        return ()
    until_s += given.start.lead_in
    count = min(max(4, round(KNOTS_PER_S * until_s) + 1), MOST_KNOTS)
    knots = np.linspace(0.0, until_s, count)
    spacing = until_s / (count - 1)
    in_time = smooth_covariance(knots, 2.0 * spacing)
    axes = "".join(a for k, a in enumerate("xyz") if k in seen_axes(given, study))
    shapes = np.kron(np.eye(2 * len(axes)), in_time).astype(np.float64)
    found: list[Unknown] = [UnknownForce(unknown_force(count, until_s, axes), shapes)]
    if len(given.commands) == 1:
        width = scales.of_commands(given.commands)["width"]
        effect = replace(unknown_pull(count, spacing), typical=PULL_SHARE * width)
        found.append(UnknownForce(effect, in_time, "unknown pull of the actuators"))
    return tuple(found)


def seen_axes(given: SoftBodyKeys, study: Study) -> set[int]:
    """Axes of space that the channels show displacements along."""
    readings = [given.channels[c.name] for c in study.channels]
    return {main_axis(r) for r in readings if r.axis is not None} or {0, 1, 2}


__all__ = [
    "body_cause",
    "command_reach",
    "library",
    "scales_of",
    "soft_body_library",
    "support_motion",
    "unknowns",
    "usual_motion",
]
