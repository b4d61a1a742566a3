"""Causes inside a described mechanism: a drive that is not stiff, torque that comes late, more."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import partial

import numpy as np
from torch import Tensor

from diffsim.causes.signals import SignalMap, late_by
from diffsim.core.expression import Expression, parse_expression
from diffsim.data.study import Channel
from diffsim.identify.effect import Apply
from diffsim.systems.ode.applying import by_formulas, symbol, with_inputs
from diffsim.systems.ode.keys import Place
from diffsim.systems.ode.library import Library
from diffsim.systems.ode.network import (
    READING,
    Change,
    Network,
    filled,
    is_linear,
    named,
    written_out,
)
from diffsim.systems.ode.scene import OdeScene, at_start

SHARE, LOSS = "share", "loss"  # shapes of a coupling, by the names of its row
_SHARE = "1/(1 + exp(-min(max(share, -20), 20)))"  # of the inertia that is behind the coupling
_USUAL_LOSS = 0.02  # damping ratio of a coupling, times e^loss
# squares of a coupling's frequency by a step: what an explicit step follows
_QUICKEST = 4.0
_DELAY = 1.5  # steps: what delays less is said by its slope alone
_SIGN = 0.02  # of a current's range: within it its sign fades
_NO_LIMIT = 1e-9  # times the usual value: a limit is so far beyond that there is none

_COUPLING = {
    "part": _SHARE,
    "behind": "part*inertia",
    "before": "(1 - part)*inertia",
    # a coupling that a step cannot follow is stiff: then both inertias move as one
    "stiff": f"step**2/({_QUICKEST}*part*(1 - part)*inertia)",
    "soft": "sqrt(size**2 + stiff**2)",
    "blend": "size**2/(size**2 + stiff**2)",
    "damping": f"2*{_USUAL_LOSS}*exp(loss)*sqrt(behind/soft)",
    "pull": "(x - y)/soft + damping*(v - u)",
}
_LIGHTER = "1 - blend + blend/(1 - part)"
# of a stated force, what it accelerates there: alike in each of the joints that it reaches
_DRIVEN = {
    "gain": "driven - idle",  # by a force of one
    # the drive's part stands in the inertia that the force moves, and is no part of the link's
    "alone": "max(1 - gain*before, 0.05)",
    "onto": "pull + before*(idle + gain*pull)/alone",
}


def elastic_coupling(library: Library, place: Place, name: str) -> Apply:
    """A coupling of some compliance between the drive and what is read.

    What was described is before the coupling, and has the drive's share of the inertia; the rest is
    behind it, and is read.

    Args:
        name: Name of the effect.
    """
    if place.force is not None:
        return _coupling_behind(library, place, place.force, name)
    y, u = f"place behind {name}", f"speed behind {name}"
    known = _coupling_of(library, place, name)
    known |= {"x": named(place.position), "v": named(place.velocity), "y": named(y), "u": named(u)}
    known = _filled_in_turn({**_COUPLING, "lighter": _LIGHTER}, known)
    behind = {place.position: known["y"], place.velocity: known["u"]}
    change = Change(
        rates={place.velocity: filled(parse_expression("-blend*pull/(before*lighter)"), known)},
        factors={place.velocity: known["lighter"]},
        states={y: named(u), u: filled(parse_expression("pull/behind"), known)},
        starts={y: named(at_start(place.position)), u: named(at_start(place.velocity))},
        readings=_read_behind(library.system.network, behind, known["blend"]),
    )
    return by_formulas(change, symbol(name), f"{SHARE} of {name}", f"{LOSS} of {name}")


def has_linear_drive(network: Network, place: Place) -> bool:
    """Whether the rate at a place is a straight line over the force that it states.

    A coupling behind that force is told its share of the inertia by the rates under forces of 0
    and 1.
    """
    force = place.force or ""
    return is_linear(written_out(network.rates[place.velocity], network, but=force), force)


def _coupling_behind(library: Library, place: Place, force: str, name: str) -> Apply:
    """The same of a force that is stated: what was described, coupled to other joints, is behind.

    The drive moves by states of its own, which the force sees; what its place sees is the coupling.
    """
    network = library.system.network
    x, v = f"place before {name}", f"speed before {name}"
    at_drive = {place.position: named(x), place.velocity: named(v)}
    rate = written_out(network.rates[place.velocity], network, but=force)
    plain = network.definitions[force]
    known = _coupling_of(library, place, name)
    known |= {"x": named(x), "v": named(v), "y": named(place.position), "u": named(place.velocity)}
    known |= {
        "idle": filled(rate, {force: parse_expression("0")}),
        "driven": filled(rate, {force: parse_expression("1")}),
        "pushed": filled(written_out(plain, network), at_drive),
        "now": named(force),
        "plain": plain,
    }
    known = _filled_in_turn({**_COUPLING, **_DRIVEN}, known)
    change = Change(
        names={force: filled(parse_expression("now + blend*(onto - plain)"), known)},
        states={x: named(v), v: filled(parse_expression("(pushed - pull)/before"), known)},
        starts={x: named(at_start(place.position)), v: named(at_start(place.velocity))},
    )
    return by_formulas(change, symbol(name), f"{SHARE} of {name}", f"{LOSS} of {name}")


def _coupling_of(library: Library, place: Place, name: str) -> dict[str, Expression]:
    """What the formulas of a coupling are made of, but for the motion of both sides."""
    return {
        "size": named(symbol(name)),
        "step": parse_expression(repr(library.system.step)),
        SHARE: named(f"{SHARE} of {name}"),
        LOSS: named(f"{LOSS} of {name}"),
        "inertia": parse_expression(place.inertia, library.system.known),
    }


def _filled_in_turn(
    formulas: Mapping[str, str], known: Mapping[str, Expression]
) -> dict[str, Expression]:
    """What is known, and formulas that are made of it and of those before them."""
    out = dict(known)
    for letter, text in formulas.items():
        out[letter] = filled(parse_expression(text), out)
    return out


def _read_behind(
    network: Network, behind: Mapping[str, Expression], blend: Expression
) -> dict[str, Expression]:
    """Readings of what other states stand for, as far as they are blended in."""
    out = {}
    for channel, formula in network.readings.items():
        plain = written_out(formula, network)
        if set(plain.names) & set(behind):
            parts = {"old": plain, "new": filled(plain, behind), "blend": blend}
            parts["reading"] = named(READING)
            out[channel] = filled(parse_expression("reading + blend*(new - old)"), parts)
    return out


def coupling_in_words(inertia: float, name: str, size: float, values: Mapping[str, float]) -> str:
    """A coupling by the frequency at which what is behind it swings.

    Args:
        inertia: Inertia of both sides.
        values: Base parameters by name.
    """
    part = 1.0 / (1.0 + math.exp(-values.get(f"{SHARE}_of_{name}", 0.0)))
    square = part * (1.0 - part) * inertia * size
    if square <= 0.0:
        return "a stiff coupling"
    return f"an elastic coupling that swings at {0.5 / math.pi / math.sqrt(square):.3g} Hz"


def late_inside(library: Library, definition: str, name: str) -> Apply:
    """A definition that acts later, such as the torque of a controller.

    Commands in it are late exactly. States, which do not jump, pass a rational function of second
    order (Pade), true to the third power of frequency; where the integrator's steps could not
    follow it, its poles are slower, and it is true to the second power.
    """
    network = library.system.network
    plain = written_out(network.definitions[definition], network)
    size = named(symbol(name))
    tau = filled(
        parse_expression(f"sqrt(size**2 + {_DELAY * library.system.step!r}**2)"), {"size": size}
    )
    late, states = dict[str, Expression](), dict[str, Expression]()
    starts = dict[str, Expression]()
    inputs = [n for n in plain.names if n in network.inputs]
    later = parse_expression("u + more")
    for state in (n for n in plain.names if n in network.rates):
        a, b = (f"{place} of {state} for {name}" for place in ("first", "second"))
        known = {"u": named(state), "a": named(a), "b": named(b), "size": size, "tau": tau}
        for letter, text in (("r", "size/tau"), ("c", "6*(u - a) - 4*b")):
            known[letter] = filled(parse_expression(text), known)
        # without a delay this is u to the last digit
        late[state] = filled(parse_expression("u - r*(b + 2/3*c) + r**2/2*c"), known)
        states |= {
            a: filled(parse_expression("b/tau"), known),
            b: filled(parse_expression("c/tau"), known),
        }
        starts[a] = named(at_start(state))
    known = {
        # what other causes add to it, such as friction, comes in time
        "now": named(definition),
        "plain": plain,
        "late": filled(
            plain,
            late
            | {n: filled(later, {"u": named(n), "more": named(f"{n} for {name}")}) for n in inputs},
        ),
    }
    change = Change(
        names={definition: filled(parse_expression("now + (late - plain)"), known)},
        states=states,
        starts=starts,
        inputs={f"{n} for {name}": network.inputs[n] for n in inputs},
    )
    late_names = {n: f"{n} for {name}" for n in inputs}
    return with_inputs(change, symbol(name), partial(_come_late, late_names, network.inputs))


def limited_inside(library: Library, definition: str, name: str) -> Apply:
    """A definition that goes no further than a limit either way, such as the torque of a motor."""
    # what other causes add to it, such as friction, is not limited
    plain = library.system.network.definitions[definition]
    parts = {"now": named(definition), "plain": plain, "size": named(symbol(name))}
    most = f"{library.usual[definition]!r}/max(size, {_NO_LIMIT!r})"
    formula = filled(parse_expression(f"now + (clip(plain, -{most}, {most}) - plain)"), parts)
    return by_formulas(Change(names={definition: formula}), symbol(name))


def made_larger(library: Library, definition: str, name: str) -> Apply:
    """A definition that is larger by a share: a gear counted twice, another constant of a motor.

    Args:
        definition: Name of the definition.
        name: Name of the effect.
    """
    plain = library.system.network.definitions[definition]
    parts = {"now": named(definition), "plain": plain, "size": named(symbol(name))}
    formula = filled(parse_expression("now + size*plain"), parts)
    return by_formulas(Change(names={definition: formula}), symbol(name))


def without_gain(network: Network, numbers: Iterable[str]) -> tuple[str, ...]:
    """Controllers of several numbers, none of which is a factor of all they do.

    Args:
        numbers: Names of the model's parameters.
    """
    rng, out = np.random.default_rng(0), []
    for name in closed_loops(network):
        formula = written_out(network.definitions[name], network)
        at = rng.uniform(0.5, 1.5, len(formula.names))
        value = formula.on_floats(*formula.names)
        own = [k for k, n in enumerate(formula.names) if n in set(numbers)]
        left = [value(*np.where(np.arange(len(at)) == k, 0.0, at)) for k in own]
        if len(own) > 1 and all(math.isfinite(v) and v != 0.0 for v in left):
            out.append(name)
    return tuple(out)


def _come_late(
    names: Mapping[str, str], held: Mapping[str, bool], scene: OdeScene, size: Tensor
) -> dict[str, Tensor]:
    return {
        late: _come_late_by(scene, n, late_by(size[..., :1], held=held[n], signed=False))
        for n, late in names.items()
    }


def _come_late_by(scene: OdeScene, name: str, change: SignalMap) -> Tensor:
    """By how much an input is larger when it comes late, (..., num_times)."""
    rows, now = scene.commands.rows[name], scene.inputs[name]
    return scene.commands.act(change, rows, now[..., None, :], scene.grid)[..., 0, :] - now


def closed_loops(network: Network) -> tuple[str, ...]:
    """Definitions that name an input and hang on a state: controllers."""
    return tuple(
        name
        for name, formula in network.definitions.items()
        if set(formula.names) & set(network.inputs)
        and set(written_out(formula, network).names) & set(network.rates)
    )


def loses_by_sign(command: str, name: str, *, library: Library, channel: Channel) -> Apply:
    """A voltage that is less in the direction of the current: dead time, brushes, a bridge."""
    network = library.system.network
    current = written_out(network.readings[channel.name], network)
    parts = {"u": named(command), "size": named(symbol(name)), "i": current}
    if command in current.names:
        # a current that follows at once is zero where the loss could take all that drives it
        parts["more"] = filled(current, {command: filled(parse_expression("u + 1"), parts)})
        formula = parse_expression("u - clip(i/(more - i), -size, size)")
    else:
        width = library.scales.of_channels((channel.name,))["width"]
        formula = parse_expression(f"u - size*tanh(i/{_SIGN * width!r})")
    return by_formulas(Change(names={command: filled(formula, parts)}), symbol(name))


def current_of(channels: tuple[Channel, ...]) -> Channel | None:
    """The one channel that shows a current; None: there is none, or several."""
    found = [c for c in channels if c.unit == "A"]
    return found[0] if len(found) == 1 else None


def pose_of(channels: tuple[Channel, ...]) -> tuple[Channel, Channel, Channel] | None:
    """Channels that show x, y and heading of a body in the plane; None: not just these."""
    places = {c.name[0].lower(): c for c in channels if c.unit == "m" and c.name[0] in "xyXY"}
    turns = [c for c in channels if c.unit == "rad"]
    is_plane = set(places) == {"x", "y"} and sum(c.unit == "m" for c in channels) == 2
    return (places["x"], places["y"], turns[0]) if is_plane and len(turns) == 1 else None


def away_from_center(network: Network, pose: tuple[Channel, Channel, Channel], name: str) -> Apply:
    """A marker that is ahead of the reference point, and to its left.

    Args:
        network: Formulas of the system.
        pose: Channels of x, y and heading.
    """
    x, y, turn = (channel.name for channel in pose)
    ahead, aside = f"{symbol(name)} ahead", f"{symbol(name)} aside"
    parts = {
        "h": written_out(network.readings[turn], network),
        "ahead": named(ahead),
        "aside": named(aside),
        "reading": named(READING),
    }
    change = Change(
        readings={
            x: filled(parse_expression("reading + ahead*cos(h) - aside*sin(h)"), parts),
            y: filled(parse_expression("reading + ahead*sin(h) + aside*cos(h)"), parts),
        }
    )
    return by_formulas(change, ahead, aside)
