"""Open-loop controllers: bounded by construction, differentiable in their few parameters.

All are called as closed-loop ones are, ``controller(observation, step)``, and ignore what they see.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from diffsim.core.check import require, require_constant, require_number, require_tensor
from diffsim.core.values import amounts, as_array


class OpenLoop(nn.Module):
    """A command signal of time.

    Args:
        num_commands: Width of the command.
        dt: Control period [s].
    """

    def __init__(self, num_commands: int, dt: float):
        super().__init__()
        self.num_commands = int(require_number("num_commands", num_commands, at_least=1))
        self.dt = require_number("dt", dt, above=0.0)

    def signal(self, time: Tensor) -> Tensor:
        """Commands (..., num_commands) in [-1, 1] at times (...) [s]."""
        raise NotImplementedError

    def forward(self, observation: Tensor | None, step: int | Tensor) -> Tensor:
        """Commands (batch, num_commands); (num_commands,) without an observation."""
        time = _doubles("step", step) * self.dt
        command = self.signal(time)
        if observation is None or command.dim() > 1:
            return command
        require_tensor("observation", observation, getattr(observation, "dtype", torch.float64))
        return command.expand(*observation.shape[:-1], -1)


class Sinusoid(OpenLoop):
    """amplitude_j sin(2 pi f t + phase_j), one frequency for all commands.

    Args:
        num_commands, dt: The same as for ``OpenLoop``.
        frequency: First guess [Hz].
        frequency_range: Bounds [Hz].
        amplitudes: First guesses, (num_commands,) in (-1, 1).
        phases: First guesses, (num_commands,) [rad].
        learn_phases: Whether phases are parameters.
    """

    def __init__(
        self,
        num_commands: int,
        dt: float,
        *,
        frequency: float = 1.0,
        frequency_range: tuple[float, float] = (0.1, 5.0),
        amplitudes: Sequence[float] | None = None,
        phases: Sequence[float] | None = None,
        learn_phases: bool = True,
    ):
        super().__init__(num_commands, dt)
        for name, given in (("frequency", frequency), ("frequency_range", frequency_range)):
            require_constant(name, given, "it is a first guess of a parameter")
        low, high = frequency_range
        if not 0.0 < low < frequency < high:
            raise ValueError(
                f"frequency must lie within frequency_range ({low:g}, {high:g}) Hz, got {frequency}"
            )
        self.frequency_range = (low, high)
        share = (frequency - low) / (high - low)
        size = _row("amplitudes", amplitudes, num_commands, 0.5)
        if bool((size.abs() >= 1.0).any()):
            raise ValueError(f"amplitudes must lie in (-1, 1), got {size.tolist()}")
        self.raw_frequency = nn.Parameter(
            torch.tensor(math.log(share / (1.0 - share)), dtype=torch.float64)
        )
        self.raw_amplitude = nn.Parameter(torch.atanh(size))
        phase = _row("phases", phases, num_commands, 0.0)
        self.phase = nn.Parameter(phase, requires_grad=learn_phases)

    @property
    def frequency(self) -> Tensor:
        """() [Hz]."""
        low, high = self.frequency_range
        return low + (high - low) * torch.sigmoid(self.raw_frequency)

    @property
    def amplitude(self) -> Tensor:
        """(num_commands,)."""
        return torch.tanh(self.raw_amplitude)

    def signal(self, time: Tensor) -> Tensor:
        """See the class."""
        time = _doubles("time", time)
        turn = 2.0 * math.pi * self.frequency * time[..., None]
        return self.amplitude * torch.sin(turn + self.phase)


class Knots(OpenLoop):
    """Straight lines between knots evenly spaced in time; periodic or held at the end.

    Args:
        num_commands, dt: The same as for ``OpenLoop``.
        num_knots: Per command; the torus of thesis 4.1.6 has 8 tendons x 20 knots.
        duration: Time from the first knot to the last, or the period [s].
        periodic: Whether the signal repeats.
        start: First guess (num_knots, num_commands) in (-1, 1); zero by default.
    """

    def __init__(
        self,
        num_commands: int,
        dt: float,
        *,
        num_knots: int,
        duration: float,
        periodic: bool = False,
        start: Tensor | None = None,
    ):
        super().__init__(num_commands, dt)
        self.duration = require_number("duration", duration, above=0.0)
        count = int(require_number("num_knots", num_knots, at_least=2))
        self.periodic = periodic
        require_constant("start", start, "it is a first guess of the parameters")
        values = torch.zeros(count, num_commands, dtype=torch.float64) if start is None else start
        values = require("start", _doubles("start", values), (count, num_commands))
        self.raw = nn.Parameter(torch.atanh(values.clamp(-0.999, 0.999)))

    def signal(self, time: Tensor) -> Tensor:
        """See the class."""
        time = _doubles("time", time)
        values, count = torch.tanh(self.raw), len(self.raw)
        if self.periodic:
            place = (time / self.duration % 1.0) * count
            first = place.floor().long() % count
            second = (first + 1) % count
        else:
            place = (time / self.duration).clamp(0.0, 1.0) * (count - 1)
            first = place.floor().long().clamp(max=count - 2)
            second = first + 1
        share = (place - place.floor() if self.periodic else place - first)[..., None]
        return (1.0 - share) * values[first] + share * values[second]


def _doubles(name: str, value: float | Tensor) -> Tensor:
    """Finite numbers as a float64 tensor, of any precision, with their gradient."""
    return amounts(name, value.to(torch.float64) if isinstance(value, Tensor) else value)


def _row(name: str, values: Sequence[float] | None, width: int, default: float) -> Tensor:
    require_constant(name, values, "it is a first guess of parameters")
    given = [default] * width if values is None else values
    row = as_array(name, given).detach().to(torch.float64).clone()
    if row.shape != (width,):
        raise ValueError(f"{name} must have {width} entries, one per command, got {len(row)}")
    return require(name, row, (width,))
