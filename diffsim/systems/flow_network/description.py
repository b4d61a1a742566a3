"""``model: {system: flow_network}``: a network of narrow channels, described in YAML."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from pydantic import Field, model_validator
from torch import Tensor

from diffsim.causes.plant import Plant
from diffsim.causes.scene import grid_of
from diffsim.core.schema_numbers import KilogramsPerCubicMeter, PerSecond
from diffsim.data.study import Run, Study
from diffsim.data.study_check import Problem
from diffsim.identify.model import SimModel
from diffsim.identify.numerics import Numerics
from diffsim.systems.description import (
    BaseParameters,
    Description,
    Quantity,
    mismatched_channels,
    missing_commands,
)
from diffsim.systems.flow_network.keys import FlowNuisanceKeys, MeterKeys, SourceKeys, TubeKeys
from diffsim.systems.flow_network.lumped import RTOL, LumpedScene, MeterReading, TubeLayout
from diffsim.systems.flow_network.steady import (
    Parts,
    Samples,
    counted,
    drive_commands,
    numbered,
    plant_of,
)
from diffsim.systems.quantities import Viscosity

_SIZES = ("width", "height", "diameter", "length", "resistance")
_WIDTHS = _SIZES[:3]
#: Numbers of the whole network that causes may change.
_SINGLE = (
    *("viscosity", "wall_offset", "slip_length", "thinning"),
    *("compliance", "entrance_loss", "leak"),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class LumpedNetwork:
    """Makes the scene of a run at values of the base parameters."""

    # tubes, sources, meters: as described; meters in the order of the study's channels
    tubes: tuple[TubeKeys, ...]
    sources: tuple[SourceKeys, ...]
    meters: tuple[MeterKeys, ...]
    layout: TubeLayout  # what joins what
    parameters: BaseParameters  # quantities by name
    density: float  # of the fluid [kg/m^3]
    shear_rate: float  # beyond which the fluid thins [1/s]
    is_in_time: bool  # whether samples of a run follow each other in time

    def __call__(self, values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> LumpedScene:
        v = self.parameters.in_run(values, run)
        one = torch.ones((), dtype=torch.float64)
        pumps = [s.flow for s in self.sources if s.flow is not None]
        gains = {
            f"meter_{i + 1}": v.get(f"flow_gain_{m.channel}", one)
            for i, m in enumerate(self.meters)
        }
        return LumpedScene(
            grid=grid_of(run),
            numbers={**v, **gains},
            zeros=self.numbers,
            commands=drive_commands(
                run,
                pumps,
                [v["pump_gain"]] * len(pumps),
                [s.pressure for s in self.sources if s.flow is None],
            ),
            num_drives=len(pumps),
            is_in_time=self.is_in_time,
            rtol=RTOL * numerics.tolerance,
            layout=self.layout,
            nominal_viscosity=self.parameters.quantities["viscosity"].value,
            density=self.density,
            shear_rate=self.shear_rate,
        )

    @property
    def narrowest(self) -> float | None:
        """Width of the narrowest channel that has one [m]."""
        values = self.parameters.quantities
        keys = [f"{s}_{t.name}" for t in self.tubes if t.shape != "resistance" for s in _WIDTHS]
        return min((values[key].value for key in keys if key in values), default=None)

    @property
    def parts(self) -> Parts:
        """Parts that are alike, and what stands for them in names of numbers and commands."""
        layout = self.layout
        ends = [*layout.starts, *layout.ends]
        joints = [n for n in layout.free if ends.count(n) > 1 and n not in layout.pumps]
        flows = [i + 1 for i, m in enumerate(self.meters) if m.flow_in is not None]
        gauges = [str(i + 1) for i, m in enumerate(self.meters) if m.flow_in is None]
        return {
            "joint": {layout.nodes[n]: layout.nodes[n] for n in joints},
            "gauge": {i: i for i in gauges},
            "inlet": numbered(len(layout.pumps), "inlet_"),
            "meter": {str(k + 1): str(i) for k, i in enumerate(flows)},
            "branch": numbered(len(layout.branches)),
            "outlet": numbered(len(layout.held)),
        }

    @property
    def numbers(self) -> tuple[str, ...]:
        """Numbers that causes may change."""
        layout = self.layout
        return (
            *_SINGLE,
            *counted(
                meter=len(self.meters),
                narrowing=len(layout.branches),
                outlet_pressure=len(layout.held),
            ),
            *(f"leak_at_{layout.nodes[node]}" for node in layout.free),
            *(f"{size}_{t.name}" for t in self.tubes for size in t.sizes),
        )


def layout_of(
    tubes: Sequence[TubeKeys], sources: Sequence[SourceKeys], meters: Sequence[MeterKeys]
) -> TubeLayout:
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
    readings = []
    for m in meters:
        tube = m.flow_in or m.pressure_in
        known, given = (names, tube) if tube is not None else (nodes, m.pressure_at)
        if given not in known:
            raise ValueError(f"meter {m.channel}: no {given!r}; known: {', '.join(known)}")
        index = known.index(str(given))
        readings.append(
            MeterReading(m.channel, tube=index, share=m.share)
            if tube is not None
            else MeterReading(m.channel, node=index)
        )
    ends = tuple(nodes.index(t.end) for t in tubes)
    return TubeLayout(
        nodes=tuple(nodes),
        tubes=tuple(names),
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


class FlowNetworkDescription(Description):
    """Narrow channels between nodes, pumps and pressures, and meters; steady at every sample."""

    system: Literal["flow_network"] = Field(description="flow_network")
    viscosity: Viscosity = Field(description="Of the fluid [Pa s]")
    density: KilogramsPerCubicMeter = Field(1000.0, gt=0, description="Of the fluid [kg/m^3]")
    shear_rate: PerSecond = Field(
        100.0, gt=0, description="Beyond which a thinning fluid thins [1/s]"
    )
    channels: tuple[TubeKeys, ...] = Field(
        min_length=1,
        description="Channels of the network. Where some meet and no pump is, a leak is a "
        "candidate cause, leak_at_NODE; at the pump it is leak",
    )
    sources: tuple[SourceKeys, ...] = Field(
        min_length=1,
        description="Pumps and known pressures; give each open end {node, pressure: 0}, for "
        "nothing flows out of an end that has none",
    )
    meters: tuple[MeterKeys, ...] = Field(
        min_length=1, description="What each channel of the study measures"
    )
    samples: Samples = "levels"
    nuisances: FlowNuisanceKeys = Field(FlowNuisanceKeys(), description="Gains and zeros")

    @model_validator(mode="after")
    def _check_joints(self) -> FlowNetworkDescription:
        layout_of(self.channels, self.sources, self.meters)
        return self

    def model(self, study: Study) -> SimModel:
        """The network as a model."""
        network = self._build_network(study)
        model = SimModel(network, network.parameters.base, "flow network")
        model.run_cost = 2000.0  # weighted steps of a prediction
        return model

    def plant(self, study: Study) -> Plant:
        """What the network tells of itself."""
        network = self._build_network(study)
        pumps = [s.flow for s in self.sources if isinstance(s.flow, str)]
        pressures = [s.pressure for s in self.sources if isinstance(s.pressure, str)]
        return plant_of(
            study,
            kind="flow_network",
            samples=self.samples,
            pumps=pumps,
            pressures=pressures,
            asked=self.effects.only is not None,
            narrowest=network.narrowest,
            numbers=network.numbers,
            parts=network.parts,
            facts={
                "walls": network.narrowest is not None,
                "sees_pressure": bool(network.parts["gauge"] or pressures),
                "pumped": bool(pumps),
            },
        )

    def _build_network(self, study: Study) -> LumpedNetwork:
        of = {m.channel: m for m in self.meters}
        meters = tuple(of[c.name] for c in study.channels)
        known = dict(quantities_of(self.viscosity, self.channels, meters, self.nuisances))
        return LumpedNetwork(
            tubes=self.channels,
            sources=self.sources,
            meters=meters,
            layout=layout_of(self.channels, self.sources, meters),
            parameters=BaseParameters(known, study.runs),
            density=self.density,
            shear_rate=self.shear_rate,
            is_in_time=self.samples == "time",
        )

    def find_problems(self, study: Study) -> Iterator[Problem]:
        """Channels and commands that the description and the study disagree on."""
        named = [m.channel for m in self.meters]
        for name in named:
            if named.count(name) > 1:
                yield Problem("error", "model.meters", f"channel {name} is named twice")
        hint = "model.meters does not name it; name it, or take it out of channels"
        yield from mismatched_channels([("model.meters", name) for name in named], study, hint)
        closed = dead_ends(self.channels, self.sources)
        for meter in self.meters:
            tube = next((t for t in self.channels if t.name == meter.flow_in), None)
            if tube is not None and (node := {tube.start, tube.end} & set(closed)):
                said = (
                    f"{meter.channel} measures the flow in {tube.name}, which ends at "
                    f"{node.pop()}, where nothing flows out; give that node a pressure in sources"
                )
                yield Problem("error", "model.meters", said)
        given = [s.flow if s.flow is not None else s.pressure for s in self.sources]
        wanted = [(f"model.sources[{i}]", c) for i, c in enumerate(given) if isinstance(c, str)]
        yield from missing_commands(wanted, study.runs)
