"""From a described network of channels to scenes and candidate causes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.instruments import grid_of
from diffsim.data.study import Run
from diffsim.identify.numerics import Numerics
from diffsim.systems.description import BaseParameters, Quantity
from diffsim.systems.flow_network.keys import FlowNuisanceKeys, MeterKeys, SourceKeys, TubeKeys
from diffsim.systems.flow_network.lumped import Layout, LumpedScene, Reading
from diffsim.systems.flow_network.steady import number_places

_SIZES = ("width", "height", "diameter", "length", "resistance")
_WIDTHS = _SIZES[:3]
#: Fields of a scene that are one number, which causes may change.
SINGLE = (
    *("viscosity", "wall_offset", "slip_length", "thinning"),
    *("compliance", "entrance_loss", "leak"),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class LumpedNetwork:
    """Makes the scene of a run at values of the base parameters.

    Attributes:
        tubes, sources, meters: As described; meters in the order of the study's channels.
        layout: What joins what.
        parameters: Quantities by name.
        density: Of the fluid [kg/m^3].
        shear_rate: Beyond which the fluid thins [1/s].
    """

    tubes: tuple[TubeKeys, ...]
    sources: tuple[SourceKeys, ...]
    meters: tuple[MeterKeys, ...]
    layout: Layout
    parameters: BaseParameters
    density: float
    shear_rate: float

    def __call__(self, values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> LumpedScene:
        v = self.parameters.in_run(values, run)
        drive, back, level = self._group_levels(run)
        one, zero = torch.ones((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)

        def sizes(*names: str) -> Tensor:
            found = [
                next((v[f"{n}_{t.name}"] for n in names if f"{n}_{t.name}" in v), one)
                for t in self.tubes
            ]
            return torch.stack(found)

        names = [m.channel for m in self.meters]
        return LumpedScene(
            commands=self.commands,
            grid=grid_of(run),
            numbers=self.numbers,
            layout=self.layout,
            drive=drive * v["pump_gain"],
            back_pressure=back,
            level=level,
            viscosity=v["viscosity"],
            width=sizes("width", "diameter", "resistance"),
            height=sizes("height"),
            length=sizes("length"),
            nominal_viscosity=self.parameters.quantities["viscosity"].value,
            outlet_pressure=torch.zeros(back.shape[1], dtype=torch.float64),
            channel_gain=torch.stack([v.get(f"flow_gain_{n}", one) for n in names]),
            channel_offset=torch.stack([v.get(f"pressure_zero_{n}", zero) for n in names]),
            narrowing=torch.zeros(len(self.layout.branches), dtype=torch.float64),
            node_leak=torch.zeros(len(self.layout.free), dtype=torch.float64),
            density=self.density,
            shear_rate=self.shear_rate,
            rtol=1e-11 * numerics.tolerance,
        )

    @property
    def _source_values(self) -> list[str | float | None]:
        """Command or constant of each pump, then of each pressure."""
        flows = [s.flow for s in self.sources if s.flow is not None]
        return [*flows, *(s.pressure for s in self.sources if s.flow is None)]

    @property
    def commands(self) -> tuple[str, ...]:
        """Command of each pump, then of each pressure; empty where it is constant."""
        return tuple(given if isinstance(given, str) else "" for given in self._source_values)

    @property
    def narrowest(self) -> float | None:
        """Width of the narrowest channel that has one [m]."""
        values = self.parameters.quantities
        keys = [f"{s}_{t.name}" for t in self.tubes if t.shape != "resistance" for s in _WIDTHS]
        return min((values[key].value for key in keys if key in values), default=None)

    def joints(self) -> list[str]:
        """Names of the nodes where channels meet and no pump is."""
        layout, nodes = self.layout, nodes_of(self.tubes)
        ends = [*layout.starts, *layout.ends]
        return [nodes[n] for n in layout.free if ends.count(n) > 1 and n not in layout.pumps]

    @property
    def numbers(self) -> dict[str, tuple[str, int | None]]:
        """Numbers that causes may change, as of ``SteadyScene``."""
        layout, nodes = self.layout, nodes_of(self.tubes)
        vectors = {
            "meter": ("channel_gain", len(self.meters)),
            "narrowing": ("narrowing", len(layout.branches)),
            "outlet_pressure": ("outlet_pressure", len(layout.held)),
        }
        found = number_places(SINGLE, vectors)
        for i, node in enumerate(layout.free):
            found[f"leak_at_{nodes[node]}"] = ("node_leak", i)
        for i, tube in enumerate(self.tubes):
            width = {"round": "diameter", "resistance": "resistance"}.get(tube.shape, "width")
            found[f"{width}_{tube.name}"] = ("width", i)
            if width == "width":
                found[f"height_{tube.name}"] = ("height", i)
            if width != "resistance":
                found[f"length_{tube.name}"] = ("length", i)
        return found

    def _group_levels(self, run: Run) -> tuple[Tensor, Tensor, Tensor]:
        """Different levels of pumps and of pressures, and which holds at each sample."""
        count, pumps = len(run.time_s), self.layout.pumps
        columns = []
        for given in self._source_values:
            value = run.command[given] if isinstance(given, str) else np.full(count, given)
            columns.append(np.asarray(value, dtype=np.float64))
        levels, level = np.unique(np.stack(columns, -1), axis=0, return_inverse=True)
        rows = torch.from_numpy(levels)
        return rows[:, : len(pumps)], rows[:, len(pumps) :], torch.from_numpy(level.reshape(-1))


def layout_of(
    tubes: Sequence[TubeKeys], sources: Sequence[SourceKeys], meters: Sequence[MeterKeys]
) -> Layout:
    """Nodes and channels by index.

    Raises:
        ValueError: a name that is not there, or a network whose pressures hang in the air.
    """
    nodes = nodes_of(tubes)
    names = [t.name for t in tubes]
    for s in sources:
        if s.node not in nodes:
            raise ValueError(f"sources: no channel ends at {s.node}; nodes: {', '.join(nodes)}")
    pressures = [s for s in sources if s.flow is None]
    held = tuple(nodes.index(s.node) for s in pressures)
    if not held:
        open_ends = dead_ends(tubes, sources)
        example = f", such as {{node: {open_ends[0]}, pressure: 0}}" if open_ends else ""
        raise ValueError(
            f"sources: no pressure is known anywhere; give one to each open end{example}"
        )
    if len(set(held)) < len(held):
        raise ValueError("sources: two pressures at one node")
    if repeated := {n for n in names if names.count(n) > 1}:
        raise ValueError(f"channels repeat: {', '.join(sorted(repeated))}")
    readings = []
    for m in meters:
        tube = m.flow_in or m.pressure_in
        known, given = (names, tube) if tube is not None else (nodes, m.pressure_at)
        if given not in known:
            raise ValueError(f"meter {m.channel}: no {given!r}; known: {', '.join(known)}")
        index = known.index(str(given))
        readings.append(
            Reading(tube=index, share=m.share) if tube is not None else Reading(node=index)
        )
    ends = tuple(nodes.index(t.end) for t in tubes)
    return Layout(
        starts=tuple(nodes.index(t.start) for t in tubes),
        ends=ends,
        shapes=tuple(t.shape for t in tubes),
        free=tuple(i for i in range(len(nodes)) if i not in held),
        pumps=tuple(nodes.index(s.node) for s in sources if s.flow is not None),
        held=held,
        branches=tuple(
            k for k, end in enumerate(ends) if end in held and tubes[k].shape != "resistance"
        ),
        readings=tuple(readings),
    )


def nodes_of(tubes: Sequence[TubeKeys]) -> list[str]:
    """Names of all nodes, in the order of their indices."""
    return list(dict.fromkeys(n for t in tubes for n in (t.start, t.end)))


def dead_ends(tubes: Sequence[TubeKeys], sources: Sequence[SourceKeys]) -> list[str]:
    """Nodes that a single channel joins and no source feeds: nothing flows out of them."""
    ends = [n for t in tubes for n in (t.start, t.end)]
    fed = {s.node for s in sources}
    return [n for n in dict.fromkeys(ends) if ends.count(n) == 1 and n not in fed]


def quantities_of(
    viscosity: Quantity,
    tubes: Sequence[TubeKeys],
    meters: Sequence[MeterKeys],
    nuisances: FlowNuisanceKeys,
) -> Iterator[tuple[str, Quantity]]:
    """Everything that may be fitted, by name of the base parameter."""
    yield "viscosity", viscosity
    for tube in tubes:
        for size in _SIZES:
            given: Quantity | None = getattr(tube, size)
            if given is not None:
                yield f"{size}_{tube.name}", given
    gain = nuisances.pump_gain
    one = Quantity(value=1.0)
    yield "pump_gain", Quantity(value=1.0, sd=gain, per="run") if gain > 0.0 else one
    for meter in meters:
        if meter.flow_in is not None and nuisances.flow_gain > 0.0:
            yield f"flow_gain_{meter.channel}", Quantity(value=1.0, sd=nuisances.flow_gain)
        if meter.flow_in is None and nuisances.pressure_zero > 0.0:
            zero = Quantity(value=0.0, sd=nuisances.pressure_zero, unit="Pa")
            yield f"pressure_zero_{meter.channel}", zero
