"""Causes between what was commanded and what drives the system."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from diffsim.causes.commands import command_causes, in_words
from diffsim.causes.readings import PLAY_START
from diffsim.causes.signals import Grid, SizedMap, with_play
from diffsim.core.expression import parse_expression
from diffsim.data.study import Run
from diffsim.identify.effect import Apply, Effect, needs_nothing
from diffsim.systems.ode.applying import by_formulas, by_input, symbol
from diffsim.systems.ode.library import Library, needs_order
from diffsim.systems.ode.network import Change, filled, named
from diffsim.systems.ode.scene import OdeScene

_INSTANT = 1e-12  # s: shorter than any step
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
            needs=model.needs if model.name == "quantization" else needs_nothing,
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
    if name in library.unsure:
        return [*found, _held_between(name, tail)]
    return [*found, _straight_between(name, tail)] if name in library.assumed else found


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
    form = "The input keeps its value until the next sample (size 1), not a straight line."
    return _between(f"held_between_samples{tail}", form, name, held=True)


def _straight_between(name: str, tail: str) -> Effect:
    form = "The input goes straight to its next sample (size 1), and is not held until then."
    return _between(f"straight_between_samples{tail}", form, name, held=False)


def _between(own: str, form: str, name: str, *, held: bool) -> Effect:
    """What an input does between samples, other than the model says."""
    other = f"{name} {'held' if held else 'straight'}"
    parts = {"u": named(name), "other": named(other), "size": named(symbol(own))}
    total = filled(parse_expression("u + size*(other - u)"), parts)
    change = Change(
        names={name: total},
        inputs=() if held else (other,),
        held_inputs=(other,) if held else (),
    )
    return Effect(
        name=own,
        form=form,
        family="timing",
        kind="actuator",
        unit="-",
        typical=1.0,
        signed=False,
        also_looks_like=("delay of half a sample",),
        apply=partial(
            _instead,
            name=name,
            other=other,
            change=change,
            symbol=symbol(own),
            between=_kept if held else _straight,
        ),
    )


def _instead(
    scene: OdeScene,
    size: Tensor,
    run: Run,
    *,
    name: str,
    other: str,
    change: Change,
    symbol: str,
    between: Callable[[Tensor, Grid], Tensor],
) -> OdeScene:
    values = between(scene.inputs[name], scene.grid)
    return scene.with_further_input(other, values, change, {symbol: size[..., 0]})


def _kept(u: Tensor, grid: Grid) -> Tensor:
    """An input that keeps its value until the next sample, (..., num_times)."""
    before = torch.searchsorted(grid.samples, torch.arange(len(grid.times)), right=True) - 1
    return u[..., grid.samples][..., before]


def _straight(u: Tensor, grid: Grid) -> Tensor:
    """An input that goes straight from sample to sample, (..., num_times)."""
    places, last = torch.arange(len(grid.times)), len(grid.samples) - 1
    before = torch.searchsorted(grid.samples, places, right=True) - 1
    low, high = grid.samples[before], grid.samples[(before + 1).clamp(max=last)]
    step = (grid.times[high] - grid.times[low]).clamp(min=_INSTANT)
    return u[..., low] + (grid.times - grid.times[low]) / step * (u[..., high] - u[..., low])


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
        shown_unit="%",
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
