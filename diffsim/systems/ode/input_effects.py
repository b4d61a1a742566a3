"""Causes between what was commanded and what drives the system."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from diffsim.core.expression import parse_expression
from diffsim.identify.effect import Effect
from diffsim.systems.actuator import BACKLASH, COMMAND_DELAY, DEAD_BAND, HELD_LAG, SATURATION
from diffsim.systems.ode import grid as signals
from diffsim.systems.ode.applying import SizedMap, by_formulas, by_input, symbol
from diffsim.systems.ode.grid import Grid
from diffsim.systems.ode.library import Library, needs_order
from diffsim.systems.ode.network import Change, filled, named

_LARGEST_RATE = 1e6  # ranges per second: a slew time below it is none


def input_effects(library: Library) -> tuple[Effect, ...]:
    """Causes on the way of every input, each for itself where there are several."""
    out: list[Effect] = []
    for name, held in library.held.items():
        tail = "" if len(library.held) == 1 else f"_of_{name}"
        out += _of_input(name, held, tail, library.inputs.get(name, 1.0))
        out.append(_gain_drift(name, tail, library.usual.num_runs))
    return tuple(out)


def _of_input(name: str, held: bool, tail: str, most: float) -> list[Effect]:
    lag, delay = (
        (signals.held_lagged, signals.held_delayed) if held else (signals.lagged, signals.delayed)
    )

    def on_signal(model: Effect, change: SizedMap) -> Effect:
        return _named(model, tail, apply=by_input(name, change))

    def with_kink(model: Effect, change: SizedMap) -> Effect:
        # at size 0 the signal itself, with its slope
        return on_signal(
            model,
            lambda u, grid, size: torch.where(size[..., None] != 0.0, change(u, grid, size), u),
        )

    return [
        on_signal(replace(HELD_LAG, form="First-order lag with the time constant size."), lag),
        on_signal(replace(COMMAND_DELAY, form="The input comes size later than recorded."), delay),
        on_signal(_GAIN, lambda u, grid, size: u * (1.0 + size[..., None])),
        on_signal(
            replace(_GAIN_SLOPE, typical=0.2 / most),
            lambda u, grid, size: u * (1.0 + size[..., None] * u.abs()),
        ),
        on_signal(replace(_OFFSET, typical=0.03 * most), lambda u, grid, size: u + size[..., None]),
        with_kink(replace(DEAD_BAND, typical=0.03 * most), _dead_band),
        with_kink(replace(BACKLASH, typical=0.03 * most), _backlash),
        with_kink(replace(_SLACK, typical=0.03 * most), _slack),
        with_kink(SATURATION, lambda u, grid, size: _saturated(u, size, most)),
        with_kink(_SLEW_TIME, lambda u, grid, size: _slewed(u, grid, size, most)),
        _slow_share(name, tail),
    ]


def _named(model: Effect, tail: str, **more: Any) -> Effect:
    # what a study must have is checked where the input is read
    return replace(model, name=model.name + tail, needs=lambda study: None, **more)


def _dead_band(u: Tensor, grid: Grid, size: Tensor) -> Tensor:
    return u.sign() * (u.abs() - size[..., None]).clamp(min=0.0)


def _slack(u: Tensor, grid: Grid, size: Tensor) -> Tensor:
    return torch.where(u > 0.0, (u - size[..., None]).clamp(min=0.0), u)


def _backlash(u: Tensor, grid: Grid, size: Tensor) -> Tensor:
    return signals.with_play(u, size)


def _saturated(u: Tensor, size: Tensor, most: float) -> Tensor:
    limit = ((1.0 - size) * most).clamp(min=0.0)[..., None]
    return torch.minimum(torch.maximum(u, -limit), limit)


def _slewed(u: Tensor, grid: Grid, size: Tensor, most: float) -> Tensor:
    rate = most / size.clamp(min=1.0 / _LARGEST_RATE)
    return signals.slowed(u, grid, rate)


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
        typical=0.1 / max(num_runs, 1),
        needs=needs_order,
        also_looks_like=("warming", "wear", "growth with the level, where levels rose in order"),
        apply=by_formulas(
            Change(names={name: filled(parse_expression("u*(1 + size*n)"), parts)}), symbol(own)
        ),
    )


def _refuse(*_: Any) -> None:
    raise TypeError("a pattern of an effect, made for an input by input_effects")


_GAIN = Effect(
    name="command_gain",
    form="The input does (1 + size) times as much.",
    family="gain",
    kind="actuator",
    unit="-",
    typical=0.1,
    also_looks_like=("inertia", "stiffness", "scale of the sensors"),
    apply=_refuse,
)
_GAIN_SLOPE = replace(
    _GAIN,
    name="gain_slope",
    form="The input does 1 + size |input| times as much: more at large amplitude.",
    family="shape",
    unit="1/command",
    also_looks_like=("softening", "saturation, if negative"),
)
_OFFSET = replace(
    _GAIN,
    name="command_offset",
    form="The input is larger by size.",
    family="constant",
    unit="command",
    also_looks_like=("constant force", "offset of the sensor"),
)
_SLACK = replace(
    _GAIN,
    name="command_slack",
    form="Nothing happens until a positive input exceeds size, then it acts less size.",
    family="shape",
    unit="command",
    signed=False,
    smooth=False,
    masks=("slew_time",),
    also_looks_like=("dead band", "a string that hangs loose"),
)
_SLEW_TIME = replace(
    _GAIN,
    name="slew_time",
    form="The drive needs the time size for its greatest input, however small the step.",
    family="timing",
    unit="s",
    typical=0.05,
    signed=False,
    smooth=False,
    also_looks_like=("lag, at one amplitude", "weak battery"),
)
