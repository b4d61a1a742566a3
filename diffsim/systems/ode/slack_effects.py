"""Slack inside a description: a difference of two places within which nothing is pulled, or of a
place and what a controller makes it follow.

A belt, gear or cable between two places is a definition such as ``k*(motor - load)``. Commands know
nothing of its play, and an added force at either place would have to be the spring itself.
"""

from __future__ import annotations

from diffsim.core.expression import parse_expression
from diffsim.identify.effect import Apply
from diffsim.systems.ode.applying import by_formulas, symbol
from diffsim.systems.ode.differences import differences, key_of
from diffsim.systems.ode.library import Library
from diffsim.systems.ode.network import Change, filled, named

_SLACK = "apart - clip(apart, -half, half)"
# whether anything is pulled: beyond the slack, and everywhere without one
_PULLED = "where(size, where(max(abs(apart) - half, 0), 1, 0), 1)"


def slack_inside(library: Library, definition: str, name: str) -> Apply:
    """A definition without its slack.

    Args:
        definition: Name of the definition.
        name: Name of the effect.
    """
    network = library.system.network
    plain, found = network.definitions[definition], differences(network)[definition]
    parts = {"apart": found.formula, "size": named(symbol(name))}
    parts["half"] = filled(parse_expression(f"size*{usual_apart(library, definition)!r}"), parts)
    slack, pulled = (filled(parse_expression(text), parts) for text in (_SLACK, _PULLED))
    # what other causes add to the definition stays
    parts = {"now": named(definition), "plain": plain}
    parts["slack"] = found.replaced_in(plain, slack, pulled)
    formula = filled(parse_expression("now + (slack - plain)"), parts)
    return by_formulas(Change(names={definition: formula}), symbol(name))


def usual_apart(library: Library, definition: str) -> float:
    """Rms of the difference in a definition, as the plain model has it."""
    return library.usual.get(key_of(definition), 1.0)


def unit_apart(library: Library, definition: str) -> str:
    """Unit of that difference, where its places say the same one."""
    names = set(differences(library.system.network)[definition].formula.names)
    units = {place.position_unit for place, _ in library.places if place.position in names}
    return units.pop() if len(units) == 1 else "-"
