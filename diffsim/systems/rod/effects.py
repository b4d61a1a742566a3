"""Candidate causes of a described rod: those that its parts allow."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.systems.adding import adding
from diffsim.systems.rod.layout import TIP
from diffsim.systems.rod.scene import RodScene

if TYPE_CHECKING:
    from diffsim.systems.rod.keys import RodKeys

SHARE = 0.1  # of the commanded range: losses that are no surprise
PLACED_TO = 5e-3  # a marker is put back to this [m]


def library(given: RodKeys, study: Study) -> tuple[Effect, ...]:
    """Causes that the description leaves room for; what is a base parameter already is none.

    Args:
        given: Description.
        study: Study whose commands and sessions say what is possible.
    """
    length, thickness = given.stations[-1].at, given.stations[0].radius
    found = [*_of_material(length, thickness), *_of_weight(given), *_of_holding(given, length)]
    if given.tendons:
        found += _of_tendons(given, study, length)
    if given.sessions is not None:
        found += _of_sessions(given, given.sessions, study)
    return tuple(found)


def _of_material(length: float, thickness: float) -> Iterator[Effect]:
    yield Effect(
        name="strain_stiffening",
        form="Bending stiffness grows by the share size (radius times bend)^2.",
        family="stiffness",
        kind="material",
        unit="-",
        typical=2.0,
        also_looks_like=("strain softening, if negative", "tendons that leave their channel"),
        apply=adding("strain_stiffening"),
    )
    yield Effect(
        name="tip_stiffness",
        form="Young's modulus is larger by the share size at the tip than at the base, on average "
        "the same.",
        family="stiffness",
        kind="material",
        unit="-",
        shown_unit="%",
        typical=0.2,
        also_looks_like=("a radius that tapers otherwise", "cure from one end"),
        apply=adding("tip_stiffness"),
    )
    yield Effect(
        name="radius_offset",
        form="The rod is thicker by size everywhere.",
        family="stiffness",
        kind="material",
        unit="m",
        typical=0.03 * thickness,
        also_looks_like=("tip stiffness",),
        apply=adding("radius_offset"),
    )
    yield Effect(
        name="twist_stiffness",
        form="Stiffness against twist is larger by the share size.",
        family="twist",
        kind="material",
        unit="-",
        shown_unit="%",
        typical=0.3,
        apply=adding("twist_stiffness"),
    )
    yield Effect(
        name="stretch_stiffness",
        form="Stiffness against stretch is larger by the share size.",
        family="stretch",
        kind="material",
        unit="-",
        shown_unit="%",
        typical=0.3,
        also_looks_like=("sleeves in the channels of the tendons",),
        apply=adding("stretch_stiffness"),
    )
    yield Effect(
        name="rest_bend",
        form="Without loads the rod is bent by size towards local y and z.",
        family="rest",
        kind="material",
        unit="1/m",
        typical=0.2 / length,
        components=("y", "z"),
        also_looks_like=("a creep that stays", "a clamp that is turned"),
        apply=adding("rest_bend_y", "rest_bend_z"),
    )


def _of_weight(given: RodKeys) -> Iterator[Effect]:
    if not any(given.gravity):
        return
    main = int(np.abs(np.array(given.gravity)).argmax())
    level = [a for k, a in enumerate("xyz") if k != main]
    yield Effect(
        name="gravity_tilt",
        form="Gravity is turned by size about the level axes of the recording.",
        family="tilt",
        kind="environment",
        unit="rad",
        typical=0.03,
        components=tuple(level),
        also_looks_like=("cameras that are not level",),
        apply=adding(*(f"gravity_tilt_{a}" for a in level)),
    )
    volume = sum(
        np.pi / 3.0 * (b.at - a.at) * (a.radius**2 + a.radius * b.radius + b.radius**2)
        for a, b in zip(given.stations, given.stations[1:], strict=False)
    )
    mass = float(volume * given.material.density.value)
    yield Effect(
        name="tip_mass",
        form="A mass of size at the tip.",
        family="load",
        kind="force",
        unit="kg",
        typical=0.02 * mass,
        also_looks_like=("weight of a marker",),
        apply=adding(f"{TIP}_mass"),
    )
    yield Effect(
        name="marker_mass",
        form="Every marker with its stub weighs size.",
        family="load",
        kind="environment",
        unit="kg",
        typical=0.01 * mass,
        signed=False,
        apply=adding("marker_mass"),
    )


def _of_holding(given: RodKeys, length: float) -> Iterator[Effect]:
    yield Effect(
        name="clamped_length",
        form="The clamp grips the first size of the rod, which cannot bend.",
        family="clamp",
        kind="environment",
        unit="m",
        typical=0.03 * length,
        signed=False,
        apply=adding("clamped_length"),
    )
    if not (given.base.tilt_y.is_fitted or given.base.tilt_z.is_fitted):
        yield Effect(
            name="clamp_tilt",
            form="The base is turned by size about local y and z.",
            family="tilt",
            kind="environment",
            unit="rad",
            typical=0.03,
            components=("y", "z"),
            also_looks_like=("rest bend near the base",),
            apply=adding("base_tilt_y", "base_tilt_z"),
        )
    if not given.base.twist.is_fitted:
        yield Effect(
            name="clamp_twist",
            form="The base is turned by size about the axis of the rod.",
            family="tilt",
            kind="environment",
            unit="rad",
            typical=0.03,
            also_looks_like=("tendons at another angle",),
            apply=adding("base_twist"),
        )
    base = given.base
    if not (base.shift_x.is_fitted or base.shift_y.is_fitted or base.shift_z.is_fitted):
        yield Effect(
            name="clamp_shift",
            form="The base is elsewhere by size.",
            family="clamp",
            kind="sensor",
            unit="m",
            typical=5e-3,
            components=("x", "y", "z"),
            also_looks_like=("origin of the recording",),
            apply=adding(*(f"base_shift_{a}" for a in "xyz")),
        )


def _of_tendons(given: RodKeys, study: Study, length: float) -> Iterator[Effect]:
    names = [t.name for t in given.tendons]
    pull = max(
        float(np.nanmax(np.abs(np.asarray(run.command[t.command], np.float64))))
        for run in study.runs
        for t in given.tendons
    )
    nearest = min(p.distance for t in given.tendons for p in t.path)
    if not all(t.gain.is_fitted for t in given.tendons):
        yield Effect(
            name="command_gain",
            form="Tendons are pulled (1 + size) times as hard as commanded.",
            family="gain",
            kind="actuator",
            unit="-",
            shown_unit="%",
            typical=0.1,
            also_looks_like=("radius of the pulley", "Young's modulus and density together"),
            apply=adding("command_gain"),
        )
    yield Effect(
        name="drive_loss",
        form="Nothing is pulled until the tension exceeds size, then that much less.",
        family="loss",
        kind="actuator",
        unit="N",
        typical=SHARE * pull,
        signed=False,
        also_looks_like=(
            "slack",
            "dry friction of motor and pulley",
            "torque that turns an idle motor",
        ),
        words=lambda size: f"{size:.2g} N lost in each drive",
        apply=adding("drive_loss"),
    )
    yield Effect(
        name="pretension",
        form="No tendon is ever pulled less than size.",
        family="pretension",
        kind="actuator",
        unit="N",
        typical=SHARE * pull,
        signed=False,
        smooth=False,
        also_looks_like=("drag of an idle motor",),
        apply=adding("pretension"),
    )
    yield Effect(
        name="tendon_friction",
        form="Tension falls by exp(-size angle) around bends (capstan).",
        family="loss",
        kind="actuator",
        unit="-",
        typical=0.2,
        signed=False,
        apply=adding("tendon_friction"),
    )
    yield Effect(
        name="tendon_wobble",
        form="Tension falls by exp(-size s) along the rod.",
        family="loss",
        kind="actuator",
        unit="1/m",
        typical=0.3 / length,
        signed=False,
        also_looks_like=("a rough channel",),
        apply=adding("tendon_wobble"),
    )
    yield Effect(
        name="tendon_end",
        form="Tendons end size farther from the base.",
        family="path",
        kind="actuator",
        unit="m",
        typical=0.03 * length,
        apply=adding("tendon_end"),
    )
    yield Effect(
        name="tendon_distance",
        form="Tendons run size farther from the axis.",
        family="path",
        kind="actuator",
        unit="m",
        typical=0.3 * nearest,
        also_looks_like=("tendons that pull to the inner side of their channel",),
        apply=adding("tendon_distance"),
    )
    yield Effect(
        name="tendon_turn",
        form="Each tendon runs at an angle around the axis that is larger by size.",
        family="path",
        kind="actuator",
        unit="rad",
        typical=0.1,
        components=tuple(names),
        also_looks_like=("a base that is turned about its axis",),
        apply=adding(*(f"{n}_tendon_turn" for n in names)),
    )
    yield Effect(
        name="tendon_helix",
        form="Tendons wind around the axis by size per length.",
        family="path",
        kind="actuator",
        unit="rad/m",
        typical=0.2 / length,
        also_looks_like=("a rod that is twisted",),
        apply=adding("tendon_helix"),
    )


def _of_sessions(given: RodKeys, fact: str, study: Study) -> Iterator[Effect]:
    """What may have changed between sessions, the first of them as described."""
    labels = sorted({str(run.setup[fact]) for run in study.runs if fact in run.setup})

    def later(*names: str) -> dict[str, Any]:
        """Components of the later sessions, and how they act."""
        ways = tuple(n.rpartition("_")[2] for n in names)
        several = len(labels) > 2
        parts = tuple(f"{w} of {s}" if several else w for s in labels[1:] for w in ways)
        return {
            "components": parts,
            "apply": partial(_in_session, fact=fact, labels=tuple(labels), names=names),
        }

    if len(labels) < 2:
        return
    for marker in given.markers:
        yield Effect(
            name=f"moved_{marker}",
            form=f"Between sessions marker {marker} was put elsewhere on its section by size.",
            family=f"moved_{marker}",
            kind="sensor",
            unit="m",
            typical=PLACED_TO,
            also_looks_like=("another marker in its place",),
            **later(*(f"{marker}_{way}" for way in ("along", "y", "z"))),
        )
    yield Effect(
        name="moved_clamp",
        form="Between sessions the base was turned by size about its axis and local y and z.",
        family="moved_clamp",
        kind="environment",
        unit="rad",
        typical=0.05,
        also_looks_like=("cameras that were set up again",),
        **later("base_twist", "base_tilt_y", "base_tilt_z"),
    )
    yield Effect(
        name="aged_material",
        form="Between sessions Young's modulus grew by size.",
        family="aging",
        kind="material",
        unit="Pa",
        typical=0.1 * given.material.youngs_modulus.value,
        also_looks_like=("warmth", "creep"),
        **later("youngs_modulus"),
    )


def _in_session(
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
        scene = scene.with_added(name, size[..., session * len(names) + i])
    return scene


__all__ = ["library"]
