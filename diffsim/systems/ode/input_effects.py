"""Causes between what was commanded and what drives the system."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from diffsim.core.expression import parse_expression
from diffsim.data.study import Run
from diffsim.identify.effect import Apply, Effect, needs_nothing
from diffsim.systems.actuator import command_causes, in_words
from diffsim.systems.grid import SizedMap, with_play
from diffsim.systems.instrument import PLAY_START
from diffsim.systems.ode.applying import by_formulas, by_input, symbol
from diffsim.systems.ode.library import Library, needs_order
from diffsim.systems.ode.network import Change, filled, named
from diffsim.systems.ode.scene import OdeScene

SHARE = 0.03  # of the greatest input: slack, play and offset that are no surprise


def input_effects(library: Library) -> tuple[Effect, ...]:
    """Causes on the way of every input, each for itself where there are several."""
    out: list[Effect] = []
    for name, held in library.held.items():
        tail = "" if len(library.held) == 1 else f"_of_{name}"
        out += _of_input(library, name, held, tail)
        out.append(_gain_drift(name, tail, len({r.order for r in library.study.fit_runs})))
    return tuple(out)


def _of_input(library: Library, name: str, held: bool, tail: str) -> list[Effect]:
    units = {c.name: (c.unit, c.shown_unit) for c in library.study.commands}
    unit, shown = units.get(name, (None, None))
    found = [
        replace(
            model if unit is None else in_words(model, unit, shown),
            name=model.name + tail,
            masks=tuple(m + tail for m in model.masks),
            # what a study must have is checked where the input is read
            needs=needs_nothing,
            apply=_played(name)
            if model.name == "backlash"
            else by_input(name, change if model.smooth else _or_none(change)),
        )
        for model, change in command_causes(
            library.inputs.get(name, 1.0),
            SHARE,
            held=held,
            one_sided=name in library.one_sided,
        )
    ]
    found.append(_slow_share(name, tail))
    # after all that changes the input on its way, which it is a copy of
    return [*found, _held_between(name, tail)] if name in library.unsure else found


def _played(name: str) -> Apply:
    """An input behind a play, from where it is in the play at the start."""

    def apply(scene: OdeScene, size: Tensor, run: Run) -> OdeScene:
        start = scene.values.get(PLAY_START)
        behind = _or_none(lambda u, grid, half: with_play(u, grid, half, start))
        return scene.with_input(name, lambda u, grid: behind(u, grid, size[..., 0]))

    return apply


def _or_none(change: SizedMap) -> SizedMap:
    """The map of an effect with a kink; at size 0 the signal itself, with its slope."""
    return lambda u, grid, size: torch.where(size[..., None] != 0.0, change(u, grid, size), u)


def _held_between(name: str, tail: str) -> Effect:
    own = f"held_between_samples{tail}"
    kept = f"{name} held"
    parts = {"u": named(name), "kept": named(kept), "size": named(symbol(own))}
    total = filled(parse_expression("u + min(size, 1)*(kept - u)"), parts)
    change = Change(names={name: total}, held_inputs=(kept,))
    return Effect(
        name=own,
        form="The input keeps its value until the next sample (size 1), not a straight line.",
        family="timing",
        kind="actuator",
        unit="-",
        typical=1.0,
        signed=False,
        also_looks_like=("delay of half a sample",),
        apply=partial(_kept, name=name, kept=kept, change=change, symbol=symbol(own)),
    )


def _kept(
    scene: OdeScene, size: Tensor, run: Run, *, name: str, kept: str, change: Change, symbol: str
) -> OdeScene:
    samples, u = scene.grid.samples, scene.inputs[name]
    before = torch.searchsorted(samples, torch.arange(len(scene.grid.times)), right=True) - 1
    values = u[..., samples][..., before]
    return scene.with_further_input(kept, values, change, {symbol: size[..., 0]})


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
        form="A share size of the input comes within the slow time.",
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
        typical=0.1 / max(num_runs, 1),
        needs=needs_order,
        also_looks_like=("warming", "wear", "growth with the level, where levels rose in order"),
        apply=by_formulas(
            Change(names={name: filled(parse_expression("u*(1 + size*n)"), parts)}), symbol(own)
        ),
    )
