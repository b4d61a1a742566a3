"""Causes between what was commanded and what drives the system."""

from __future__ import annotations

from dataclasses import replace

import torch

from diffsim.core.expression import parse_expression
from diffsim.identify.effect import Effect, needs_nothing
from diffsim.systems.actuator import command_causes
from diffsim.systems.grid import SizedMap
from diffsim.systems.ode.applying import by_formulas, by_input, symbol
from diffsim.systems.ode.library import Library
from diffsim.systems.ode.network import Change, filled, named

SHARE = 0.03  # of the greatest input: slack, play and offset that are no surprise


def input_effects(library: Library) -> tuple[Effect, ...]:
    """Causes on the way of every input, each for itself where there are several."""
    out: list[Effect] = []
    for name, held in library.held.items():
        tail = "" if len(library.held) == 1 else f"_of_{name}"
        out += _of_input(library, name, held, tail)
        if library.several_runs:
            out.append(_gain_drift(name, tail, len(library.study.runs)))
    return tuple(out)


def _of_input(library: Library, name: str, held: bool, tail: str) -> list[Effect]:
    found = [
        replace(
            model,
            name=model.name + tail,
            masks=tuple(m + tail for m in model.masks),
            # what a study must have is checked where the input is read
            needs=needs_nothing,
            apply=by_input(name, change if model.smooth else _or_none(change)),
        )
        for model, change in command_causes(
            library.inputs.get(name, 1.0),
            SHARE,
            held=held,
            one_sided=name in library.one_sided,
        )
    ]
    return [*found, _slow_share(name, tail)]


def _or_none(change: SizedMap) -> SizedMap:
    """The map of an effect with a kink; at size 0 the signal itself, with its slope."""
    return lambda u, grid, size: torch.where(size[..., None] != 0.0, change(u, grid, size), u)


def _slow_share(name: str, tail: str) -> Effect:
    own = "slow_share" + tail
    state = f"slow state of {own}"
    parts = {"u": named(name), "z": named(state), "size": named(symbol(own))}
    change = Change(
        names={name: filled(parse_expression("u + size*(z - u)"), parts)},
        states={
            state: filled(parse_expression("(u - z)/tau"), {**parts, "tau": named("slow_time")})
        },
        starts={state: named(name)},
    )
    return Effect(
        name=own,
        form="A share size of the input comes within ``slow_time``.",
        family="slow",
        kind="actuator",
        unit="-",
        typical=0.1,
        also_looks_like=("creep", "a regulator that creeps to its set point", "leak, if negative"),
        apply=by_formulas(change, symbol(own)),
    )


def _gain_drift(name: str, tail: str, num_runs: int) -> Effect:
    own = "gain_drift" + tail
    parts = {"u": named(name), "size": named(symbol(own)), "n": named("run_order")}
    return Effect(
        name=own,
        form="The input does more by the share size from run to run.",
        family="drift",
        kind="actuator",
        unit="1/run",
        typical=0.1 / num_runs,
        also_looks_like=("warming", "wear", "growth with the level, where levels rose in order"),
        apply=by_formulas(
            Change(names={name: filled(parse_expression("u*(1 + size*n)"), parts)}), symbol(own)
        ),
    )
