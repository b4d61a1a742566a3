"""Differences of two places in definitions, such as what a belt, gear or cable pulls by."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from diffsim.core.expression import Apply, Expression, Name, Node
from diffsim.systems.ode.network import Network, filled, named


@dataclass(frozen=True)
class Difference:
    """A difference of two places in a definition, or of a place and what it shall follow.

    Attributes:
        node: As it is written there.
        speeds: Speeds of the same places, in this order; None where these are no plain states.
    """

    node: Apply
    speeds: tuple[str, ...] | None

    @property
    def formula(self) -> Expression:
        """The difference as a formula."""
        return _formula_of(self.node)

    def replaced_in(self, plain: Expression, slack: Expression, pulled: Expression) -> Expression:
        """A formula with something else in place of the difference.

        Args:
            slack: What stands in its place.
            pulled: Factor of the difference of the speeds.
        """
        return _formula_of(self._replace(plain.root, slack.root, pulled.root))

    def _replace(self, node: Node, slack: Node, pulled: Node) -> Node:
        if not isinstance(node, Apply):
            return node
        if node == self.node:
            return slack
        made = Apply(node.operation, tuple(self._replace(p, slack, pulled) for p in node.parts))
        names = tuple(part.name for part in node.parts if isinstance(part, Name))
        is_speed = node.operation == "sub" and self.speeds in (names, names[::-1])
        return Apply("mul", (made, pulled)) if is_speed else made


def differences(network: Network) -> dict[str, Difference]:
    """The first such difference in each definition, by its name."""
    found = ((n, next(_find(e.root, network), None)) for n, e in network.definitions.items())
    return {name: first for name, first in found if first is not None}


def key_of(definition: str) -> str:
    """What the difference in a definition is called among magnitudes; no user can write it."""
    return f"difference in {definition}"


def _find(node: Node, network: Network) -> Iterator[Difference]:
    if not isinstance(node, Apply):
        return
    if node.operation == "sub":
        places = [_place_in(part, network) for part in node.parts]
        goals = [_is_input(part, network) for part in node.parts]
        if all(places) and places[0] != places[1]:
            is_plain = all(isinstance(part, Name) for part in node.parts)
            speeds = (_speed_of(place, network) for place in places)
            yield Difference(node, tuple(speeds) if is_plain else None)
        elif any(places) and any(goals):
            yield Difference(node, None)  # what a controller makes of its speeds stays
    for part in node.parts:
        yield from _find(part, network)


def _place_in(node: Node, network: Network) -> str:
    """The one state that a formula is made of, beside numbers, if its rate is another state; else
    nothing."""
    names = set(_formula_of(node).names)
    states = names & network.rates.keys()
    is_alone = len(states) == 1 and not names & (network.inputs.keys() | network.definitions.keys())
    return next((s for s in states if _speed_of(s, network)), "") if is_alone else ""


def _is_input(node: Node, network: Network) -> bool:
    """Whether a formula is made of one input alone, beside numbers: what a controller follows."""
    names = set(_formula_of(node).names)
    is_alone = not names & (network.rates.keys() | network.definitions.keys())
    return is_alone and len(names & network.inputs.keys()) == 1


def _speed_of(place: str, network: Network) -> str:
    rate = network.rates[place].root
    return rate.name if isinstance(rate, Name) and rate.name in network.rates else ""


def _formula_of(root: Node) -> Expression:
    return filled(named("part"), {"part": Expression("", (), root)})
