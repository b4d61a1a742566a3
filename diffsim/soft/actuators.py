"""What lies between a command and an actuation: delay, first-order lag, limited rate."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.core.check import require, require_count, require_number, require_range
from diffsim.core.module import Float64Module, loadable
from diffsim.soft.parameters import Value, hold


@loadable
class ActuatorState(NamedTuple):
    """What actuators remember between steps.

    Attributes:
        value: The actuation now, (..., num_actuators).
        pending: Commands that do not act yet, oldest first, (delay_steps, ..., num_actuators).
    """

    value: Tensor
    pending: Tensor


class ActuatorDynamics(Float64Module):
    """Actuation that follows its command late, sluggishly and no faster than it can.

    The command c, held over a step and delayed by ``delay_steps`` steps, drives the actuation a by

        da/dt = clamp((c - a) / T, -r, r),   T the time constant, r the greatest rate,

    solved exactly over the step: with the error e = c - a, while |e| > r T the error shrinks at
    the rate r, from then on as exp(-t/T). The step is therefore right for any dt, and its
    derivative is continuous across the rate limit. Without ``max_rate`` it is e exp(-dt/T); without
    ``time_constant`` the actuation moves to the command by at most r dt, a kink: gradient of the
    command, or exactly at the limit of the command too, of the rate beyond it.

    Works on any quantity with the same unit in and out: activations [-], tendon lengths [m],
    pressures [Pa].

    Args:
        time_constant: T, scalar or (num_actuators,) [s], > 0; None: no lag. May be an
            ``nn.Parameter``.
        max_rate: r, scalar or (num_actuators,) [unit of the command / s], > 0; None: unlimited.
        delay_steps: Steps until a command acts, >= 0; no gradient.

    Example::

        dynamics = ActuatorDynamics(time_constant=0.05, max_rate=2.0)
        activation = dynamics.sequence(commands, body.dt)  # (num_steps, num_muscles)
        rollout(body, state, num_steps, activation=lambda k, s: activation[k])
    """

    time_constant: Tensor | None
    max_rate: Tensor | None

    def __init__(
        self,
        time_constant: Value | None = None,
        max_rate: Value | None = None,
        delay_steps: int = 0,
    ):
        super().__init__()
        self.delay_steps = require_count("delay_steps", delay_steps)
        hold(self, "time_constant", time_constant)
        hold(self, "max_rate", max_rate)
        self._check_parameters(None)

    def initial_state(self, value: Tensor) -> ActuatorState:
        """Actuators at rest at ``value`` (..., num_actuators), all earlier commands the same."""
        value = require("value", value, ("...", "num_actuators"))
        return ActuatorState(value, value.expand(self.delay_steps, *value.shape))

    def forward(
        self, command: Tensor, state: ActuatorState, dt: float
    ) -> tuple[Tensor, ActuatorState]:
        """Actuation at the end of a step.

        Args:
            command: Held over the step, (..., num_actuators).
            state: State from :meth:`initial_state` or from the last call.
            dt: Step [s].

        Returns:
            (actuation, state), the actuation shaped like the command. Gradients: command, state,
            time_constant, max_rate.
        """
        if not isinstance(state, ActuatorState):
            raise TypeError(
                f"state must be an ActuatorState, got {type(state).__name__}; use initial_state()"
            )
        command = require("command", command, ("...", "num_actuators"))
        require("state.value", state.value, tuple(command.shape))
        require("state.pending", state.pending, (self.delay_steps, *command.shape))
        dt = require_number("dt", dt, above=0.0, hint="unit is s")
        self._check_parameters(command.shape[-1])
        return self._advance(command, state, dt)

    def sequence(self, commands: Tensor, dt: float, initial: Tensor | None = None) -> Tensor:
        """A whole sequence of actuations.

        Args:
            commands: One row per step, (num_steps, ..., num_actuators).
            dt: Step [s].
            initial: Actuation before the first step, (..., num_actuators); None: the first
                command, so that nothing moves until the command does.

        Returns:
            Actuations at the steps' ends, shape of ``commands``: row k for step k of a rollout.
            Gradients: commands, initial, time_constant, max_rate.
        """
        commands = require("commands", commands, ("...", "num_steps", "num_actuators"))
        if commands.shape[0] == 0:
            raise ValueError("commands must hold at least one step, got none")
        dt = require_number("dt", dt, above=0.0, hint="unit is s")
        self._check_parameters(commands.shape[-1])
        state = self.initial_state(
            commands[0] if initial is None else require("initial", initial, commands.shape[1:])
        )
        values = []
        for command in commands:
            value, state = self._advance(command, state, dt)
            values.append(value)
        return torch.stack(values)

    def extra_repr(self) -> str:
        """What ``print(dynamics)`` shows."""
        return (
            f"time_constant={_format_tensor(self.time_constant)} s, "
            f"max_rate={_format_tensor(self.max_rate)} 1/s, "
            f"delay_steps={self.delay_steps}"
        )

    def _advance(
        self, command: Tensor, state: ActuatorState, dt: float
    ) -> tuple[Tensor, ActuatorState]:
        pending = state.pending
        if self.delay_steps:
            acting = pending[0]
            pending = torch.cat([pending[1:], command[None]])
        else:
            acting = command
        value = acting - _error_after(acting - state.value, self.time_constant, self.max_rate, dt)
        return value, ActuatorState(value, pending)

    def _check_parameters(self, num_actuators: int | None) -> None:
        for name, unit in (("time_constant", "s"), ("max_rate", "the command's unit per s")):
            value = getattr(self, name)
            if value is None:
                continue
            if value.ndim:
                require(name, value, ("num_actuators" if num_actuators is None else num_actuators,))
            else:
                require(name, value, ())
            if not torch.compiler.is_compiling():
                require_range(name, value, above=0.0, hint=f"unit is {unit}")


class FirstOrderLag(ActuatorDynamics):
    """da/dt = (command - a) / time_constant, exact over a step; see :class:`ActuatorDynamics`.

    Args:
        time_constant: Scalar or (num_actuators,) [s], > 0.
    """

    def __init__(self, time_constant: Value):
        super().__init__(time_constant=time_constant)


class RateLimit(ActuatorDynamics):
    """Actuation that follows its command by at most max_rate dt; see :class:`ActuatorDynamics`.

    Args:
        max_rate: Scalar or (num_actuators,) [unit of the command / s], > 0.
    """

    def __init__(self, max_rate: Value):
        super().__init__(max_rate=max_rate)


def _error_after(error: Tensor, lag: Tensor | None, rate: Tensor | None, dt: float) -> Tensor:
    """The error c - a that is left of ``error`` (..., m) after dt, see ActuatorDynamics."""
    if rate is None:
        return torch.zeros_like(error) if lag is None else error * torch.exp(-dt / lag)
    size = error.abs()
    excess = size - rate * dt
    if lag is None:
        return torch.where(excess > 0.0, error.sign() * excess, torch.zeros_like(error))
    # time at the full rate before the exponential takes over
    sliding = size / rate - lag
    at_rate = sliding > 0.0
    remaining = dt - torch.where(at_rate, sliding.clamp(max=dt), 0.0)
    start = torch.where(at_rate, error.sign() * rate * lag, error)
    settling = start * torch.exp(-remaining / lag)
    return torch.where(sliding > dt, error.sign() * excess, settling)


def _format_tensor(value: Tensor | None) -> str:
    if value is None:
        return "None"
    return f"{value.item():g}" if value.ndim == 0 else str(value.tolist())
