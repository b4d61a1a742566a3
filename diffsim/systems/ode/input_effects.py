"""Causes between what was commanded and what drives the system."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import torch
from torch import Tensor

from diffsim.causes.commands import CommandGroup
from diffsim.causes.readings import usual_sample
from diffsim.causes.signals import Grid, accelerated
from diffsim.core.expression import parse_expression
from diffsim.identify.effect import Apply
from diffsim.systems.ode.applying import by_formulas, symbol, with_inputs
from diffsim.systems.ode.joint_effects import current_of
from diffsim.systems.ode.library import Library
from diffsim.systems.ode.network import Change, filled, named
from diffsim.systems.ode.scene import OdeScene


def input_ways(library: Library) -> tuple[CommandGroup, ...]:
    """Every input by itself, as causes of commands see it."""
    system, several = library.system, len(library.system.held) > 1
    units = {c.name: (c.unit, c.shown_unit) for c in library.study.commands}
    is_electric = current_of(library.study.channels) is not None
    return tuple(
        CommandGroup(
            (name,),
            library.scales.of_commands((name,)),
            "held" if held else "straight",
            library.scales.is_one_sided((name,)),
            f"_of_{name}" if several else "",
            *units.get(name, (None, None)),
            facts=tuple(
                fact
                for fact, holds in (
                    ("unsure", name in system.unsure),
                    ("assumed", name in system.assumed),
                    ("drives_current", is_electric and units.get(name, ("",))[0] == "V"),
                )
                if holds
            ),
            sample_s=usual_sample(library.study.runs),
        )
        for name, held in system.held.items()
    )


def between_samples(name: str, own: str, *, held: bool) -> Apply:
    """What an input does between samples, other than the model says.

    It comes after all that changes the input on its way, which it is a copy of.

    Args:
        own: Name of the effect.
        held: Whether it is held, in place of going straight.
    """
    other = f"{name} {'held' if held else 'straight'}"
    parts = {"u": named(name), "other": named(other), "size": named(symbol(own))}
    total = filled(parse_expression("u + size*(other - u)"), parts)
    change = Change(names={name: total}, inputs={other: held})
    between = _hold_input if held else _join_samples
    return with_inputs(change, symbol(own), partial(_between_samples, name, other, between))


def _between_samples(
    name: str,
    other: str,
    between: Callable[[Tensor, Grid], Tensor],
    scene: OdeScene,
    size: Tensor,
) -> dict[str, Tensor]:
    return {other: between(scene.inputs[name], scene.grid)}


def _hold_input(u: Tensor, grid: Grid) -> Tensor:
    """An input that keeps its value until the next sample, (..., num_times)."""
    before = torch.searchsorted(grid.samples, torch.arange(len(grid.times)), right=True) - 1
    return u[..., grid.samples][..., before]


def _join_samples(u: Tensor, grid: Grid) -> Tensor:
    """An input that goes straight from sample to sample, (..., num_times)."""
    places, last = torch.arange(len(grid.times)), len(grid.samples) - 1
    before = torch.searchsorted(grid.samples, places, right=True) - 1
    low, high = grid.samples[before], grid.samples[(before + 1).clamp(max=last)]
    step = (grid.times[high] - grid.times[low]).clamp(min=1e-12)  # [s]: shorter than any step
    return u[..., low] + (grid.times - grid.times[low]) / step * (u[..., high] - u[..., low])


def come_slowly(name: str, own: str) -> Apply:
    """A share of an input comes within the slow time.

    Args:
        own: Name of the effect.
    """
    state = f"slow state of {own}"
    parts = {"u": named(name), "z": named(state), "size": named(symbol(own))}
    change = Change(
        names={name: filled(parse_expression("u + size*(z - u)"), parts)},
        states={
            state: filled(parse_expression("(u - z)/tau"), {**parts, "tau": named("slow_time")})
        },
        starts={state: named(name)},
    )
    return by_formulas(change, symbol(own))


def follow_profile(name: str, own: str, *, held: Mapping[str, bool]) -> Apply:
    """An input that is a set point behind a profile: it is no longer held between samples.

    Args:
        own: Name of the effect.
        held: Whether inputs are held, by name.
    """
    other = f"{name} for {own}"
    parts = {"u": named(name), "other": named(other), "size": named(symbol(own))}
    change = Change(
        names={name: filled(parse_expression("where(size, other, u)"), parts)},
        inputs={other: False},
    )
    return with_inputs(change, symbol(own), partial(_accelerate_input, name, other, held[name]))


def _accelerate_input(
    name: str, other: str, is_held: bool, scene: OdeScene, size: Tensor
) -> dict[str, Tensor]:
    most, fastest = size[..., :1], size[..., 1:2]

    def follow(u: Tensor, grid: Grid) -> Tensor:
        return accelerated(u, grid, most, fastest, held=is_held)

    row, u = scene.commands.rows[name][:1], scene.inputs[name][..., None, :]
    return {other: scene.commands.act(follow, row, u, scene.grid)[..., 0, :]}


def drift_in_order(name: str, own: str) -> Apply:
    """An input does more from run to run.

    Args:
        own: Name of the effect.
    """
    parts = {"u": named(name), "size": named(symbol(own)), "n": named("run_order")}
    change = Change(names={name: filled(parse_expression("u*(1 + size*n)"), parts)})
    return by_formulas(change, symbol(own))
