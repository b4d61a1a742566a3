"""Causes at a place: friction, springs, stops, inertia."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from diffsim.core.expression import Expression, parse_expression
from diffsim.identify.effect import Effect
from diffsim.systems.description import Quantity
from diffsim.systems.ode.applying import by_formulas, symbol
from diffsim.systems.ode.keys import Place
from diffsim.systems.ode.library import Library, PlaceScale
from diffsim.systems.ode.network import Change, filled, named
from diffsim.systems.ode.scene import at_start

STICK = 0.01  # of the usual velocity: below it dry friction fades
STRIBECK = 0.2  # of the usual velocity: where friction has fallen to that of sliding
SHARE = 0.1  # of the usual force that a cause may be without surprise
STOP_STIFFNESS = 50.0  # usual forces per usual distance, times e^stop_hardness
REACH_SHARE = 0.3  # of how far it moves from the start: how far inside a stop may be
STOP_TRIES = (0.1, 0.3, 0.6, 1.0, 1.4, 1.8, 2.2, 2.6, 3.0)  # so that all that distance is scanned
STOP_LIMIT = 2.0  # inertias per square of a step: what an explicit step follows on a stiffer stop


@dataclass(frozen=True, kw_only=True)
class _Force:
    """A force at a place.

    Attributes:
        name, form, family, kind, signed, smooth, also, tries: As of the effect.
        force: Formula of position x, velocity v, size, and the numbers of ``_numbers``.
        unit: Unit of the size, with F for that of the force and X for that of the position.
        typical: Size that would be no surprise.
    """

    name: str
    form: str
    family: str
    kind: str = "force"
    force: str
    unit: str
    typical: float
    signed: bool = True
    smooth: bool = True
    also: tuple[str, ...] = ()
    tries: tuple[float, ...] = ()


def _forces(scale: PlaceScale) -> Iterator[_Force]:
    f, x, v = SHARE * scale.force, scale.position, scale.velocity
    yield _Force(
        name="viscous_friction",
        form="Force -size v.",
        family="damping",
        force="-size*v",
        unit="F s/X",
        typical=f / v,
        signed=False,
        also=("back EMF of a motor", "loss in the material"),
    )
    yield _Force(
        name="dry_friction",
        form="Force size against the motion (Coulomb).",
        family="damping",
        force="-size*tanh(v/w)",
        unit="F",
        typical=f,
        signed=False,
        also=("hysteresis of the material", "viscous friction at one speed"),
    )
    yield _Force(
        name="friction_asymmetry",
        form="Dry friction is size larger forwards and size less backwards.",
        family="asymmetry",
        force="-size*tanh(v/w)**2",
        unit="F",
        typical=0.5 * f,
        also=("constant force, where it moves all the time",),
    )
    yield _Force(
        name="viscous_asymmetry",
        form="Viscous friction is size larger forwards and size less backwards.",
        family="asymmetry",
        force="-size*abs(v)",
        unit="F s/X",
        typical=0.5 * f / v,
        also=("dry friction that differs with the direction, at one speed",),
    )
    yield _Force(
        name="friction_along_stroke",
        form="Dry friction grows by size per distance along the stroke, from its middle on.",
        family="damping",
        force="-size*(x - 0.5*(low + high))*tanh(v/w)",
        unit="F/X",
        typical=f / x,
        also=("a guide that is not straight", "a screw that is worn in the middle"),
    )
    yield _Force(
        name="stribeck_friction",
        form="Friction is size higher near standstill, and falls with speed.",
        family="damping",
        force="-size*tanh(v/w)*exp(-(v/vs)**2)",
        unit="F",
        typical=f,
        also=("stiction", "friction of a fresh contact"),
    )
    yield _Force(
        name="square_drag",
        form="Force -size v |v|.",
        family="damping",
        kind="environment",
        force="-size*v*abs(v)",
        unit="F s^2/X^2",
        typical=f / v**2,
        signed=False,
        also=("drag of the air or water",),
    )
    yield _Force(
        name="added_spring",
        form="Force -size x.",
        family="stiffness",
        kind="material",
        force="-size*x",
        unit="F/X",
        typical=f / x,
        also=("gravity on a lever, close to its rest",),
    )
    yield _Force(
        name="quadratic_stiffness",
        form="Force -size x^2: stiffer on one side.",
        family="stiffness",
        kind="material",
        force="-size*x*x",
        unit="F/X^2",
        typical=f / x**2,
    )
    yield _Force(
        name="cubic_stiffness",
        form="Force -size x^3: stiffening, or softening if negative.",
        family="stiffness",
        kind="material",
        force="-size*x*x*x*(1 + max(bend, 0)*(x/usual)**2)/(1 - min(bend, 0)*(x/usual)**2)",
        unit="F/X^3",
        typical=f / x**3,
        also=("a string across the motion", "rubber that is stretched far", "a soft stop"),
    )
    yield _Force(
        name="constant_force",
        form="Force size, always.",
        family="constant",
        kind="environment",
        force="size",
        unit="F",
        typical=f,
        also=("weight on a slope", "offset of the drive"),
    )
    yield _Force(
        name="stop_above",
        form="A stop, size inside the greatest position that the plain model reaches.",
        family="stop",
        force="-stop*max(x - (high - size), 0)*(1 + tanh(loss*v/usual_v))*(size > 0)",
        unit="X",
        typical=REACH_SHARE * scale.above,
        signed=False,
        smooth=False,
        tries=STOP_TRIES,
        also=("stiffening", "saturation of the drive"),
    )
    yield _Force(
        name="stop_below",
        form="A stop, size inside the least position that the plain model reaches.",
        family="stop",
        force="stop*max((low + size) - x, 0)*(1 - tanh(loss*v/usual_v))*(size > 0)",
        unit="X",
        typical=REACH_SHARE * scale.below,
        signed=False,
        smooth=False,
        tries=STOP_TRIES,
        also=("stiffening", "saturation of the drive"),
    )
    yield _Force(
        name="relaxing_spring",
        form="A spring of stiffness size whose force is lost within the slow time.",
        family="creep",
        kind="material",
        force="-size*(x - slow)",
        unit="F/X",
        typical=f / x,
        signed=False,
        also=("creep", "loss in the material"),
    )


def place_effects(library: Library) -> tuple[Effect, ...]:
    """Forces and inertias at every place of a system."""
    out = []
    for place, scale in library.places:
        plain = (place.unit, place.position_unit) == ("N", "m")
        tail = "" if plain and len(library.places) == 1 else f"_at_{place.name}"
        out += [_effect(library, place, scale, force, tail) for force in _forces(scale)]
        if place.force is None:  # else other rates hold the inertia, too
            out.append(_inertia(library, place, scale, tail))
    return tuple(out)


def sticking(place: Place) -> str:
    """Name of the factor on the velocity below which dry friction fades, where nobody stated it."""
    return f"sticking_at_{place.name}"


def shapes(place: Place) -> dict[str, Quantity]:
    """Numbers that some forces at a place have beside their size, known within decades.

    Where no such force acts they change nothing.

    Args:
        place: Where forces may act.

    Returns:
        Base parameters by name: the factor on the velocity below which dry friction fades, where
        nobody stated it; logarithms of a stop's stiffness and loss over the usual; by how much
        stiffening is more than cubic at the usual distance, or less if negative.
    """
    fades = {sticking(place): Quantity(value=1.0, percent=100.0, lower=0.2, upper=20.0)}
    return {
        **({} if place.stick_velocity else fades),
        f"stop_hardness_at_{place.name}": Quantity(value=0.0, sd=1.5, lower=-3.0, upper=3.0),
        f"stop_loss_at_{place.name}": Quantity(value=-1.0, sd=1.5, lower=-5.0, upper=3.0),
        f"stiffening_bend_at_{place.name}": Quantity(value=0.0, sd=0.5),
    }


def _numbers(place: Place, scale: PlaceScale) -> dict[str, float]:
    return {
        "width": place.stick_velocity or STICK * scale.velocity,
        "vs": STRIBECK * scale.velocity,
        "usual": scale.position,
        "usual_v": scale.velocity,
        "low": scale.low,
        "high": scale.high,
    }


def _letters(library: Library, place: Place, scale: PlaceScale, name: str) -> dict[str, Expression]:
    """What the letters of a force's formula stand for."""
    numbers = {k: parse_expression(repr(n)) for k, n in _numbers(place, scale).items()}
    stiffness = repr(STOP_STIFFNESS * scale.force / scale.position)
    own = {k: named(f"{k}_at_{place.name}") for k in ("stop_hardness", "stop_loss")}
    out = numbers | {
        "x": named(place.position),
        "v": named(place.velocity),
        "slow": named(f"slow state of {name}"),
        "tau": named("slow_time"),
        "size": named(symbol(name)),
        "inertia": parse_expression(place.inertia, library.known),
        "bend": named(f"stiffening_bend_at_{place.name}"),
        "hard": filled(parse_expression(f"{stiffness}*exp(stop_hardness)"), own),
        "loss": filled(parse_expression("exp(stop_loss)"), own),
    }
    width = "width" if place.stick_velocity else f"width*{sticking(place)}"
    stop = f"min(hard, {STOP_LIMIT / library.step**2!r}*inertia)"
    return out | {
        "w": filled(parse_expression(width), out),
        "stop": filled(parse_expression(stop), out),
    }


