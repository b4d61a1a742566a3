"""Causes that a user writes as formulas in the study."""

from __future__ import annotations

from functools import partial

from torch import Tensor

from diffsim.core.expression import Expression, parse_expression
from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.systems.ode.applying import symbol
from diffsim.systems.ode.keys import OwnEffect
from diffsim.systems.ode.names import Reader
from diffsim.systems.ode.network import READING, Change, filled, named
from diffsim.systems.ode.scene import OdeScene


def own_effects(
    own: tuple[OwnEffect, ...],
    study: Study,
    known: tuple[str, ...],
    states: tuple[str, ...],
    reader: Reader,
) -> tuple[Effect, ...]:
    """Effects from the blocks ``effects.own``.

    Args:
        own: The blocks.
        study: Study with the recordings.
        known: Names that formulas may use.
        states: Those of them that are states.
        reader: Receives the mistakes.
    """
    return tuple(
        _effect(f"effects.own[{i}]", block, study, known, states, reader)
        for i, block in enumerate(own)
    )


def _effect(
    where: str,
    block: OwnEffect,
    study: Study,
    known: tuple[str, ...],
    states: tuple[str, ...],
    reader: Reader,
) -> Effect:
    reader.require_per(where, block.per)
    labels = _labels(block, study)
    shared = symbol(block.name)
    return Effect(
        name=block.name,
        form=block.form or _form(block),
        family=block.family,
        kind=block.kind,
        unit=block.unit,
        typical=block.typical,
        signed=block.signed,
        smooth=block.smooth,
        also_looks_like=block.also_looks_like,
        components=("size",)
        if len(labels) < 2
        else ("all", *(f"[{block.per}={x}]" for x in labels)),
        apply=partial(
            _apply,
            change=_change(where, block, study, known, states, reader),
            symbol=shared,
            per=block.per,
            labels=labels,
        ),
    )


def _components(block: OwnEffect, labels: tuple[str, ...]) -> tuple[str, ...]:
    """One size for all, and what each label has beside it."""
    if len(labels) < 2:
        return ("size",)
    return ("all", *(f"[{block.per}={label}]" for label in labels))


def _labels(block: OwnEffect, study: Study) -> tuple[str, ...]:
    if block.per is None:
        return ()
    if block.per == "run":
        return tuple(run.name for run in study.runs)
    return tuple(dict.fromkeys(str(run.setup.get(block.per)) for run in study.runs))


def _apply(
    scene: OdeScene,
    size: Tensor,
    run: Run,
    *,
    change: Change,
    symbol: str,
    per: str | None,
    labels: tuple[str, ...],
) -> OdeScene:
    own = size[..., 0]
    if len(labels) > 1:
        label = run.name if per == "run" else str(run.setup.get(str(per)))
        # what nobody has fitted is like the others
        own = own + size[..., 1 + labels.index(label)] if label in labels else own
    return scene.with_change(change, {symbol: own})


def _form(block: OwnEffect) -> str:
    if block.adds_to is not None:
        return f"{block.term} is added to {block.adds_to}."
    if block.multiplies is not None:
        return f"{block.multiplies} times {block.term}."
    return "; ".join(f"{k} becomes {v}" for k, v in block.changes.items()) + "."


def _change(
    where: str,
    block: OwnEffect,
    study: Study,
    known: tuple[str, ...],
    states: tuple[str, ...],
    reader: Reader,
) -> Change:
    channels = [c.name for c in study.channels]
    names = tuple(dict.fromkeys((*known, *channels, *block.states, block.size)))
    own_states = {s: f"{s} of {block.name}" for s in block.states}
    parts = {block.size: named(symbol(block.name))} | {s: named(n) for s, n in own_states.items()}

    def read(key: str, text: str) -> Expression:
        return filled(reader.parse(f"{where}.{key}", text, names), parts)

    rates: dict[str, Expression] = {}
    factors: dict[str, Expression] = {}
    new, readings = {}, {}
    changes = dict(block.changes)
    key = "changes"
    target = block.adds_to or block.multiplies
    if target is not None:
        operator = "+" if block.adds_to else "*"
        if target in states:
            into = rates if block.adds_to else factors
            into[target] = read("term", str(block.term))
        else:
            changes[target] = f"{target} {operator} ({block.term})"
            key = "adds_to" if block.adds_to else "multiplies"
    for name, text in changes.items():
        if name in channels:
            readings[name] = filled(read(f"changes.{name}", text), {name: named(READING)})
        elif name in known and name not in states:
            new[name] = read(f"changes.{name}", text)
        else:
            reader.report(
                f"{where}.{key}",
                f"{name!r} is no state, definition, input, parameter or channel of the model"
                if name not in states
                else f"{name!r} is a state: change its rate by adds_to or multiplies",
            )
    return Change(
        rates=rates,
        factors=factors,
        names=new,
        readings=readings,
        states={own_states[s]: read(f"states.{s}.rate", b.rate) for s, b in block.states.items()},
        starts={own_states[s]: parse_expression(b.start) for s, b in block.states.items()},
    )
