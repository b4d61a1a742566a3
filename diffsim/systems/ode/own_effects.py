"""Causes that a user writes as formulas in the study."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from diffsim.causes.row import with_size
from diffsim.core.expression import Expression, parse_expression
from diffsim.data.study import Study
from diffsim.identify.effect import Effect
from diffsim.systems.ode.applying import RunGroups, apply_in_group, symbol
from diffsim.systems.ode.keys import OLD_KEYS, OwnEffect
from diffsim.systems.ode.names import Reader
from diffsim.systems.ode.network import READING, Change, filled, named
from diffsim.systems.ode.scene import at_start


def own_effect(
    where: str,
    block: OwnEffect,
    study: Study,
    known: tuple[str, ...],
    beside: Mapping[str, bool],
    states: tuple[str, ...],
    reader: Reader,
) -> Effect:
    """The effect of a block of ``effects.own``.

    Args:
        known: Names that formulas may use.
        beside: Those of them that were recorded and are no inputs; whether they are held.
        states: Those of them that are states.
    """
    reader.require_per(where, block.per)
    blocks = ((study.model or {}).get("effects") or {}).get("own") or ()
    stated: Mapping[str, Any] = next((b for b in blocks if b.get("name") == block.name), {})
    for old, (new, is_opposite) in OLD_KEYS.items():
        if old in stated:
            said = f"{new}: {str(not stated[old]).lower()}" if is_opposite else new
            reader.report(f"{where}.{old}", f"is read as {said}, as rows have it", "note")
    groups = RunGroups.of(block.per, study)
    return Effect(
        name=block.name,
        form=block.form or _say_form(block),
        family=block.family,
        kind=block.kind,
        unit=block.unit,
        typical=block.typical,
        signed=not block.one_sided,
        smooth=not block.kink,
        scanned=block.scanned,
        tries=(-1.0, 1.0) if block.scanned else (),
        also_looks_like=block.like,
        price=block.price,
        words=None if block.words is None else partial(with_size, block.words),
        components=groups.components,
        apply=partial(
            apply_in_group,
            change=_make_change(where, block, study, known, beside, states, reader),
            symbol=symbol(block.name),
            groups=groups,
        ),
    )


def _say_form(block: OwnEffect) -> str:
    if block.adds_to is not None:
        return f"{block.term} is added to {block.adds_to}."
    if block.multiplies is not None:
        return f"{block.multiplies} times {block.term}."
    added = [f"{v} is added to {k}" for k, v in block.adds.items()]
    return "; ".join([*added, *(f"{k} becomes {v}" for k, v in block.changes.items())]) + "."


def _make_change(
    where: str,
    block: OwnEffect,
    study: Study,
    known: tuple[str, ...],
    beside: Mapping[str, bool],
    states: tuple[str, ...],
    reader: Reader,
) -> Change:
    channels = [c.name for c in study.channels]
    names = tuple(dict.fromkeys((*known, *channels, *block.states, *block.shapes, block.size)))
    own_states = {s: f"{s} of {block.name}" for s in block.states}
    parts = {block.size: named(symbol(block.name))} | {s: named(n) for s, n in own_states.items()}
    parts |= {s: named(shape_name(block, s)) for s in block.shapes}
    begins = {s: named(at_start(s)) for s in states}
    used: set[str] = set()

    def read(key: str, text: str) -> Expression:
        found = reader.parse(f"{where}.{key}", text, names)
        used.update(found.names)
        return filled(found, parts)

    rates: dict[str, Expression] = {}
    factors: dict[str, Expression] = {}
    made: dict[str, Expression] = {}
    key = "changes"
    target = block.adds_to or block.multiplies
    if target is not None:
        key, operator = ("adds_to", "+") if block.adds_to else ("multiplies", "*")
        term = read("term", str(block.term))
        if target in states:
            (rates if block.adds_to else factors)[target] = term
        else:
            parts_of_new = {"before": named(target), "term": term}
            made[target] = filled(parse_expression(f"before {operator} term"), parts_of_new)
    for name, text in block.adds.items():
        term = read(f"adds.{name}", text)
        if name in states:
            rates[name] = term
        else:
            parts_of_new = {"before": named(name), "term": term}
            made[name] = filled(parse_expression("before + term"), parts_of_new)
    new, readings = {}, {}
    for name in (*made, *block.changes):
        is_known = name in channels or (name in known and name not in states)
        if not is_known:
            reader.report(
                f"{where}.{'adds' if name in block.adds else key}",
                f"{name!r} is no state, definition, input, parameter or channel of the model"
                if name not in states
                else f"{name!r} is a state: change its rate by adds_to or multiplies",
            )
            continue
        formula = made[name] if name in made else read(f"changes.{name}", block.changes[name])
        if name in channels:
            readings[name] = filled(formula, {name: named(READING)})
        else:
            new[name] = formula
    rates_of_own = {
        own_states[s]: read(f"states.{s}.rate", b.rate) for s, b in block.states.items()
    }
    return Change(
        rates=rates,
        factors=factors,
        names=new,
        readings=readings,
        states=rates_of_own,
        starts={
            own_states[s]: filled(parse_expression(b.start), begins | parts)
            for s, b in block.states.items()
        },
        inputs={n: beside[n] for n in sorted(used.intersection(beside))},
    )


def shape_name(block: OwnEffect, shape: str) -> str:
    """Name of the base parameter that a number of a cause's formulas is."""
    return f"{shape}_of_{block.name}"
