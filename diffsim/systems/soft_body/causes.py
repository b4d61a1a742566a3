"""What a described soft body tells of itself to causes, and what its own functions do."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.channel_groups import ChannelGroup, channel_groups, channels_of
from diffsim.causes.commands import CommandGroup
from diffsim.causes.plant import IN_TIME, Place, Plant
from diffsim.causes.readings import Instrument, instrument_of, usual_sample
from diffsim.causes.row import spell_plainly
from diffsim.causes.scales import Scales
from diffsim.core.rotation import matrix_from_rotation_vector
from diffsim.core.units import GRAVITY
from diffsim.data.study import Run
from diffsim.identify.effect import Apply
from diffsim.identify.unknown import Unknown, UnknownForce, smooth_covariance
from diffsim.systems.soft_body import forces, loads, material
from diffsim.systems.soft_body.hanging import hang_slack
from diffsim.systems.soft_body.readings import main_axis
from diffsim.systems.soft_body.scene import CLOCK_RATE, NUMBERS, SoftScene
from diffsim.systems.soft_body.support import move_support
from diffsim.systems.soft_body.unknown import unknown_force, unknown_pull

if TYPE_CHECKING:
    from diffsim.data.study import Study
    from diffsim.systems.soft_body.body_keys import SoftBodyKeys


def displace(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """Everything measured, displaced by ``size``, (3,) [m]."""
    axes = list(scene.axes)
    return scene.with_reading((), lambda y, grid: y + size[axes][:, None])


def tilt_camera(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """Measured in axes that are turned by ``size``, a rotation vector (3,) [rad]."""
    if scene.rest_places is None:
        cross = torch.linalg.cross
        return _change_points(scene, "sensor_tilt", lambda u: u + cross(size.expand_as(u), u))
    return _change_points(scene, "sensor_tilt", lambda u: u @ matrix_from_rotation_vector(size).T)


def distort(scene: SoftScene, size: Tensor, run: Run) -> SoftScene:
    """Radial distortion y (1 + size |y|^2) of each point, (1,) [1/m^2]."""

    def bend(u: Tensor) -> Tensor:
        return u * (1.0 + size[0] * (u * u).sum(-1, keepdim=True))

    return _change_points(scene, "lens", bend)


def _change_points(scene: SoftScene, effect: str, change: Callable[[Tensor], Tensor]) -> SoftScene:
    """Change displacements (num_samples, num_points, 3): of markers, else of the channels."""
    rest = scene.rest_places
    if rest is None:
        _require_triples(scene, effect)
        return scene.with_reading((), lambda y, grid: change(_split_triples(y.mT)).flatten(1).mT)
    return scene.with_places(lambda y, t: rest + change(_split_triples(y - rest)).reshape(y.shape))


def _split_triples(y: Tensor) -> Tensor:
    return y.reshape(len(y), -1, 3)


def _require_triples(scene: SoftScene, effect: str) -> None:
    if scene.axes != (0, 1, 2) * (len(scene.axes) // 3):
        raise ValueError(
            f"{effect} needs channels in triples x, y, z, got the axes {scene.axes}; leave it out "
            "of the library or give all three"
        )


SOFT_BODY = "soft_body"  # the kind of system, and its table
BODY, TIMED = "body", "is_timed"  # of the scales: magnitudes of the body; whether time matters
PULL_SHARE = 0.1  # of the command's range: a pull that nothing explains and is no surprise

#: What causes do that no port says, by the names of their rows.
FUNCTIONS: Mapping[str, Apply] = MappingProxyType(
    {
        "loss_factor": material.lose_in_motion,
        "creep": material.creep,
        "stiffening": material.stiffen_by_strain,
        "stiffness_loss": material.lose_stiffness,
        "temperature_drift": material.drift_with_order,
        "body_scale": loads.enlarge_body,
        "dry_friction": partial(forces.rub_nodes, slip_speed=0.01),
        "linear_drag": partial(forces.drag_nodes, shares=forces.areas_of, quadratic=False),
        "quadratic_drag": partial(forces.drag_nodes, shares=forces.areas_of, quadratic=True),
        "added_mass": forces.add_fluid_mass,
        "current": forces.move_fluid,
        "weight": forces.change_weight,
        "tilt": forces.tilt_gravity,
        "tip_mass": loads.load_free_end,
        "load_inertia": loads.attach_load,
        "slack_string": hang_slack,
        "placement": displace,
        "sensor_tilt": tilt_camera,
        "lens": distort,
    }
)


def plant_of(given: SoftBodyKeys, study: Study, scales: Scales, places: Collection[str]) -> Plant:
    """What a described soft body tells of itself.

    Args:
        scales: Usual magnitudes, see ``scales_of``.
        places: Names of the places where forces may act.
    """
    moves = given.numerics.motion != "quasi_static"
    weight = scales.plain[BODY]["mass"]
    usual = {"push": PULL_SHARE * GRAVITY * weight, **usual_motion(given, scales)}
    quantities = {name for name, q in given.quantities().items() if q.is_fitted}
    has_gravity = any(given.gravity.vector)
    return Plant(
        kind=SOFT_BODY,
        scales=scales,
        channels=study.channels,
        commands=dict.fromkeys(given.commands, "straight"),
        ways=_list_ways(given, study, scales),
        numbers=_list_numbers(given, scales, moves=moves),
        fitted=quantities,
        places=dict.fromkeys(places, Place(usual)) if moves else {},
        facts={
            IN_TIME: bool(scales.facts[TIMED]),
            "moves": moves,
            "speed": moves,
            "gravity": has_gravity,
            "weighs": has_gravity or moves,
            "water": given.water is not None,
            "hung_weights": any(load.acts_as == "weight" for load in given.masses),
            "catches": given.slack_string is not None,
            "added_mass_is_fitted": "water_added_mass" in quantities,
            "tilt_is_fitted": bool(quantities & {"gravity_roll", "gravity_pitch"}),
            "zeros_are_fitted": given.camera.relative_to == "first"
            or all(r.zero.is_fitted for r in given.channels.values()),
            "camera_is_fitted": bool(quantities & {f"camera_{a}" for a in _TURNS}),
        },
        parts=_list_parts(given),
        functions={**FUNCTIONS, **_list_functions(given, moves=moves)},
        magnitudes=_list_magnitudes(given, weight),
        instruments=_list_instruments(given, study, scales),
        record=_make_record(given, study, scales),
        sample_s=usual_sample(study.runs),
    )


_TURNS = ("roll", "pitch", "yaw")


def _list_numbers(given: SoftBodyKeys, scales: Scales, *, moves: bool) -> tuple[str, ...]:
    absent = set() if scales.facts[TIMED] else {CLOCK_RATE}
    absent |= set() if moves else {"rayleigh_alpha", "rayleigh_beta"}
    absent |= set() if given.tendons or given.muscles else {"fiber_stiffness"}
    return tuple(name for name in NUMBERS if name not in absent)


def _list_ways(given: SoftBodyKeys, study: Study, scales: Scales) -> tuple[CommandGroup, ...]:
    if not given.commands:
        return ()
    # of a command that only pulls, slack and dead band are one
    pulls_only = bool(given.tendons) and scales.is_one_sided(given.commands)
    units = {c.name: c.unit for c in study.commands}
    unit = (units.get(given.commands[0]) if len(given.commands) == 1 else None) or "-"
    drives = (*given.tendons, *given.muscles, *given.chambers)
    facts = {
        "pushes": not pulls_only,
        "gain_is_fitted": all(d.gain.is_fitted for d in drives),
        "clock_is_fitted": given.clock.offset.is_fitted,
    }
    group = CommandGroup(
        given.commands,
        scales.of_commands(given.commands),
        is_one_sided=pulls_only,
        unit=unit,
        shown="mm" if unit == "m" else None,
        facts=tuple(name for name, holds in facts.items() if holds),
    )
    return (group,)


def _list_parts(given: SoftBodyKeys) -> dict[str, dict[str, str]]:
    """Cosine and sine of each axis along which the base shakes."""
    if given.vibration is None:
        return {}
    names = [f"{a}_{s}" for a in given.vibration.axes for s in ("cos", "sin")]
    return {"shaking": {name: name for name in names}}


def _list_functions(given: SoftBodyKeys, *, moves: bool) -> dict[str, Apply]:
    """What is in the way of the body, what holds it, and what shakes it."""
    found: dict[str, Apply] = {}
    if given.support is not None:
        at = given.support
        found["support_motion"] = partial(
            move_support, names=(at.x, at.z), faster_hz=at.faster_than
        )
    if given.vibration is not None and moves:
        found["base_vibration"] = partial(loads.shake_base, shaken=given.vibration)
    if len(given.stops) > 1:
        raise ValueError(f"stops: one stop can be judged, got {len(given.stops)}; name one")
    for stop in given.stops:
        found["one_sided_stop"] = partial(loads.stop_nodes, stop=stop)
    return found


def _list_magnitudes(given: SoftBodyKeys, mass: float) -> dict[str, float]:
    found = {"mass": mass}
    if given.slack_string is not None:
        found["fall"] = given.slack_string
    if given.vibration is not None:
        found["frequency"] = given.vibration.frequency
    if given.stops:
        found["gap"] = 1e3 * given.stops[0].gap
    return found


def _make_record(given: SoftBodyKeys, study: Study, scales: Scales) -> Instrument:
    """All channels as one instrument, whose clock and scale may be off."""
    every = ChannelGroup("", tuple(c.name for c in study.channels))
    causes = []
    if not given.clock.offset.is_fitted and not _begins_with_command(given):
        causes.append("sensor_delay")
    if not given.camera.scale.is_fitted and not all(
        r.scale.is_fitted for r in given.channels.values()
    ):
        causes.append("sensor_scale")
    return replace(instrument_of(every, study.channels, scales), causes=tuple(causes))


def _begins_with_command(given: SoftBodyKeys) -> bool:
    """Whether all motion comes from commands, so that a late record is a late command."""
    is_still = given.numerics.motion == "quasi_static" or given.start.shape == "equilibrium"
    return bool(given.commands) and is_still and given.support is None


def _list_instruments(given: SoftBodyKeys, study: Study, scales: Scales) -> tuple[Instrument, ...]:
    """Each stated sensor, but what is a base parameter of its channels already."""
    if all(c.sensor is None for c in study.channels):
        return ()
    readings = given.channels.items()
    fitted = {
        "sensor_offset": {name for name, r in readings if r.zero.is_fitted},
        "sensor_scale": {name for name, r in readings if r.scale.is_fitted},
    }
    clocks = [channels_of(study.channels, name) for name in given.clocks]
    found = []
    for group in channel_groups(study.channels, late_record=False):
        if len(group.channels) == len(study.channels):
            continue  # of all channels: causes of the whole record
        left_out = {name for name, own in fitted.items() if set(group.channels) <= own}
        left_out |= {"sensor_delay"} if group.channels in clocks else set()
        tried = tuple(name for name in group.causes if name not in left_out)
        instrument = instrument_of(replace(group, causes=tried), study.channels, scales)
        found.append(replace(instrument, ending=f"_of_{spell_plainly(group.name)}"))
    return tuple(found)


def scales_of(given: SoftBodyKeys, study: Study, mass_kg: float) -> Scales:
    """Usual magnitudes; of a study with a ``frame``, those of the saved model.

    Args:
        mass_kg: Mass of the body [kg].

    Raises:
        ValueError: the frame has none.
    """
    measured = Scales.of(study, {BODY: {"mass": mass_kg}})
    return measured if study.frame else replace(measured, facts={TIMED: is_timed(given, study)})


def usual_motion(given: SoftBodyKeys, scales: Scales) -> dict[str, float]:
    """How far markers move: the widest channel; how fast: as far in a tenth of the longest run.

    Args:
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
    count = min(max(4, round(6.0 * until_s) + 1), 16)  # six a second, in all at most 16
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
