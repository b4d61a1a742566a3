"""Causes between a command and the actuators: the one home of them, whatever the system.

A cause is an effect and a map of signals (``diffsim.systems.grid``). Systems whose scenes have
``with_command`` take the effects as they are; others bind the maps to their own inputs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from diffsim.core.units import factor
from diffsim.data.study import Run, Study
from diffsim.identify.effect import Apply, Effect
from diffsim.systems import grid as signals
from diffsim.systems.grid import Grid, SizedMap, on_columns

Array = NDArray[np.float64]
_NOTHING = 1e-300  # of a command that is zero throughout


class Commanded(Protocol):
    """A scene with a command, (num_samples, width), on its way through maps."""

    def with_command(self, change: Callable[[Tensor, float], Tensor]) -> Any:
        """A copy with one more map f(command, dt)."""
        ...


def needs_command(study: Study) -> str | None:
    """Runs with a recorded command."""
    if not any(run.command for run in study.runs):
        return "runs with a recorded command"
    return None


def needs_fine_command(study: Study) -> str | None:
    """A recorded command of more values than the finest steps that a scan tries."""
    if (lacks := needs_command(study)) is not None:
        return lacks
    values = [
        np.unique(np.concatenate([run.command[name] for run in study.runs if name in run.command]))
        for name in {name for run in study.runs for name in run.command}
    ]
    most = max(len(np.unique(_digits(v[np.isfinite(v)]))) for v in values)
    if most < FINE:
        return f"a command of {FINE} values or more; the recorded one has {most}"
    return None


def _digits(values: Array) -> Array:
    """Values to six digits of the largest, so that rounding of a file makes none."""
    return np.round(values / max(float(np.abs(values).max(initial=0.0)), _NOTHING), 6)


def on_command(change: SizedMap) -> Apply:
    """An effect's ``apply`` that maps the command of a scene."""
    return partial(_commanded, change=change)


def _commanded(scene: Commanded, size: Tensor, run: Run, *, change: SizedMap) -> Any:
    return scene.with_command(lambda u, dt: on_columns(change, u, dt, size[..., 0]))


def scaled(u: Tensor, grid: Grid, size: Tensor) -> Tensor:
    """(1 + size) times the signal."""
    return u * (1.0 + size[..., None])


def shifted(u: Tensor, grid: Grid, size: Tensor) -> Tensor:
    """The signal and size."""
    return u + size[..., None]


def _steepened(u: Tensor, grid: Grid, size: Tensor) -> Tensor:
    return u * (1.0 + size[..., None] * u.abs())


def _cut(u: Tensor, grid: Grid, loss: Tensor, *, most: float) -> Tensor:
    limit = ((1.0 - loss) * most).clamp(min=0.0)[..., None]
    return signals.limited(u, -limit, limit)


def _cut_from_start(u: Tensor, grid: Grid, loss: Tensor) -> Tensor:
    start = u[..., :1].detach()
    limit = (1.0 - loss[..., None]) * (u - start).detach().abs().amax(-1, keepdim=True)
    return start + signals.limited(u - start, -limit, limit)


_TIMING = Effect(
    name="",
    family="timing",
    kind="actuator",
    unit="s",
    typical=0.02,
    needs=needs_command,
    apply=on_command(lambda u, grid, size: u),
)
LAG = replace(
    _TIMING,
    name="lag",
    form="First-order lag with the time constant size.",
    typical=0.03,
    signed=False,
    also_looks_like=("delay at low frequency", "low-pass filter of a driver", "tube compliance"),
    apply=on_command(signals.lagged),
)
HELD_LAG = replace(LAG, apply=on_command(signals.held_lagged))
COMMAND_DELAY = replace(
    _TIMING,
    name="delay",
    form="The actuators hear the command size later.",
    also_looks_like=("offset of the recorder's clock, exactly", "lag at low frequency"),
    apply=on_command(signals.smoothly_delayed),
)
HELD_DELAY = replace(
    COMMAND_DELAY,
    signed=False,
    apply=on_command(partial(signals.held_delayed, signed=False)),
)
RATE_LIMIT = replace(
    _TIMING,
    name="rate_limit",
    form="The actuator moves no faster than 1 / size.",
    unit="s/command",
    typical=1.0,
    signed=False,
    smooth=False,
    masks=("slack", "lag"),
    also_looks_like=("lag, at one amplitude", "weak battery", "a motor at its limit"),
    apply=on_command(signals.slowed),
)
DEAD_BAND = replace(
    _TIMING,
    name="dead_band",
    form="Nothing happens until the command exceeds size, then it acts less size.",
    family="shape",
    unit="command",
    typical=0.01,
    signed=False,
    smooth=False,
    also_looks_like=("slack of a tendon", "backlash at one amplitude"),
    apply=on_command(signals.dead_band),
)
SLACK = replace(
    DEAD_BAND,
    name="slack",
    form="Nothing is pulled until the command exceeds size, then that much less.",
    masks=("rate_limit", "lag"),
    also_looks_like=("a tendon that is too long", "dead band of a valve", "zero of the command"),
    apply=on_command(signals.slack),
)
BACKLASH = replace(
    DEAD_BAND,
    name="backlash",
    form="Play: the actuator rests after each reversal until the command has moved by 2 size.",
    also_looks_like=("friction of a tendon in its sheath", "gear play"),
    apply=on_command(signals.with_play),
)
SATURATION = replace(
    DEAD_BAND,
    name="saturation",
    form="The command is limited to (1 - size) of its greatest departure from its first value.",
    unit="-",
    shown_unit="%",
    typical=0.2,
    also_looks_like=("gain, if the command has one level", "stiffening"),
    apply=on_command(_cut_from_start),
)
COMMAND_GAIN = replace(
    _TIMING,
    name="command_gain",
    form="The actuators move (1 + size) times as far, or push as hard, as commanded.",
    family="gain",
    unit="-",
    shown_unit="%",
    typical=0.1,
    also_looks_like=("inertia and stiffness", "radius of a pulley", "scale of the sensors"),
    apply=on_command(scaled),
)
GAIN_SLOPE = replace(
    COMMAND_GAIN,
    name="gain_slope",
    form="The command does 1 + size |command| times as much: more at large amplitude.",
    family="shape",
    unit="1/command",
    shown_unit=None,
    also_looks_like=("softening", "saturation, if negative"),
    apply=on_command(_steepened),
)
COMMAND_OFFSET = replace(
    COMMAND_GAIN,
    name="command_offset",
    form="The actuators get size more than the command.",
    family="constant",
    unit="command",
    shown_unit=None,
    also_looks_like=("constant force", "a tilted base", "offset of the sensor"),
    apply=on_command(shifted),
)

