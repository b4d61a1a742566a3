"""Formulas of a system by name, and what effects change in them.

Named are the rate of each state, the readings, and quantities in between (definitions, inputs,
parameters). A :class:`Change` gives a name another formula, in which the name itself stands for
what it was before, so that several changes of one name act one after the other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from threading import Lock

from diffsim.core.expression import Apply, Expression, Name, Node, NumberNode
from diffsim.ode import Ode

TIME = "t"
# parts beside which an operation is linear in its others; of all else: all
_LINEAR_BESIDE = {"add": (), "sub": (), "neg": (), "div": (1,), "where": (0,)}
_RAW = "{}~"  # an input or parameter as given, where a change stands for its name


@dataclass(frozen=True, eq=False)
class Change:
    """What an effect does to formulas."""

    # terms that are added to the rates of states, by state
    rates: Mapping[str, Expression] = field(default_factory=dict)
    # new rates of states, made of ``RATE``, what all other terms make it
    held_rates: Mapping[str, Expression] = field(default_factory=dict)
    # factors on the rates of states, by state
    factors: Mapping[str, Expression] = field(default_factory=dict)
    # new formulas of definitions, inputs and parameters, by name, made of the old value
    names: Mapping[str, Expression] = field(default_factory=dict)
    # new formulas of channels, made of ``READING``, the old one
    readings: Mapping[str, Expression] = field(default_factory=dict)
    # rates of further states, by name
    states: Mapping[str, Expression] = field(default_factory=dict)
    # start values of those, by name; 0 if absent
    starts: Mapping[str, Expression] = field(default_factory=dict)
    # names of further inputs, and whether they keep their value until the next time
    inputs: Mapping[str, bool] = field(default_factory=dict)

    @cached_property
    def _others(self) -> dict[tuple[str, ...], Change]:
        """Kept, as solvers are kept by their changes."""
        return {}

    def again(self, sizes: tuple[str, ...]) -> Change:
        """What the same effect does once more: its sizes, states and inputs have other names."""
        if sizes not in self._others:
            own = {n: named(once_more(n)) for n in (*sizes, *self.states, *self.inputs)}

            def renamed(formulas: Mapping[str, Expression]) -> dict[str, Expression]:
                return {
                    once_more(n) if n in self.states else n: filled(formula, own)
                    for n, formula in formulas.items()
                }

            self._others[sizes] = Change(
                rates=renamed(self.rates),
                held_rates=renamed(self.held_rates),
                factors=renamed(self.factors),
                names=renamed(self.names),
                readings=renamed(self.readings),
                states=renamed(self.states),
                starts=renamed(self.starts),
                inputs={once_more(n): held for n, held in self.inputs.items()},
            )
        return self._others[sizes]


def once_more(name: str) -> str:
    """What a size, state or input of an effect is called where it acts a second time."""
    return f"{name} once more"


# what a formula of a change was before; a state may be called "rate", none has a space
READING, RATE = "reading before", "rate before"


@dataclass(frozen=True, eq=False)
class Solver:
    """Formulas as the integrator takes them."""

    ode: Ode
    inputs: tuple[str, ...]  # names whose values it takes as inputs
    parameters: tuple[str, ...]  # names whose values it takes as parameters
    starts: Mapping[str, Expression]  # start values of states that changes have added, by name


class Network:
    """Formulas of a system.

    Args:
        rates: Rate of every state.
        readings: Formula of every channel.
        definitions: Named formulas that others may use.
        inputs: Names of inputs, with whether they are held between samples.
        limits: Lower and upper limits of states.
    """

    def __init__(
        self,
        rates: Mapping[str, Expression],
        readings: Mapping[str, Expression],
        definitions: Mapping[str, Expression],
        inputs: Mapping[str, bool],
        limits: Mapping[str, tuple[float, float]],
    ):
        self.rates, self.readings = dict(rates), dict(readings)
        self.definitions, self.inputs, self.limits = dict(definitions), dict(inputs), dict(limits)
        self._made: dict[tuple[Change, ...], Solver] = {}
        self._lock = Lock()

    def solver(self, changes: tuple[Change, ...]) -> Solver:
        """The integrator of the formulas as changed; made once for each set of changes."""
        with self._lock:
            if changes not in self._made:
                self._made[changes] = self._compile_solver(changes)
            return self._made[changes]

    def with_readings(self, readings: Mapping[str, Expression]) -> Network:
        """The same system, read otherwise."""
        return Network(self.rates, readings, self.definitions, self.inputs, self.limits)

    def channels_with(self, name: str) -> list[str]:
        """Channels whose readings need a definition, directly or by other definitions."""
        bodies = {n: e.root for n, e in self.definitions.items()}
        return [
            channel
            for channel, formula in self.readings.items()
            if any(n == name or name in _list_needed_by(n, bodies) for n in formula.names)
        ]

    def _compile_solver(self, changes: tuple[Change, ...]) -> Solver:
        rates = {s: e.root for s, e in self.rates.items()}
        readings = {c: e.root for c, e in self.readings.items()}
        bodies = {n: e.root for n, e in self.definitions.items()}
        inputs = dict(self.inputs)
        starts: dict[str, Expression] = {}
        for change in changes:
            rates |= {s: e.root for s, e in change.states.items()}
            starts |= change.starts
            inputs |= change.inputs
            for state, term in change.rates.items():
                rates[state] = Apply("add", (rates[state], term.root))
            for state, factor in change.factors.items():
                rates[state] = Apply("mul", (rates[state], factor.root))
            for name, formula in change.names.items():
                before = bodies.get(name, Name(_RAW.format(name)))
                # what is made of the name means in its new formula what it was before
                old = _ResolvedFormulas(bodies)
                circular = {
                    # with what the name was before, also where that is an input or a parameter
                    n: _substitute_names(old(Name(n)), {name: before}, {})
                    for n in formula.names
                    if n != name and n in bodies and name in _list_needed_by(n, bodies)
                }
                bodies[name] = _substitute_names(formula.root, {**circular, name: before}, {})
            for channel, formula in change.readings.items():
                readings[channel] = _substitute_names(
                    formula.root, {READING: readings[channel]}, {}
                )
        for change in changes:
            for state, formula in change.held_rates.items():
                rates[state] = _substitute_names(formula.root, {RATE: rates[state]}, {})
        raw = {_RAW.format(n): n for n in bodies if n not in self.definitions}
        resolved = _ResolvedFormulas(bodies)
        own_rates = {s: _make_expression(resolved(n)) for s, n in rates.items()}
        own_readings = {c: _make_expression(resolved(n)) for c, n in readings.items()}
        needed = dict.fromkeys(
            n for e in (*own_rates.values(), *own_readings.values()) for n in e.names
        )
        plain = {n: raw.get(n, n) for n in needed if n != TIME and n not in own_rates}
        of_kernel = {n: p for n, p in plain.items() if p in inputs}
        parameters = {n: p for n, p in plain.items() if p not in inputs}
        ode = Ode(
            rates=own_rates,
            readings=own_readings,
            inputs=list(of_kernel),
            parameters=list(parameters),
            held=[n for n, p in of_kernel.items() if inputs[p]],
            limits=self.limits,
        )
        return Solver(ode, tuple(of_kernel.values()), tuple(parameters.values()), starts)


def _list_needed_by(name: str, bodies: Mapping[str, Node]) -> set[str]:
    """All names that a definition needs, directly or by other definitions."""
    found: set[str] = set()
    left = [name] if name in bodies else []
    while left:
        for needed in _make_expression(bodies[left.pop()]).names:
            if needed not in found:
                found.add(needed)
                left += [needed] if needed in bodies else []
    return found


class _ResolvedFormulas:
    """Formulas with every definition written out; equal parts stay one object."""

    def __init__(self, bodies: Mapping[str, Node]):
        self._bodies = dict(bodies)
        self._done: dict[str, Node] = {}
        self._memo: dict[int, tuple[Node, Node]] = {}  # the node is kept, so that ids stay unique

    def __call__(self, node: Node) -> Node:
        if isinstance(node, Name):
            return self._resolve_name(node)
        if not isinstance(node, Apply):
            return node
        if id(node) not in self._memo:
            made = Apply(node.operation, tuple(self(part) for part in node.parts))
            self._memo[id(node)] = (node, made)
        return self._memo[id(node)][1]

    def _resolve_name(self, node: Name) -> Node:
        if node.name not in self._bodies:
            return node
        if node.name not in self._done:
            self._done[node.name] = self(self._bodies[node.name])
        return self._done[node.name]


def _substitute_names(node: Node, new: Mapping[str, Node], memo: dict[int, Node]) -> Node:
    """A formula with names replaced, their replacements left as they are."""
    if isinstance(node, Name):
        return new.get(node.name, node)
    if not isinstance(node, Apply):
        return node
    if id(node) not in memo:
        memo[id(node)] = Apply(
            node.operation, tuple(_substitute_names(part, new, memo) for part in node.parts)
        )
    return memo[id(node)]


def _make_expression(root: Node) -> Expression:
    names: dict[str, None] = {}
    seen: set[int] = set()

    def walk(node: Node) -> None:
        if isinstance(node, Name):
            names[node.name] = None
        elif isinstance(node, Apply) and id(node) not in seen:
            seen.add(id(node))
            for part in node.parts:
                walk(part)

    walk(root)
    return Expression("", tuple(names), root)


def named(name: str) -> Expression:
    """The formula that is a name; any text, also one that users cannot write."""
    return Expression(name, (name,), Name(name))


def filled(formula: Expression, parts: Mapping[str, Expression]) -> Expression:
    """A formula with names of it replaced by formulas."""
    return _make_expression(
        _substitute_names(formula.root, {k: e.root for k, e in parts.items()}, {})
    )


def written_out(formula: Expression, network: Network, but: str = "") -> Expression:
    """A formula with all definitions in it written out, but for one of them."""
    while names := (set(formula.names) & network.definitions.keys()) - {but}:
        formula = filled(formula, {name: network.definitions[name] for name in names})
    return formula


def is_linear(formula: Expression, name: str) -> bool:
    """Whether a formula is a straight line over a name, as its spelling shows."""
    return _degree(formula.root, name, {}) <= 1.0


def _degree(node: Node, name: str, memo: dict[int, float]) -> float:
    """Power of a name that a formula goes with; infinite where it is no polynomial of it."""
    if not isinstance(node, Apply):
        return float(isinstance(node, Name) and node.name == name)
    if id(node) not in memo:
        parts = [_degree(part, name, memo) for part in node.parts]
        is_constant = [not parts[k] for k in _LINEAR_BESIDE.get(node.operation, range(len(parts)))]
        if node.operation == "mul":
            degree = sum(parts)
        else:
            degree = max(parts) if all(is_constant) else math.inf
        memo[id(node)] = degree
    return memo[id(node)]


def product(a: Expression, b: Expression) -> Expression:
    """a times b."""
    return _make_expression(Apply("mul", (a.root, b.root)))


def piecewise(of: Expression, at: Sequence[float], values: Sequence[float]) -> Expression:
    """Straight lines through (at, values), held beyond the ends.

    Args:
        of: What the table is read at.
        at: Increasing places.
        values: Values there, equally many.
    """
    total: Node = NumberNode(values[0])
    for low, high, before, after in zip(at, at[1:], values, values[1:], strict=False):
        above = Apply("max", (Apply("sub", (of.root, NumberNode(low))), NumberNode(0.0)))
        inside = Apply("min", (above, NumberNode(high - low)))
        slope = NumberNode((after - before) / (high - low))
        total = Apply("add", (total, Apply("mul", (slope, inside))))
    return _make_expression(total)


def ordered(definitions: Mapping[str, Expression]) -> list[str]:
    """Names of definitions, each after those that it needs.

    Raises:
        ValueError: definitions that need each other in a circle.
    """
    out: list[str] = []

    def visit(name: str, above: tuple[str, ...]) -> None:
        if name in above:
            circle = " -> ".join((*above[above.index(name) :], name))
            raise ValueError(f"definitions need each other in a circle: {circle}")
        if name in out:
            return
        for needed in definitions[name].names:
            if needed in definitions:
                visit(needed, (*above, name))
        out.append(name)

    for name in definitions:
        visit(name, ())
    return out
