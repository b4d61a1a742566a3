"""``model: {system: flow_network}``: a network of narrow channels, described in YAML."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from pydantic import Field, model_validator

from diffsim.causes.plant import Plant
from diffsim.core.schema_numbers import KilogramsPerCubicMeter, PerSecond
from diffsim.data.study import Study
from diffsim.data.study_check import Problem
from diffsim.identify.model import SimModel
from diffsim.systems.description import (
    BaseParameters,
    Description,
    mismatched_channels,
    missing_commands,
)
from diffsim.systems.flow_network.keys import FlowNuisanceKeys, MeterKeys, SourceKeys, TubeKeys
from diffsim.systems.flow_network.lumped_build import (
    LumpedNetwork,
    dead_ends,
    layout_of,
    quantities_of,
)
from diffsim.systems.flow_network.steady import Samples, plant_of
from diffsim.systems.quantities import Viscosity


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
    samples: Samples = Field(
        "levels",
        description="What the samples of a run are: `levels` of the commands, each by itself, or "
        "one after the other in `time`: then what is late, lags or has play is a cause, too",
    )
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
