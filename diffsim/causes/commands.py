"""Causes between a command and the actuators, for every kind of system alike."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from diffsim.causes.catalogue import rows
from diffsim.causes.ports import on_commands
from diffsim.causes.row import ANY, Row
from diffsim.causes.signals import Between
from diffsim.core.checked import checked
from diffsim.core.units import factor
from diffsim.identify.effect import Effect, Needs

# A wrong size predicts an unrelated staircase: sizes lie so closely that at the greatest command
# the nearest is a fifth of a step off, and are never so fine that records hardly show them.
STEPS = tuple(np.arange(2.0, 25.0, 0.4).tolist())  # from zero to the greatest command
# A gear ratio, a unit or a gain counted twice, or half: slopes at a gain of one say little.
GAINS = (0.25, 0.5, 2.0, 4.0)
_USUAL_STEPS = 10.0  # as in the row of the cause
ACTUATOR = "actuator"  # the table


@checked
@dataclass(frozen=True)
class CommandGroup:
    """Commands that go the same way.

    Attributes:
        names: Names of the commands; empty: all of the system.
        scales: Usual magnitudes: ``reach``, the greatest magnitude, and where a table asks for them
            ``width``, the range, and ``rate``, what the rate of change mostly stays below.
        between: What the commands do between samples.
        is_one_sided: Whether no command is ever below zero: then a dead band is slack.
        ending: What names of causes end with, such as "_of_motor".
        unit: Unit of the commands; None: not said.
        shown: Unit in which a user reads them; None: ``unit``.
        facts: What holds of these commands, as rows ask for it: "gain_is_fitted".
        sample_s: Usual time between two samples, half of which delays and lags may be without
            surprise; 0: their rows say what is usual [s].
    """

    names: tuple[str, ...]
    scales: Mapping[str, float]
    between: Between = "straight"
    is_one_sided: bool = False
    ending: str = ""
    unit: str | None = None
    shown: str | None = None
    facts: tuple[str, ...] = ()
    sample_s: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "scales", MappingProxyType(dict(self.scales)))


@checked
def command_cause(
    name: str, group: CommandGroup, *, system: str = ANY, needs: Needs | None = None
) -> Effect:
    """One cause on the way of some commands.

    Args:
        name: Name of its row in the table of actuators.
        group: Commands that the cause changes alike.
        system: Kind of system.
        needs: What a study must have, in place of what the row says.
    """
    return cause_of_commands(rows(ACTUATOR)[name], group, system=system, needs=needs)


def cause_of_commands(
    row: Row, group: CommandGroup, *, system: str = ANY, needs: Needs | None = None
) -> Effect:
    """A cause on the way of some commands, by its row."""
    effect = row.effect(
        on_commands(row, group.names, group.scales, group.between, system),
        group.scales,
        system=system,
        ending=group.ending,
    )
    if row.name == "quantization":
        effect = replace(effect, tries=tuple(_USUAL_STEPS / n for n in STEPS))
    if row.name == "command_gain":
        tries = tuple((factor - 1.0) / effect.typical for factor in GAINS)
        effect = replace(effect, scanned=True, tries=tries)
    if needs is not None:
        effect = replace(effect, needs=needs)
    return say_in_unit(effect, row, group)


def say_in_unit(effect: Effect, row: Row, group: CommandGroup) -> Effect:
    """A cause that says its size in the unit of commands, where it has that of a command.

    Args:
        group: The commands; without a unit the cause stays as it is.
    """
    if group.unit is None:
        return effect
    shown = group.shown or group.unit
    times = 1.0 if group.shown is None else factor(group.unit, shown)
    if effect.unit == "command" and shown != "-":
        effect = replace(effect, shown_unit=shown, shown_times=times)
    for per in ("s", "s^2"):  # a limit is said as what it allows
        if effect.unit == f"{per}/command" and shown != "-":
            effect = replace(effect, shown_unit=f"{shown}/{per}", shown_times=times, shown_power=-1)
    words = _WORDS.get(row.name)
    return effect if words is None else replace(effect, words=words(group.unit, times, group.shown))


def _limit_in_words(unit: str, times: float, shown: str | None) -> Callable[[float], str]:
    said = shown or unit.replace("-", "of the command")
    what = "speed" if unit in ("m", "rad", "-") else "rate"
    return lambda size: f"a {what} limit near {times / size:.3g} {said}/s" if size else "none"


def _slack_in_words(unit: str, times: float, shown: str | None) -> Callable[[float], str]:
    said = shown or unit.replace("-", "of the command")
    return lambda size: f"{times * size:.2g} {said} of slack"


_WORDS = {"rate_limit": _limit_in_words, "slack": _slack_in_words}
