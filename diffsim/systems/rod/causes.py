"""Candidate causes of a described rod: those that its parts allow."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from diffsim.causes.catalogue import rows
from diffsim.causes.commands import ACTUATOR, CommandGroup, command_causes
from diffsim.causes.instruments import TIMED_COMMANDS, TIMED_READINGS, instrument_causes
from diffsim.causes.ports import on_numbers
from diffsim.causes.scales import Scales
from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.systems.rod.layout import TIP
from diffsim.systems.rod.scene import RodScene

if TYPE_CHECKING:
    from diffsim.systems.rod.keys import RodKeys

ROD = "rod"  # the table, and the kind of system
GAIN = "command_gain"
MATERIAL = (
    "strain_stiffening",
    "compression_stiffening",
    "tip_stiffness",
    "radius_offset",
    "twist_stiffness",
    "stretch_stiffness",
    "rest_bend",
)
TENDONS = (
    "drive_loss",
    "pretension",
    "tendon_friction",
    "tendon_wobble",
    "tendon_end",
    "tendon_distance",
)
# a drive's loss is a dead band, and slack, of its tension
_SAID_OTHERWISE = ("dead_band", "slack")


def measure_scales(given: RodKeys, study: Study) -> Scales:
    """Usual magnitudes of the recordings and of the rod as described.

    Args:
        given: Description.
        study: Study whose runs to fit are looked at, unless its frame has the record.
    """
    kept = Scales.kept_in(study)
    if kept is not None:
        return kept
    volume = sum(
        np.pi / 3.0 * (b.at - a.at) * (a.radius**2 + a.radius * b.radius + b.radius**2)
        for a, b in zip(given.stations, given.stations[1:], strict=False)
    )
    plain = {
        "length": given.stations[-1].at,
        "thickness": given.stations[0].radius,
        "mass": float(volume * given.material.density.value),
        "youngs_modulus": given.material.youngs_modulus.value,
        "nearest": min((p.distance for t in given.tendons for p in t.path), default=1.0),
    }
    return replace(Scales.of_runs(study), plain={ROD: plain})


def list_causes(
    given: RodKeys, study: Study, scales: Scales, *, every: bool = False
) -> tuple[Effect, ...]:
    """Causes that the description leaves room for; what is a base parameter already is none.

    A few poses seldom tell the shape of a command's map, or an instrument, from the rod: unless
    samples are in time, these causes are judged where a study names them.

    Args:
        given: Description.
        study: Study whose sessions and channels say what is possible.
        scales: Usual magnitudes.
        every: Whether causes that are left to a study to name are listed, too.
    """
    every = every or given.is_in_time
    commands = tuple(dict.fromkeys(t.command for t in given.tendons))
    usual = {**scales.plain[ROD], **scales.of_commands(commands)}
    found = [*(_make_cause(name, usual) for name in MATERIAL), *_list_weights(given, usual)]
    found += _list_clamps(given, usual)
    if given.tendons:
        found += _list_commands(given, scales, commands, every=every)
        found += [_make_cause(name, usual) for name in TENDONS]
        names = tuple(t.name for t in given.tendons)
        turns = tuple(f"{n}_tendon_turn" for n in names)
        found += [_make_cause("tendon_turn", usual, turns, components=names)]
        found += [_make_cause("tendon_helix", usual)]
        if len(names) > 1:
            found.append(_make_cause("tendon_crosstalk", usual))
    if given.sessions is not None:
        found += _list_sessions(given, given.sessions, study, usual)
    if every:
        found += instrument_causes(
            study.channels,
            scales,
            late_record=not commands,  # else a late command shows as a late record does
            without=() if given.is_in_time else TIMED_READINGS,
            system=ROD,
        )
    return tuple(found)


def list_numbers(given: RodKeys) -> tuple[str, ...]:
    """Names of all numbers of a described rod that causes may change."""
    added = [n for row in rows(ROD).values() for n in row.add if n != "tendon_turn"]
    each = [f"{t.name}_tendon_turn" for t in given.tendons]
    return tuple(dict.fromkeys([*given.quantities(), f"{TIP}_mass", *added, *each]))


def _make_cause(
    name: str,
    usual: Mapping[str, float],
    numbers: tuple[str, ...] = (),
    *,
    table: str = ROD,
    **own: Any,
) -> Effect:
    """A cause that adds to numbers of the rod: those of its row, or others."""
    row = rows(table)[name]
    row = row.model_copy(update={"add": numbers}) if numbers else row
    return row.effect(on_numbers(row), usual, system=ROD, **own)


def _list_weights(given: RodKeys, usual: Mapping[str, float]) -> Iterator[Effect]:
    if not any(given.gravity):
        return
    main = int(np.abs(np.array(given.gravity)).argmax())
    level = tuple(a for k, a in enumerate("xyz") if k != main)
    tilts = tuple(f"gravity_tilt_{a}" for a in level)
    yield _make_cause("gravity_tilt", usual, tilts, components=level)
    yield _make_cause("tip_mass", usual, table="load")
    yield _make_cause("marker_mass", usual)


def _list_clamps(given: RodKeys, usual: Mapping[str, float]) -> Iterator[Effect]:
    base = given.base
    yield _make_cause("clamped_length", usual)
    if not (base.tilt_y.is_fitted or base.tilt_z.is_fitted):
        yield _make_cause("clamp_tilt", usual)
    if not base.twist.is_fitted:
        yield _make_cause("clamp_twist", usual)
    if not (base.shift_x.is_fitted or base.shift_y.is_fitted or base.shift_z.is_fitted):
        yield _make_cause("clamp_shift", usual)


def _list_commands(
    given: RodKeys, scales: Scales, commands: tuple[str, ...], *, every: bool
) -> list[Effect]:
    """What commands meet on their way to the tendons, their gain alone unless ``every``."""
    left_out = {*_SAID_OTHERWISE} if every else {*rows(ACTUATOR)} - {GAIN}
    if all(t.gain.is_fitted for t in given.tendons):
        left_out.add(GAIN)
    if not given.is_in_time:
        left_out.update(TIMED_COMMANDS)
    group = CommandGroup(
        commands,
        scales.of_commands(commands),
        between=given.between_samples,
        is_one_sided=scales.is_one_sided(commands),
        unit="N",
    )
    return command_causes(group, system=ROD, without=tuple(left_out))


def _list_sessions(
    given: RodKeys, fact: str, study: Study, usual: Mapping[str, float]
) -> Iterator[Effect]:
    """What may have changed between sessions, the first of them as described."""
    labels = tuple(sorted({str(run.setup[fact]) for run in study.runs if fact in run.setup}))
    if len(labels) < 2:
        return

    def change(name: str, *numbers: str, **own: Any) -> Effect:
        """A cause with components of the later sessions."""
        ways = tuple(n.rpartition("_")[2] for n in numbers)
        several = len(labels) > 2
        parts = tuple(f"{w} of {s}" if several else w for s in labels[1:] for w in ways)
        apply = partial(_change_in_session, fact=fact, labels=labels, names=numbers)
        return rows(ROD)[name].effect(apply, usual, components=parts, **own)

    for marker in given.markers:
        ways = (f"{marker}_{way}" for way in ("along", "y", "z"))
        yield change("moved", *ways, ending=f"_{marker}", family=f"moved_{marker}")
    yield change("moved_clamp", "base_twist", "base_tilt_y", "base_tilt_z")
    yield change("aged_material", "youngs_modulus")


def _change_in_session(
    scene: RodScene,
    size: Tensor,
    run: Run,
    *,
    fact: str,
    labels: Sequence[str],
    names: Sequence[str],
) -> RodScene:
    """Numbers larger by the sizes (..., later sessions times names) of the run's session."""
    label = str(run.setup.get(fact, labels[0]))
    if label not in labels[1:]:  # the first, or one that was never fitted: as described
        return scene
    session = labels.index(label) - 1
    for i, name in enumerate(names):
        own = size[..., session * len(names) + i]
        scene = scene.with_number(name, lambda value, own=own: value + own)  # type: ignore[misc]
    return scene


__all__ = ["list_causes", "list_numbers", "measure_scales"]
