"""One run of a system of formulas, ready to be simulated, many points at once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.scene import Scene
from diffsim.core.expression import Expression, parse_expression
from diffsim.data.study import Run
from diffsim.ode import Ode
from diffsim.ode.integrate import integrated
from diffsim.systems.ode.network import TIME, Change, Network, filled, once_more

SIDE_BY_SIDE = 16  # members that the integrator takes at once; a batch of as many gains by no other


@dataclass(frozen=True, kw_only=True, eq=False)
class OdeScene(Scene):
    """States start, inputs drive, formulas are integrated, readings come out.

    Its grid has the times of the integrator. Its numbers are parameters, facts and sizes of
    effects; its commands are the inputs.

    Attributes:
        starts: Start value of every state, formulas of the numbers.
        further: Inputs that effects have added by name, (num_times,) or (K, num_times).
        channels: Names of the channels in order.
        ranges: Least and largest value that the sensor of a channel can show, by channel.
        columns: What was recorded beside commands and channels, by name, (num_times,).
        restarts: Times at which the system's states begin anew, with their values; states that
            effects have added go on.
    """

    run: Run
    network: Network
    starts: Mapping[str, Expression]
    further: Mapping[str, Tensor] = field(default_factory=dict)
    changes: tuple[Change, ...] = ()
    channels: tuple[str, ...] = field(default=())
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    columns: Mapping[str, Tensor] = field(default_factory=dict)
    restarts: tuple[tuple[float, Mapping[str, Tensor]], ...] = ()

    @cached_property
    def inputs(self) -> Mapping[str, Tensor]:
        """Inputs as they drive the system by name, (num_times,) or (K, num_times)."""
        heard = self.commands.each_heard(self.grid)
        return {**dict(zip(self.commands.rows, heard, strict=True)), **self.further}

    def with_change(self, change: Change, sizes: Mapping[str, Tensor]) -> OdeScene:
        """A copy with other formulas; ``sizes`` are values of the symbols in them.

        One that acts already, such as that of a drive and that of all drives, acts once more.
        """
        if change in self.changes:
            again = {once_more(name): size for name, size in sizes.items()}
            return self.with_change(change.again(tuple(sizes)), again)
        numbers = {**self.numbers, **sizes}
        return self.changed(changes=(*self.changes, change), numbers=numbers)

    def with_further_inputs(
        self,
        inputs: Mapping[str, Tensor],
        change: Change,
        sizes: Mapping[str, Tensor] | None = None,
    ) -> OdeScene:
        """A copy with more inputs (..., num_times), which ``change`` puts into formulas."""
        sizes = sizes or {}
        if change in self.changes:
            change = change.again(tuple(sizes))
            inputs, sizes = ({once_more(n): v for n, v in d.items()} for d in (inputs, sizes))
            return self.with_further_inputs(inputs, change, sizes)
        scene = self.changed(further={**self.further, **inputs})
        return scene.with_change(change, sizes)

    def simulate(self) -> Tensor:
        """Predicted channels, (num_samples, num_channels) or (K, num_samples, num_channels)."""
        return self.read(self.solved()[0])

    def read(self, readings: Tensor) -> Tensor:
        """Predicted channels as of ``simulate``.

        Args:
            readings: Of the network at all times of the grid, (..., num_times, num_channels).
        """
        readings = self._order_channels(readings)
        if not self.instruments.is_empty:
            readings = self.instruments.read_in_order(readings, self.grid).contiguous()
        readings = self._end_sensors(readings)
        if readings.shape[-2] == len(self.grid.samples):
            return readings
        return readings.index_select(-2, self.grid.samples)

    def solved(self, network: Network | None = None) -> tuple[Tensor, Tensor]:
        """Readings and states at all times of the grid.

        Args:
            network: The same system, read otherwise; None: the scene's own.
        """
        flow = self.flow(network)
        begins = self._list_restarts()
        start, parts = flow.start, list[tuple[Tensor, Tensor]]()
        for first, last, values in begins:
            if values:
                ended = dict(zip(flow.states, parts[-1][1][..., -1, :].unbind(-1), strict=True))
                start = _stack_values([{**ended, **values}[s] for s in flow.states], flow.lead)
            parts.append(flow.solve(start, first, last))
        if len(parts) == 1:
            return parts[0]
        readings, states = (
            torch.cat([*(part[..., :-1, :] for part in found[:-1]), found[-1]], -2)
            for found in zip(*parts, strict=True)
        )
        return readings, states

    def solved_from(self, starts: Tensor, first: int, last: int) -> tuple[Tensor, Tensor]:
        """Channels and states of a part of the run from other starts, its clocks set aside.

        Args:
            starts: Start states, (K, num_states).
            first, last: First and last time of the part, indices of the grid.

        Returns:
            (K, last - first + 1, num_channels) and (K, last - first + 1, num_states).
        """
        readings, states = self.flow().solve(starts, first, last)
        return self._end_sensors(self._order_channels(readings)), states

    def begin(self) -> tuple[tuple[str, ...], Tensor]:
        """Names of the states and their start, (num_states,) or (K, num_states)."""
        flow = self.flow()
        return tuple(flow.states), flow.start

    def each_start_moved(self, step: float) -> list[OdeScene]:
        """The run from starts of which one is larger, for each state of the system.

        Args:
            step: By how much, in the state's unit.
        """
        more = parse_expression(f"start + {step!r}")
        moved = {state: filled(more, {"start": start}) for state, start in self.starts.items()}
        return [self.changed(starts={**self.starts, s: start}) for s, start in moved.items()]

    def rests_without_inputs(self) -> bool:
        """Whether the start is a state of rest with inputs of zero, and none with their first
        values."""
        flow = self.flow()
        if not flow.ode.inputs:
            return False
        first = flow.inputs[..., 0, :]
        with_first, without = (flow.rates(u).abs().max() for u in (first, torch.zeros_like(first)))
        # rounding of sums that cancel
        return bool(without <= 1e-9 * with_first and with_first > 0.0)

    def flow(self, network: Network | None = None) -> Flow:
        """The run as the integrator takes it; ``network`` as of ``solved``."""
        solver = (network or self.network).solver(self.changes)
        states = list(solver.ode.rates)
        # of the system, then of states that effects have added
        first = {n: u[..., 0] for n, u in self.inputs.items()}
        known = {**self.numbers, **first, TIME: self.grid.times[0]}
        out = {s: formula(known) for s, formula in self.starts.items()}
        known |= {at_start(s): value for s, value in out.items()}
        out |= {s: further(known) for s, further in solver.starts.items() if s not in out}
        zero = torch.zeros((), dtype=torch.float64)
        starts = [out.get(s, zero) for s in states]
        parameters = [self.numbers[n] for n in solver.parameters]
        inputs = [self.inputs[n] if n in self.inputs else self.columns[n] for n in solver.inputs]
        restarts = [v for _, values in self.restarts for v in values.values()]
        lead = np.broadcast_shapes(
            *(v.shape for v in (*starts, *restarts, *parameters)), *(u.shape[:-1] for u in inputs)
        )
        steps = len(self.grid.times)
        # inputs that no point changes are stored once
        own = np.broadcast_shapes(*(u.shape[:-1] for u in inputs))
        return Flow(
            solver.ode,
            states,
            lead,
            _stack_values(starts, lead),
            self.grid.times,
            torch.stack([u.expand(*own, steps) for u in inputs], -1)
            if inputs
            else torch.zeros((steps, 0), dtype=torch.float64),
            _stack_values(parameters, lead),
        )

    def _order_channels(self, readings: Tensor) -> Tensor:
        """Readings as the study has its channels."""
        order = [list(self.network.readings).index(c) for c in self.channels]
        if order == list(range(readings.shape[-1])):
            return readings
        return readings[..., order]

    def _end_sensors(self, readings: Tensor) -> Tensor:
        """Channels within what their sensors can show."""
        for channel, (low, high) in self.ranges.items():
            # the sensor ends after all that happens before it
            own = torch.zeros(len(self.channels), dtype=torch.bool)
            own[self.channels.index(channel)] = True
            readings = torch.where(own, readings.clamp(low, high), readings)
        return readings

    def _list_restarts(self) -> list[tuple[int, int, Mapping[str, Tensor]]]:
        """First and last time of every piece of the run by index, with what begins anew there. The
        first part of a run that is cut later is one piece."""
        last = len(self.grid.times) - 1
        places = np.searchsorted(self.grid.times.numpy(), [t for t, _ in self.restarts])
        begins = [(int(i), v) for i, (_, v) in zip(places, self.restarts, strict=True) if i < last]
        firsts: list[tuple[int, Mapping[str, Tensor]]] = [(0, {}), *begins]
        ends = [*(i for i, _ in begins), last]
        return [(i, end, v) for (i, v), end in zip(firsts, ends, strict=True)]


@dataclass(frozen=True, eq=False)
class Flow:
    """A scene as the integrator takes it.

    Attributes:
        states: Names of the states.
        lead: Leading axes of the points.
        start: States in the beginning, (..., num_states).
        times: Of the grid.
        inputs: (..., num_times, num_inputs).
        parameters: (..., num_parameters).
    """

    ode: Ode
    states: list[str]
    lead: tuple[int, ...]
    start: Tensor
    times: Tensor
    inputs: Tensor
    parameters: Tensor

    def rates(self, inputs: Tensor) -> Tensor:
        """Rates of the states in the beginning, (..., num_states).

        Args:
            inputs: In place of their first values, (..., num_inputs).
        """
        values = {TIME: self.times[0], **dict(zip(self.states, self.start.unbind(-1), strict=True))}
        values |= dict(zip(self.ode.inputs, inputs.unbind(-1), strict=True))
        values |= dict(zip(self.ode.parameters, self.parameters.unbind(-1), strict=True))
        formulas = [self.ode.rates[s] for s in self.states]
        rates = (f(values) for f in formulas if isinstance(f, Expression))
        return torch.stack(torch.broadcast_tensors(*rates), -1)

    def solve(self, start: Tensor, first: int, last: int) -> tuple[Tensor, Tensor]:
        """Readings and states from one time of the grid to another, both included."""
        piece = slice(first, last + 1)
        problem = self.ode.problem(self.times[piece], 1, 1)
        return integrated(self.ode, problem, start, self.inputs[..., piece, :], self.parameters)


def simulate_together(scenes: Sequence[OdeScene]) -> list[Tensor]:
    """Predicted channels of scenes of any runs, as each ``simulate`` gives them, to the bit.

    The integrator takes members side by side, each with its own times and inputs: a run at one
    point fills one of its lanes, and takes as long as with all of them full. Those of the same
    formulas go together, the like in length beside each other.
    """
    flows = {k: scene.flow() for k, scene in enumerate(scenes) if not scene.restarts}
    groups: list[list[int]] = []
    room, last = 0, None
    for k in sorted(flows, key=lambda k: (id(flows[k].ode), -len(flows[k].times), k)):
        members = math.prod(flows[k].lead)
        if flows[k].ode is not last or members > room:
            groups.append([])
            room, last = SIDE_BY_SIDE, flows[k].ode
        groups[-1].append(k)
        room -= members
    out: dict[int, Tensor] = {}
    for group in groups:
        found = _integrate_together([flows[k] for k in group])
        out |= {k: scenes[k].read(own) for k, own in zip(group, found, strict=True)}
    return [out[k] if k in out else scene.simulate() for k, scene in enumerate(scenes)]


def _integrate_together(flows: Sequence[Flow]) -> list[Tensor]:
    """Readings of flows of the same formulas, (..., num_times, num_channels); the shorter ones
    stay where they end."""
    if len(flows) == 1:
        return [flow.solve(flow.start, 0, len(flow.times) - 1)[0] for flow in flows]
    longest = max(len(flow.times) for flow in flows)
    counts = [math.prod(flow.lead) for flow in flows]
    times, starts, inputs, parameters = [], [], [], []
    for flow, count in zip(flows, counts, strict=True):
        samples = torch.arange(longest).clamp(max=len(flow.times) - 1)
        times.append(flow.times[samples].expand(count, -1))
        starts.append(flow.start.reshape(count, -1))
        given = flow.inputs.expand(*flow.lead, *flow.inputs.shape[-2:])
        inputs.append(given.reshape(count, *given.shape[-2:]).index_select(1, samples))
        parameters.append(flow.parameters.reshape(count, -1))
    ode = flows[0].ode
    problem = ode.problem(torch.cat(times), 1, 1)
    readings, _ = integrated(
        ode, problem, torch.cat(starts), torch.cat(inputs), torch.cat(parameters)
    )
    parts = zip(flows, readings.split(counts), strict=True)
    return [part[:, : len(f.times)].reshape(*f.lead, len(f.times), -1) for f, part in parts]


def at_start(state: str) -> str:
    """What the start value of a state is called in start values of further states."""
    return f"{state} at start"


def _stack_values(values: list[Tensor], lead: tuple[int, ...]) -> Tensor:
    if not values:
        return torch.zeros((*lead, 0), dtype=torch.float64)
    return torch.stack([v.expand(lead) for v in values], -1)
