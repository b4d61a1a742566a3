"""Causes between a command and the actuators, for every bed whose scenes have a command."""

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


class ActuatorEffect(Effect):
    """Acts on the command."""

    kind = "actuator"

    def needs(self, study: Study) -> str | None:
        if not any(run.command for run in study.runs):
            return "runs with a recorded command"
        return None


class Lag(ActuatorEffect):
    """First-order lag with the time constant size."""

    name, family, unit, typical, signed = "lag", "timing", "s", 0.03, False
    also_looks_like = ("delay at low frequency", "low-pass filter of a driver", "tube compliance")

    def apply(self, scene: Commanded, size: Tensor, run: Run) -> Any:
        return scene.with_command(lambda u, dt: signals.lagged(u, dt, size[0]))


class CommandDelay(ActuatorEffect):
    """The actuators hear the command size later."""

    name, family, unit, typical = "delay", "timing", "s", 0.02
    also_looks_like = ("offset of the recorder's clock, exactly", "lag at low frequency")

    def apply(self, scene: Commanded, size: Tensor, run: Run) -> Any:
        return scene.with_command(lambda u, dt: signals.delayed(u, dt, size[0]))


class HeldLag(Lag):
    """First-order lag with the time constant size, of a command that is held over each step."""

    def apply(self, scene: Commanded, size: Tensor, run: Run) -> Any:
        return scene.with_command(lambda u, dt: signals.held_lagged(u, dt, size[..., 0]))


class HeldDelay(CommandDelay):
    """The actuators hear the command, held over each step, size later."""

    signed = False

    def apply(self, scene: Commanded, size: Tensor, run: Run) -> Any:
        return scene.with_command(lambda u, dt: signals.held_delayed(u, dt, size[..., 0]))


class DeadBand(ActuatorEffect):
    """Nothing happens until the command exceeds size, then it acts less size."""

    name, family, unit, typical, signed = "dead_band", "shape", "command", 0.01, False
    smooth = False
    also_looks_like = ("slack of a tendon", "backlash at one amplitude")

    def apply(self, scene: Commanded, size: Tensor, run: Run) -> Any:
        return scene.with_command(lambda u, dt: signals.dead_band(u, size[0]))


class Backlash(ActuatorEffect):
    """Play: the actuator rests after each reversal until the command has moved by 2 size."""

    name, family, unit, typical, signed = "backlash", "shape", "command", 0.01, False
    smooth = False
    also_looks_like = ("friction of a tendon in its sheath", "gear play")

    def apply(self, scene: Commanded, size: Tensor, run: Run) -> Any:
        return scene.with_command(lambda u, dt: signals.backlash(u, size[0]))


class Saturation(ActuatorEffect):
    """The command is limited to (1 - size) of its greatest departure from its first value."""

    name, family, unit, typical, signed = "saturation", "shape", "-", 0.2, False
    smooth = False
    also_looks_like = ("gain, if the command has one level", "stiffening")

    def apply(self, scene: Commanded, size: Tensor, run: Run) -> Any:
        return scene.with_command(lambda u, dt: signals.saturated(u, size[0], u[0].detach()))


ACTUATOR: tuple[Callable[[], Effect], ...] = (Lag, DeadBand, Backlash, Saturation)
