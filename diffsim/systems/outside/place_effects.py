"""Forces with a law of their own at the places of an outside simulator."""

from __future__ import annotations

from functools import partial

from torch import Tensor

from diffsim.causes.readings import spell_plainly
from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.systems.outside import forces
from diffsim.systems.outside.forces import Law, Term
from diffsim.systems.outside.hooks import Place
from diffsim.systems.outside.model import OutsideScene


def place_effects(place: Place, index: int) -> list[Effect]:
    """Forces at a place: springs where its distance is told, friction where its speed is.

    Args:
        place: Place with the scales of force, displacement and speed.
        index: Its index among all places.
    """
    unit, length, force = place.unit, place.length, place.typical
    made = [
        _place_effect(
            place,
            index,
            "constant_force",
            forces.constant,
            "Force size, always.",
            "constant",
            unit,
            force,
            looks_like=("gravity along a tilted guide", "offset of the command"),
        )
    ]
    if place.distance is not None:
        made += [
            _place_effect(
                place,
                index,
                "added_spring",
                forces.stiff,
                "Force -size x: a spring that rests at zero.",
                "stiffness",
                f"{unit}/{length}",
                force / place.distance,
                looks_like=("gravity of a pendulum", "a cable that bends"),
            ),
            _place_effect(
                place,
                index,
                "cubic_stiffness",
                forces.cubic,
                "Force -size x^3.",
                "stiffness",
                f"{unit}/{length}^3",
                force / place.distance**3,
                looks_like=("a stop", "large rotations"),
            ),
        ]
    if place.speed is not None:
        made += [
            _place_effect(
                place,
                index,
                "viscous_friction",
                forces.viscous,
                "Force -size v.",
                "damping",
                f"{unit} s/{length}",
                force / place.speed,
                looks_like=("back-EMF of a motor", "linear drag"),
                signed=False,
            ),
            _place_effect(
                place,
                index,
                "dry_friction",
                forces.coulomb,
                "Force size against the motion, whatever its speed (Coulomb).",
                "damping",
                unit,
                force,
                looks_like=("stiction of a bearing", "a rubbing cable"),
                signed=False,
                scale=place.speed,
            ),
            _place_effect(
                place,
                index,
                "square_drag",
                forces.quadratic,
                "Force -size |v| v.",
                "damping",
                f"{unit} s^2/{length}^2",
                force / place.speed**2,
                looks_like=("drag of air or water",),
                signed=False,
            ),
        ]
    return made


def _place_effect(
    place: Place,
    index: int,
    name: str,
    law: Law,
    form: str,
    family: str,
    unit: str,
    typical: float,
    *,
    looks_like: tuple[str, ...],
    signed: bool = True,
    scale: float = 1.0,
) -> Effect:
    """An effect that adds one law at one place."""
    return Effect(
        name=f"{name}_at_{plain(place.name)}",
        form=form,
        family=family,
        kind="force",
        unit=unit,
        typical=typical,
        signed=signed,
        also_looks_like=looks_like,
        apply=partial(_forced, place=index, law=law, scale=scale),
    )


def _forced(
    scene: OutsideScene, size: Tensor, run: Run, *, place: int, law: Law, scale: float
) -> OutsideScene:
    return scene.with_term(Term(place, law, float(size.detach()[0]), scale))
