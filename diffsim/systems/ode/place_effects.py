"""Causes at a place: friction, springs, stops, inertia."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from diffsim.causes.ports import FADE_SHARE
from diffsim.causes.row import Row
from diffsim.core.expression import Expression, parse_expression
from diffsim.core.figures import figure
from diffsim.identify.effect import Apply
from diffsim.systems.description import Quantity
from diffsim.systems.ode.applying import by_formulas, entering, symbol
from diffsim.systems.ode.described import FormulaSystem
from diffsim.systems.ode.keys import Place
from diffsim.systems.ode.library import SHARE_OF_USUAL, Library, PlaceScale
from diffsim.systems.ode.network import RATE, Change, filled, is_linear, named, written_out
from diffsim.systems.ode.scene import at_start

SLIDING = "tanh(v/w)"  # of a law of dry friction
STRIBECK = 0.2  # of the usual velocity, times e^fall: where friction has fallen to that of sliding
STOP_STIFFNESS = 50.0  # usual forces per usual distance, times e^stop_hardness
STOP_LIMIT = 2.0  # inertias per square of a step: what an explicit step follows on a stiffer stop


def magnitudes_at(scale: PlaceScale) -> dict[str, float]:
    """Usual magnitudes at a place, as the table of forces calls them.

    Args:
        scale: Usual magnitudes in the plain model.
    """
    return {
        "push": SHARE_OF_USUAL * scale.force,
        "distance": scale.position,
        "speed": scale.velocity,
        "inertia": scale.inertia,
        "above": scale.above,
        "below": scale.below,
    }


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
    usual = {
        **({} if place.stick_velocity else fades),
        f"stop_hardness_at_{place.name}": Quantity(value=0.0, sd=1.5, lower=-5.0, upper=3.0),
        f"stop_loss_at_{place.name}": Quantity(value=-1.0, sd=1.5, lower=-5.0, upper=3.0),
        f"stiffening_bend_at_{place.name}": Quantity(value=0.0, sd=0.5),
    }
    return {name: quantity.as_usual() for name, quantity in usual.items()}


def _list_numbers(place: Place, scale: PlaceScale) -> dict[str, float]:
    return {
        "width": place.stick_velocity or FADE_SHARE * scale.velocity,
        "vs": STRIBECK * scale.velocity,
        "usual": scale.position,
        "usual_v": scale.velocity,
        "low": scale.low,
        "high": scale.high,
    }


def _list_letters(
    library: Library, place: Place, scale: PlaceScale, name: str
) -> dict[str, Expression]:
    """What the letters of a force's formula stand for, those of its row's shapes apart."""
    numbers = {k: parse_expression(repr(n)) for k, n in _list_numbers(place, scale).items()}
    stiffness = repr(STOP_STIFFNESS * scale.force / scale.position)
    own = {k: named(f"{k}_at_{place.name}") for k in ("stop_hardness", "stop_loss")}
    out = numbers | {
        "x": named(place.position),
        "v": named(place.velocity),
        "slow": named(f"slow state of {name}"),
        "tau": named("slow_time"),
        "size": named(symbol(name)),
        "inertia": parse_expression(place.inertia, library.system.known),
        "bend": named(f"stiffening_bend_at_{place.name}"),
        "hard": filled(parse_expression(f"{stiffness}*exp(stop_hardness)"), own),
        "loss": filled(parse_expression("exp(stop_loss)"), own),
    }
    width = "width" if place.stick_velocity else f"width*{sticking(place)}"
    stop = f"min(hard, {STOP_LIMIT / library.system.step**2!r}*inertia)"
    return out | {
        "w": filled(parse_expression(width), out),
        "stop": filled(parse_expression(stop), out),
    }


def stop_in_words(name: str, end: float, inward: float, unit: str, size: float) -> str:
    """A stop by where it is, of which its interval is the way into the plain model's range.

    Args:
        end: Least or greatest position that the plain model reaches [unit].
        inward: Sign of the way into that range.
        size: How far inside the stop lies [unit].
    """
    place = f"{name.replace('_', ' ')} {figure(end + inward * size)} {unit}"
    return f"{place}, so far inside what the plain model reaches"


def push_at(library: Library, place: Place, scale: PlaceScale, row: Row) -> Apply:
    """How a force at a place enters the formulas.

    Args:
        place: Where it acts.
        scale: Usual magnitudes there.
        row: Cause with ``at: force``, of the effect's name.
    """
    name = row.name
    law = row.said("law", "ode")
    parts = _list_letters(library, place, scale, name)
    if "load" in parse_expression(law).names:
        parts["load"] = load_at(library.system, place, parts["inertia"])
    own = {
        k: parse_expression(repr(s.value)) if s.sd is None else named(f"{k} of {name}")
        for k, s in row.shapes.items()
    }
    slow = f"slow state of {name}"
    # letters of a row's own are of its formula alone: a `width` there is not that of w
    known = {**parts, **own}
    letters = parse_expression(law, known)
    creeps = "slow" in letters.names and "slow" not in own
    is_friction = law.count(SLIDING) == 1 and f"{SLIDING}**" not in law
    if is_friction and place.force is None:
        strength = filled(parse_expression(law.replace(SLIDING, "(-1)"), known), known)
        change = _holding(library, place, strength, parts)
    else:
        change = entering(library.system, "force", place.name, filled(letters, known))
    change = replace(
        change,
        states={slow: filled(parse_expression("(x - slow)/tau"), parts)} if creeps else {},
        starts={slow: named(at_start(place.position))} if creeps else {},
    )
    fitted = (f"{k} of {name}" for k, shape in row.shapes.items() if shape.sd is not None)
    return by_formulas(change, symbol(name), *fitted)


def _holding(
    library: Library,
    place: Place,
    strength: Expression,
    parts: Mapping[str, Expression],
) -> Change:
    """Dry friction that holds at rest, however long the step is.

    Where friction could turn the velocity within a step (most > w/step), tanh(v/w) is not followed:
    the velocity rattles about zero, and what should stick slides. There friction acts against the
    velocity that all else makes of a step, v + step*rate, and is at most what stops that.
    """
    of_rate = {"strength": strength, "inertia": parts["inertia"]}
    most = filled(parse_expression("strength/inertia"), of_rate)
    step = parse_expression(repr(library.system.step))
    unfollowed = "clip(most*step/w - 1, 0, 1)"
    after = filled(
        parse_expression(f"v + step*rate*{unfollowed}"),
        {"most": most, "step": step, "w": parts["w"], "v": parts["v"], "rate": named(RATE)},
    )
    text = "rate - clip(most*tanh(after/w), -abs(after)/step, abs(after)/step)"
    new = {"rate": named(RATE), "most": most, "after": after, "w": parts["w"], "step": step}
    return Change(held_rates={place.velocity: filled(parse_expression(text), new)})


def add_inertia(library: Library, place: Place, name: str) -> Apply:
    """How a larger inertia at a place enters the formulas."""
    factor = filled(
        parse_expression("inertia/max(inertia + size, 0.05*inertia)"),
        {
            "inertia": parse_expression(place.inertia, library.system.known),
            "size": named(symbol(name)),
        },
    )
    return by_formulas(Change(factors={place.velocity: factor}), symbol(name))


def pushed_by_inputs(system: FormulaSystem, place: Place) -> tuple[str, ...]:
    """Names without which no input pushes at a place, its rate a straight line over each.

    What a goal of a position pushes with depends on where positions have their zero: no load. A
    definition that sees how the place moves, as that of a servo, is one whatever its inputs are.

    Returns:
        The first definition that takes all inputs with it, else the inputs themselves; empty where
        none pushes, or nobody knows with what force.
    """
    network, inputs = system.network, set(system.held)
    for name in network.definitions:
        rate = written_out(network.rates[place.velocity], network, but=name)
        if name in rate.names and inputs.isdisjoint(rate.names) and is_linear(rate, name):
            known = set(written_out(network.definitions[name], network).names)
            sees = not known.isdisjoint((place.position, place.velocity))
            if known & inputs and (sees or all(_is_force(system, n) for n in known & inputs)):
                return (name,)
    rate = written_out(network.rates[place.velocity], network)
    found = tuple(name for name in system.held if name in rate.names)
    is_known = all(is_linear(rate, name) and _is_force(system, name) for name in found)
    return found if is_known else ()


def _is_force(system: FormulaSystem, name: str) -> bool:
    """Whether an input is made of forces or torques alone, by the units of its commands."""
    units = {c.name: c.unit for c in system.study.commands}
    used = [n for n in system.inputs[name].names if n in units]
    return bool(used) and all(units[n] in ("N", "N m") for n in used)


def load_at(system: FormulaSystem, place: Place, inertia: Expression) -> Expression:
    """The force that a place states; else what inputs put on it: inertia times what they change of
    its rate.
    """
    if place.force is not None:
        return named(place.force)
    network, pushing = system.network, pushed_by_inputs(system, place)
    but = pushing[0] if pushing[0] in network.definitions else ""
    rate = written_out(network.rates[place.velocity], network, but=but)
    idle = filled(rate, {name: parse_expression("0") for name in pushing})
    parts = {"inertia": inertia, "rate": rate, "idle": idle}
    return filled(parse_expression("inertia*(rate - idle)"), parts)
