"""Candidate causes of a described soft body: those that its parts allow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from diffsim.causes.commands import BACKLASH, DEAD_BAND, LAG, SATURATION, in_words, quantization
from diffsim.identify.effect import Effect
from diffsim.identify.unknown import Unknown, UnknownForce, smooth_covariance
from diffsim.systems.soft_body import forces, material, sensor
from diffsim.systems.soft_body.hanging import SLACK_STRING
from diffsim.systems.soft_body.loads import (
    BODY_SCALE,
    LOAD_INERTIA,
    base_vibration,
    one_sided_stop,
    tip_mass,
)
from diffsim.systems.soft_body.pulling import PULLING, unknown_pull
from diffsim.systems.soft_body.readings import main_axis
from diffsim.systems.soft_body.support import support_motion
from diffsim.systems.soft_body.unknown import unknown_force

if TYPE_CHECKING:
    from diffsim.data.study import Study
    from diffsim.systems.soft_body.body_keys import SoftBodyKeys

REACH, TIMED = "reach", "timed"  # their places in a study's frame
MOST_KNOTS = 16
KNOTS_PER_S = 6.0
TYPICAL_SHARE = 0.1  # of the commanded range: slack, play and dead band that are no surprise
LIMIT_SHARE = 4.0  # a limit is felt where it is well below what is commanded
TYPICAL_MASS = 0.1  # of the body's mass


def library(given: SoftBodyKeys, study: Study, mass_kg: float) -> tuple[Effect, ...]:
    """Causes that the description leaves room for.

    What is a base parameter already is no cause beside it: the two could not be told apart.

    Args:
        given: Description of the body.
        study: Study whose commands say what sizes are usual.
        mass_kg: Mass of the body [kg].
    """
    still = given.numerics.motion == "quasi_static"
    timed = is_timed(given, study)
    found: list[Effect] = [] if still else [material.LOSS_FACTOR, material.CREEP]
    if not given.material.rayleigh_beta.is_fitted and not still:
        found.append(material.STIFFNESS_DAMPING)
    if not still:  # by iteration, which large poses leave
        found.append(material.STIFFENING)
    found += [material.STIFFNESS_LOSS, material.TEMPERATURE_DRIFT]
    found += _of_surroundings(given, still)
    found += _of_loads(given, study, mass_kg, still)
    found += _of_commands(given, study, timed)
    return (*found, *_of_cameras(given, timed))


def is_timed(given: SoftBodyKeys, study: Study) -> bool:
    """Whether time matters: something moves by itself, or commands were recorded over time."""
    if TIMED in study.frame:
        return bool(study.frame[TIMED])
    is_still = given.numerics.motion == "quasi_static"
    is_long = any(len(r.time_s) > 2 for r in study.runs)
    return not is_still or (bool(given.commands) and is_long)


def _of_surroundings(given: SoftBodyKeys, still: bool) -> list[Effect]:
    found = [] if still else [forces.LINEAR_DRAG, forces.QUADRATIC_DRAG, forces.DRY_FRICTION]
    if any(given.gravity.vector):
        found.append(forces.WEIGHT)
        if not given.gravity.roll.is_fitted and not given.gravity.pitch.is_fitted:
            found.append(forces.TILT)
    if given.water is not None and not still:
        found.append(replace(forces.CURRENT, needs=lambda study: None))
        if not given.water.added_mass.is_fitted:
            found.append(forces.ADDED_MASS)
    found.append(BODY_SCALE)
    return found


def _of_loads(given: SoftBodyKeys, study: Study, mass_kg: float, still: bool) -> list[Effect]:
    weighs = any(given.gravity.vector) or not still
    found = [tip_mass(TYPICAL_MASS * mass_kg)] if weighs else []
    if any(load.acts_as == "weight" for load in given.masses) and not still:
        found.append(LOAD_INERTIA)
    if given.slack_string is not None:
        found.append(replace(SLACK_STRING, typical=given.slack_string))
    if given.support is not None:
        found.append(support_motion(given.support.x, given.support.z, given.support.faster_than))
    if given.vibration is not None and not still:
        found.append(base_vibration(given.vibration.frequency, given.vibration.axes))
    found += [one_sided_stop(s.where, s.direction, s.gap) for s in given.stops]
    return found


def _of_commands(given: SoftBodyKeys, study: Study, timed: bool) -> list[Effect]:
    if not given.commands:
        return []
    width, rate = commanded(study, given.commands)
    drives = (*given.tendons, *given.muscles, *given.chambers)
    sized = {
        "dead_band": TYPICAL_SHARE * width,
        "backlash": TYPICAL_SHARE * width,
        "slack": TYPICAL_SHARE * width,
        "rate_limit": LIMIT_SHARE / rate,
    }
    reach = max(np.abs(fitted_reach(study, given.commands)))
    found = [quantization(reach or 1.0), LAG, DEAD_BAND, BACKLASH, SATURATION, *PULLING]
    if all(d.gain.is_fitted for d in drives):
        found = [e for e in found if e.name != "command_gain"]
    if not timed:
        found = [e for e in found if e.name not in ("lag", "rate_limit", "backlash")]
    # of a command that only pulls, slack and dead band are one
    pulls_only = bool(given.tendons) and fitted_reach(study, given.commands)[0] >= 0.0
    doubled = "dead_band" if pulls_only else "slack"
    found = [e for e in found if e.name != doubled]
    units = {c.name: c.unit for c in study.commands}
    unit = (units.get(given.commands[0]) if len(given.commands) == 1 else None) or "-"
    found = [in_words(e, unit, "mm" if unit == "m" else None) for e in found]
    return [replace(e, typical=sized[e.name]) if e.name in sized else e for e in found]


def _of_cameras(given: SoftBodyKeys, timed: bool) -> list[Effect]:
    readings = given.channels.values()
    turns = (given.camera.roll, given.camera.pitch, given.camera.yaw)
    found = []
    if timed:
        found += [] if given.clock.offset.is_fitted else [sensor.CLOCK_OFFSET]
        found += [] if given.clock.rate.is_fitted else [sensor.CLOCK_RATE]
    if not given.camera.scale.is_fitted and not all(r.scale.is_fitted for r in readings):
        found.append(sensor.SENSOR_SCALE)
    if not all(r.zero.is_fitted for r in readings) and given.camera.relative_to != "first":
        found.append(sensor.PLACEMENT)
    if not any(q.is_fitted for q in turns):
        found.append(sensor.SENSOR_TILT)
    found.append(sensor.LENS)
    return found


def commanded(study: Study, names: Sequence[str]) -> tuple[float, float]:
    """Range of the commands, and the greatest rate that most of a record stays below [1/s]."""
    widths, rates = [], []
    for run in study.runs:
        for name in names:
            values = np.asarray(run.command[name], dtype=np.float64)
            known = np.isfinite(values)
            if known.sum() < 1:
                continue
            widths.append(float(np.ptp(values[known])))
            if known.sum() > 2:
                rate = np.abs(np.diff(values[known])) / np.diff(np.asarray(run.time_s)[known])
                rates.append(float(np.percentile(rate, 90)))
    return max([*widths, 1e-12]), max([*rates, 1e-12])


def commanded_reach(study: Study, names: Sequence[str]) -> tuple[float, float]:
    """Least and greatest command of the study and of its ``frame``, 0 included."""
    every = np.concatenate([np.asarray(r.command[n], float) for r in study.runs for n in names])
    known = every[np.isfinite(every)]
    low, high = study.frame.get(REACH) or (0.0, 0.0)
    return min(0.0, low, float(known.min())), max(0.0, high, float(known.max()))


def fitted_reach(study: Study, names: Sequence[str]) -> tuple[float, float]:
    """Least and greatest command of what was fitted: of the ``frame``, else of the study."""
    low, high = study.frame.get(REACH) or commanded_reach(study, names)
    return low, high


def unknowns(given: SoftBodyKeys, study: Study) -> tuple[Unknown, ...]:
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
        width, _ = commanded(study, given.commands)
        effect = replace(unknown_pull(count, spacing), typical=TYPICAL_SHARE * width)
        found.append(UnknownForce(effect, in_time, "unknown pull of the actuators"))
    return tuple(found)


def seen_axes(given: SoftBodyKeys, study: Study) -> set[int]:
    """Axes of space that the channels show displacements along."""
    readings = [given.channels[c.name] for c in study.channels]
    return {main_axis(r) for r in readings if r.axis is not None} or {0, 1, 2}


__all__ = ["commanded", "commanded_reach", "fitted_reach", "is_timed", "library", "unknowns"]