def _effect(library: Library, place: Place, scale: PlaceScale, force: _Force, tail: str) -> Effect:
    name = force.name + tail
    parts = _letters(library, place, scale, name)
    slow = f"slow state of {name}"
    letters = parse_expression(force.force, parts)
    creeps = "slow" in letters.names
    change = replace(
        pushed(place, filled(letters, parts), library.known),
        states={slow: filled(parse_expression("(x - slow)/tau"), parts)} if creeps else {},
        starts={slow: named(at_start(place.position))} if creeps else {},
    )
    return Effect(
        name=name,
        form=force.form,
        family=force.family,
        kind=force.kind,
        unit=_unit(force.unit, place),
        typical=force.typical,
        signed=force.signed,
        smooth=force.smooth,
        also_looks_like=force.also,
        tries=force.tries,
        apply=by_formulas(change, symbol(name)),
    )


def pushed(place: Place, force: Expression, known: Iterable[str]) -> Change:
    """A force at a place: added to what is the force there, or to the rate of the velocity.

    Args:
        place: Where it acts.
        force: The force [unit of the place].
        known: Names that formulas may use.
    """
    if place.force is not None:
        total = parse_expression("before + force", ("before", "force"))
        both = {"before": named(place.force), "force": force}
        return Change(names={place.force: filled(total, both)})
    share = parse_expression("force/inertia", ("force", "inertia"))
    inertia = parse_expression(place.inertia, known)
    return Change(rates={place.velocity: filled(share, {"force": force, "inertia": inertia})})


def _inertia(library: Library, place: Place, scale: PlaceScale, tail: str) -> Effect:
    name = "extra_inertia" + tail
    factor = filled(
        parse_expression("inertia/max(inertia + size, 0.05*inertia)"),
        {
            "inertia": parse_expression(place.inertia, library.known),
            "size": named(symbol(name)),
        },
    )
    unit = "kg" if not tail or place.unit == "N" else _unit("F s^2/X", place)
    return Effect(
        name=name,
        form="The inertia is larger by size.",
        family="inertia",
        kind="material",
        unit=unit,
        typical=SHARE * scale.inertia,
        also_looks_like=("gain of the drive, with friction and stiffness to match",),
        apply=by_formulas(Change(factors={place.velocity: factor}), symbol(name)),
    )


def _unit(pattern: str, place: Place) -> str:
    """ "F s/X" -> "N s/m"."""
    if place.position_unit == "-":
        pattern = pattern.split("/X")[0].replace("X", "-")
    return pattern.replace("F", place.unit).replace("X", place.position_unit)
