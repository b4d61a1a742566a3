"""Causes between what was commanded and what drives the system."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from diffsim.causes.catalogue import rows
from diffsim.causes.commands import CommandGroup, command_causes
from diffsim.causes.signals import Grid
from diffsim.core.expression import parse_expression
from diffsim.data.study import Run
from diffsim.identify.effect import Effect, needs_nothing
from diffsim.systems.ode.applying import by_formulas, symbol
from diffsim.systems.ode.library import Library
from diffsim.systems.ode.network import Change, filled, named
from diffsim.systems.ode.scene import OdeScene

_INSTANT = 1e-12  # s: shorter than any step


def input_effects(library: Library) -> tuple[Effect, ...]:
    """Causes on the way of every input, each for itself where there are several."""
    out: list[Effect] = []
    for name in library.system.held:
        ending = "" if len(library.system.held) == 1 else f"_of_{name}"
        out += _list_causes(library, name, ending)
        out.append(_make_gain_drift(name, ending, len({r.order for r in library.study.fit_runs})))
    return tuple(out)


def group_of(library: Library, name: str, ending: str = "") -> CommandGroup:
    """An input as causes of commands see it.

    Args:
        library: Names and magnitudes of the system.
        name: Name of the input.
        ending: What names of its causes end with.
    """
    units = {c.name: (c.unit, c.shown_unit) for c in library.study.commands}
    unit, shown = units.get(name, (None, None))
    return CommandGroup(
        (name,),
        library.scales.of_commands((name,)),
        "held" if library.system.held[name] else "straight",
        library.scales.is_one_sided((name,)),
        ending,
        unit,
        shown,
    )


def _list_causes(library: Library, name: str, ending: str) -> list[Effect]:
    found = [
        # what a study must have is checked where the input is read
        effect if effect.name == f"quantization{ending}" else replace(effect, needs=needs_nothing)
        for effect in command_causes(group_of(library, name, ending), system="ode")
    ]
    found.append(_make_slow_share(name, ending))
    # after all that changes the input on its way, which it is a copy of
    if name in library.system.unsure:
        return [*found, _make_between(f"held_between_samples{ending}", name, held=True)]
    if name in library.system.assumed:
        return [*found, _make_between(f"straight_between_samples{ending}", name, held=False)]
    return found


def _make_between(own: str, name: str, *, held: bool) -> Effect:
    """What an input does between samples, other than the model says."""
    other = f"{name} {'held' if held else 'straight'}"
    parts = {"u": named(name), "other": named(other), "size": named(symbol(own))}
    total = filled(parse_expression("u + size*(other - u)"), parts)
    change = Change(
        names={name: total},
        inputs=() if held else (other,),
        held_inputs=(other,) if held else (),
    )
    apply = partial(
        _replace_input,
        name=name,
        other=other,
        change=change,
        symbol=symbol(own),
        between=_hold_input if held else _join_samples,
    )
    row = rows("ode")["held_between_samples" if held else "straight_between_samples"]
    return row.effect(apply, name=own)


def _replace_input(
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


def _hold_input(u: Tensor, grid: Grid) -> Tensor:
    """An input that keeps its value until the next sample, (..., num_times)."""
    before = torch.searchsorted(grid.samples, torch.arange(len(grid.times)), right=True) - 1
    return u[..., grid.samples][..., before]


def _join_samples(u: Tensor, grid: Grid) -> Tensor:
    """An input that goes straight from sample to sample, (..., num_times)."""
    places, last = torch.arange(len(grid.times)), len(grid.samples) - 1
    before = torch.searchsorted(grid.samples, places, right=True) - 1
    low, high = grid.samples[before], grid.samples[(before + 1).clamp(max=last)]
    step = (grid.times[high] - grid.times[low]).clamp(min=_INSTANT)
    return u[..., low] + (grid.times - grid.times[low]) / step * (u[..., high] - u[..., low])


def _make_slow_share(name: str, ending: str) -> Effect:
    own = "slow_share" + ending
    state = f"slow state of {own}"
    parts = {"u": named(name), "z": named(state), "size": named(symbol(own))}
    change = Change(
        names={name: filled(parse_expression("u + size*(z - u)"), parts)},
        states={
            state: filled(parse_expression("(u - z)/tau"), {**parts, "tau": named("slow_time")})
        },
        starts={state: named(name)},
    )
    return rows("ode")["slow_share"].effect(by_formulas(change, symbol(own)), ending=ending)


def _make_gain_drift(name: str, ending: str, num_runs: int) -> Effect:
    own = "gain_drift" + ending
    parts = {"u": named(name), "size": named(symbol(own)), "n": named("run_order")}
    change = Change(names={name: filled(parse_expression("u*(1 + size*n)"), parts)})
    scales = {"runs": float(max(num_runs, 1))}
    row = rows("ode")["gain_drift"]
    return row.effect(by_formulas(change, symbol(own)), scales, ending=ending)
