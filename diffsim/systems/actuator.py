"""Causes between a command and the actuators, for every system whose scenes have a command."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from torch import Tensor

from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.systems import signals


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


def _lag(scene: Commanded, size: Tensor, run: Run) -> Any:
    return scene.with_command(lambda u, dt: signals.lagged(u, dt, size[0]))


def _command_delay(scene: Commanded, size: Tensor, run: Run) -> Any:
    return scene.with_command(lambda u, dt: signals.delayed(u, dt, size[0]))


def _held_lag(scene: Commanded, size: Tensor, run: Run) -> Any:
    return scene.with_command(lambda u, dt: signals.held_lagged(u, dt, size[..., 0]))


def _held_delay(scene: Commanded, size: Tensor, run: Run) -> Any:
    return scene.with_command(lambda u, dt: signals.held_delayed(u, dt, size[..., 0]))


def _dead_band(scene: Commanded, size: Tensor, run: Run) -> Any:
    return scene.with_command(lambda u, dt: signals.dead_band(u, size[0]))


def backlash(scene: Commanded, size: Tensor, run: Run) -> Any:
    """Play of the command, half its width on either side."""
    return scene.with_command(lambda u, dt: signals.backlash(u, size[0]))


def _saturation(scene: Commanded, size: Tensor, run: Run) -> Any:
    return scene.with_command(lambda u, dt: signals.saturated(u, size[0], u[0].detach()))


LAG = Effect(
    name="lag",
    form="First-order lag with the time constant size.",
    family="timing",
    kind="actuator",
    unit="s",
    typical=0.03,
    signed=False,
    also_looks_like=("delay at low frequency", "low-pass filter of a driver", "tube compliance"),
    needs=needs_command,
    apply=_lag,
)
COMMAND_DELAY = Effect(
    name="delay",
    form="The actuators hear the command size later.",
    family="timing",
    kind="actuator",
    unit="s",
    typical=0.02,
    also_looks_like=("offset of the recorder's clock, exactly", "lag at low frequency"),
    needs=needs_command,
    apply=_command_delay,
)
HELD_LAG = Effect(
    name="lag",
    form="First-order lag with the time constant size, of a command that is held over each step.",
    family="timing",
    kind="actuator",
    unit="s",
    typical=0.03,
    signed=False,
    also_looks_like=("delay at low frequency", "low-pass filter of a driver", "tube compliance"),
    needs=needs_command,
    apply=_held_lag,
)
HELD_DELAY = Effect(
    name="delay",
    form="The actuators hear the command, held over each step, size later.",
    family="timing",
    kind="actuator",
    unit="s",
    typical=0.02,
    signed=False,
    also_looks_like=("offset of the recorder's clock, exactly", "lag at low frequency"),
    needs=needs_command,
    apply=_held_delay,
)
DEAD_BAND = Effect(
    name="dead_band",
    form="Nothing happens until the command exceeds size, then it acts less size.",
    family="shape",
    kind="actuator",
    unit="command",
    typical=0.01,
    signed=False,
    smooth=False,
    also_looks_like=("slack of a tendon", "backlash at one amplitude"),
    needs=needs_command,
    apply=_dead_band,
)
BACKLASH = Effect(
    name="backlash",
    form="Play: the actuator rests after each reversal until the command has moved by 2 size.",
    family="shape",
    kind="actuator",
    unit="command",
    typical=0.01,
    signed=False,
    smooth=False,
    also_looks_like=("friction of a tendon in its sheath", "gear play"),
    needs=needs_command,
    apply=backlash,
)
SATURATION = Effect(
    name="saturation",
    form="The command is limited to (1 - size) of its greatest departure from its first value.",
    family="shape",
    kind="actuator",
    unit="-",
    typical=0.2,
    signed=False,
    smooth=False,
    also_looks_like=("gain, if the command has one level", "stiffening"),
    needs=needs_command,
    apply=_saturation,
)

ACTUATOR: tuple[Effect, ...] = (LAG, DEAD_BAND, BACKLASH, SATURATION)