# A wrong size predicts an unrelated staircase: sizes lie so closely that at the greatest command
# the nearest is a fifth of a step off, and are never so fine that records hardly show them.
STEPS = tuple(np.arange(2.0, 25.0, 0.4).tolist())  # from zero to the greatest command
FINE = 48  # values of a command that tell it from one that was rounded itself
_USUAL_STEPS = 10.0
QUANTIZATION = replace(
    DEAD_BAND,
    name="quantization",
    form="The actuator moves in steps of size, to the nearest one counted from zero.",
    tries=tuple(_USUAL_STEPS / n for n in STEPS),
    also_looks_like=(
        "resolution of a stepper, a servo or a DAC",
        "dry friction",
        "saturation, if few steps are used",
    ),
    needs=needs_fine_command,
    apply=on_command(signals.in_steps),
)


def quantization(reach: float, *, held: bool = False) -> Effect:
    """Steps of an actuator, for commands whose greatest magnitude is ``reach``.

    Args:
        reach: Greatest magnitude of the command, in its unit.
        held: Commands are held from sample to sample; else straight lines join the samples.
    """
    change = signals.held_in_steps if held else signals.in_steps
    return replace(QUANTIZATION, typical=reach / _USUAL_STEPS, apply=on_command(change))


ACTUATOR: tuple[Effect, ...] = (QUANTIZATION, LAG, DEAD_BAND, BACKLASH, SATURATION)


def in_words(effect: Effect, unit: str, shown: str | None = None) -> Effect:
    """A cause that says its size in the command's unit, where it has that of the command.

    Args:
        effect: One of this file's.
        unit: Unit of the command.
        shown: Unit in which a user reads it; None: ``unit``.
    """
    times = 1.0 if shown is None else factor(unit, shown)
    if effect.unit == "command" and (shown or unit) != "-":
        effect = replace(effect, shown_unit=shown or unit, shown_times=times)
    said = shown or unit.replace("-", "of the command")
    limit = "speed" if unit in ("m", "rad", "-") else "rate"
    if effect.name == "rate_limit":
        return replace(
            effect,
            words=lambda s: f"a {limit} limit near {times / s:.3g} {said}/s" if s else "none",
        )
    if effect.name == "slack":
        return replace(effect, words=lambda s: f"{times * s:.2g} {said} of slack")
    return effect


def command_causes(
    reach: float, share: float, *, held: bool, one_sided: bool
) -> list[tuple[Effect, SizedMap]]:
    """Causes on the way of commands that go the same way, each with its map.

    Args:
        reach: Greatest magnitude of the commands.
        share: Of it, that a slack, a play or an offset may be without surprise.
        held: Commands are held from sample to sample; else straight lines join the samples.
        one_sided: No command is ever below zero: then a dead band is slack.
    """
    size = share * reach
    lagged = signals.held_lagged if held else signals.lagged
    delayed = signals.held_delayed if held else signals.delayed
    limit = f"The command is limited to (1 - size) times {reach:.4g}, the largest."
    stepped = signals.held_in_steps if held else signals.in_steps
    found: list[tuple[Effect, SizedMap]] = [
        (quantization(reach, held=held), stepped),  # first: of the command, not of what is late
        (LAG, lagged),
        (COMMAND_DELAY, delayed),
        (COMMAND_GAIN, scaled),
        (replace(GAIN_SLOPE, typical=0.2 / reach), _steepened),
        (replace(COMMAND_OFFSET, typical=size), shifted),
        (replace(BACKLASH, typical=size), signals.with_play),
        (replace(SLACK, typical=size, masks=("rate_limit",)), signals.slack),
        (replace(SATURATION, form=limit), partial(_cut, most=reach)),
        (replace(RATE_LIMIT, typical=0.1 / reach, masks=()), signals.slowed),
    ]
    if not one_sided:
        found.insert(6, (replace(DEAD_BAND, typical=size), signals.dead_band))
    return found
