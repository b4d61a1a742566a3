"""One run of a system of formulas, ready to be simulated, many points at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.ports import SignalMap
from diffsim.causes.readings import PLAY_START
from diffsim.causes.signals import Grid, change_rows, smoothly_delayed
from diffsim.core.expression import Expression
from diffsim.data.study import Run
from diffsim.systems.ode.network import TIME, Change, Network


@dataclass(frozen=True, eq=False)
class OdeScene:
    """States start, inputs drive, formulas are integrated, readings come out.

    Attributes:
        run: Recorded run.
        network: Formulas.
        grid: Times of the integrator.
        values: Parameters, facts and sizes of effects by name, () or (K,) each.
        starts: Start value of every state, formulas of the values.
        inputs: Inputs by name, (num_times,) or (K, num_times).
        changes: What effects have changed in the formulas.
        readers: What effects do to channels, by their indices.
        channels: Names of the channels in order.
        ranges: Least and largest value that the sensor of a channel can show, by channel.
    """

    run: Run
    network: Network
    grid: Grid
    values: Mapping[str, Tensor]
    starts: Mapping[str, Expression]
    inputs: Mapping[str, Tensor]
    changes: tuple[Change, ...] = ()
    readers: tuple[tuple[tuple[int, ...], SignalMap], ...] = ()
    channels: tuple[str, ...] = field(default=())
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def with_change(self, change: Change, sizes: Mapping[str, Tensor]) -> OdeScene:
        """A copy with other formulas; ``sizes`` are values of the symbols in them."""
        return replace(self, changes=(*self.changes, change), values={**self.values, **sizes})

    @property
    def play_start(self) -> Tensor | None:
        """Where in a play the run starts, -1 to 1; None: not known to the model."""
        return self.values.get(PLAY_START)

    def with_command(self, names: tuple[str, ...], change: SignalMap) -> OdeScene:
        """A copy in which inputs are f(inputs (..., width, num_times), grid).

        Args:
            names: Names of the inputs; empty: all.
            change: The function.
        """
        changed = {
            name: change(self.inputs[name][..., None, :], self.grid)[..., 0, :]
            for name in names or self.inputs
        }
        return replace(self, inputs={**self.inputs, **changed})

    def with_number(self, name: str, change: Callable[[Tensor], Tensor]) -> OdeScene:
        """A copy in which a value is f(value)."""
        return replace(self, values={**self.values, name: change(self.values[name])})

    def with_further_input(
        self, name: str, values: Tensor, change: Change, sizes: Mapping[str, Tensor] | None = None
    ) -> OdeScene:
        """A copy with one more input (..., num_times), which ``change`` puts into formulas."""
        scene = replace(self, inputs={**self.inputs, name: values})
        return scene.with_change(change, sizes or {})

    def with_reading(self, channels: tuple[int, ...], change: SignalMap) -> OdeScene:
        """A copy in which channels are f(channels (..., width, num_times), grid)."""
        return replace(self, readers=(*self.readers, (channels, change)))

    def with_clock(self, channels: tuple[int, ...], delay: Tensor) -> OdeScene:
        """A copy in which channels show what was ``delay``, () or (K,), ago [s]."""
        late = delay[..., None]
        return self.with_reading(channels, lambda y, grid: smoothly_delayed(y, grid, late))

    def simulate(self) -> Tensor:
        """Predicted channels, (num_samples, num_channels) or (K, num_samples, num_channels)."""
        readings, _ = self.solved()
        order = [list(self.network.readings).index(c) for c in self.channels]
        if order != list(range(readings.shape[-1])):
            readings = readings[..., order]
        for channels, change in self.readers:
            readings = change_rows(readings.mT, channels, change, self.grid).mT.contiguous()
        for channel, (low, high) in self.ranges.items():
            # the sensor ends after all that happens before it
            own = torch.zeros(len(self.channels), dtype=torch.bool)
            own[self.channels.index(channel)] = True
            readings = torch.where(own, readings.clamp(low, high), readings)
        if readings.shape[-2] == len(self.grid.samples):
            return readings
        return readings.index_select(-2, self.grid.samples)

    def solved(self, network: Network | None = None) -> tuple[Tensor, Tensor]:
        """Readings and states at all times of the grid.

        Args:
            network: The same system, read otherwise; None: the scene's own.
        """
        solver = (network or self.network).solver(self.changes)
        states = list(solver.ode.rates)
        starts = self._stack_starts(states, solver.starts)
        parameters = [self.values[n] for n in solver.parameters]
        inputs = [self.inputs[n] for n in solver.inputs]
        lead = np.broadcast_shapes(
            *(v.shape for v in (*starts, *parameters)), *(u.shape[:-1] for u in inputs)
        )
        steps = len(self.grid.times)
        # inputs that no point changes are stored once
        own = np.broadcast_shapes(*(u.shape[:-1] for u in inputs))
        return solver.ode.solve(
            self.grid.times,
            _stack_values(starts, lead),
            torch.stack([u.expand(*own, steps) for u in inputs], -1) if inputs else None,
            _stack_values(parameters, lead),
        )

    def _stack_starts(
        self, states: Sequence[str], further: Mapping[str, Expression]
    ) -> list[Tensor]:
        """Start values: those of the system, then those of states that effects have added."""
        first = {n: u[..., 0] for n, u in self.inputs.items()}
        known = {**self.values, **first, TIME: self.grid.times[0]}
        out = {s: formula(known) for s, formula in self.starts.items()}
        known |= {at_start(s): value for s, value in out.items()}
        zero = torch.zeros((), dtype=torch.float64)
        return [out[s] if s in out else further[s](known) if s in further else zero for s in states]


def at_start(state: str) -> str:
    """What the start value of a state is called in start values of further states."""
    return f"{state} at start"


def _stack_values(values: list[Tensor], lead: tuple[int, ...]) -> Tensor:
    if not values:
        return torch.zeros((*lead, 0), dtype=torch.float64)
    return torch.stack([v.expand(lead) for v in values], -1)
