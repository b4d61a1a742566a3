"""``model: {system: flow_device}``: a planar device on the Stokes simulator, described in YAML."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

from pydantic import Field, model_validator

from diffsim.causes.plant import IN_TIME, Plant
from diffsim.causes.scales import SCALES, Scales
from diffsim.core.check import did_you_mean
from diffsim.core.schema_numbers import KilogramsPerCubicMeter, PerSecond
from diffsim.data.study import Study
from diffsim.data.study_check import Problem
from diffsim.identify import Parameter
from diffsim.identify.effect import Effect
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.model import SimModel
from diffsim.identify.setup import DiagnosisSetup
from diffsim.systems.description import (
    Description,
    Quantity,
    chosen_effects,
    settings_with,
)
from diffsim.systems.flow_network.causes import (
    between_samples,
    measure_scales,
    network_library,
    signal_causes,
    stokes_library,
)
from diffsim.systems.flow_network.device import ChannelDevice, Opening
from diffsim.systems.flow_network.keys import FlowNuisanceKeys, ManifoldKeys, PlaneKeys
from diffsim.systems.flow_network.model import SINGLE as STOKES_NUMBERS
from diffsim.systems.flow_network.model import device_model
from diffsim.systems.flow_network.network import NetworkDevice, Segment
from diffsim.systems.flow_network.network_model import SINGLE as NETWORK_NUMBERS
from diffsim.systems.flow_network.network_model import network_model
from diffsim.systems.quantities import Length, Viscosity

_CELLS_PER_WIDTH = 6.8  # across the narrowest channel


class FlowDeviceDescription(Description):
    """A planar device whose flow is solved on a grid: a manifold, or a network of channels."""

    system: Literal["flow_device"] = Field(description="flow_device")
    manifold: ManifoldKeys | None = Field(
        None, description="Inlets, a manifold across them, and outlets; flows per depth"
    )
    network: PlaneKeys | None = Field(
        None, description="In its place: straight channels between nodes, one pump"
    )
    viscosity: Viscosity = Field(description="Of the fluid [Pa s]")
    density: KilogramsPerCubicMeter = Field(1000.0, gt=0, description="Of the fluid [kg/m^3]")
    shear_rate: PerSecond = Field(
        100.0, gt=0, description="Beyond which a thinning fluid thins in a network [1/s]"
    )
    wall_offset: Length = Field(
        Quantity(value=0.0), description="All walls of a manifold further out [m]"
    )
    drives: tuple[str, ...] = Field(
        min_length=1, description="Commands: of each inlet of a manifold, or of the pump [m^3/s]"
    )
    back_pressures: tuple[str | None, ...] = Field(
        (), description="Commands: pressure beyond each outlet of a network, null for none [Pa]"
    )
    flows: tuple[str | None, ...] = Field(
        (), description="Channels: flow through each outlet, null where none is measured"
    )
    pressures: tuple[str | None, ...] = Field(
        (), description="Channels: pressure at each inlet of a manifold; at pump and tap [Pa]"
    )
    velocities: tuple[str, ...] = Field(
        (), description="Channels: profile across the last outlet of a manifold [m/s]"
    )
    is_corrected: bool = Field(
        True, description="Whether resistances of a network are corrected by a finer grid once"
    )
    samples: Literal["levels", "time"] = Field(
        "levels",
        description="What the samples of a run are: `levels` of the commands, each by itself, or "
        "one after the other in `time`: then what is late, lags or has play is a cause, too",
    )
    nuisances: FlowNuisanceKeys = Field(FlowNuisanceKeys(), description="Gains and zeros")

    @model_validator(mode="after")
    def _check_one_device(self) -> FlowDeviceDescription:
        if (self.manifold is None) == (self.network is None):
            raise ValueError("give manifold or network (one of them)")
        if any(q.per is not None for q in (self.viscosity, self.wall_offset)):
            raise ValueError("viscosity and wall_offset have one value for all runs; leave per out")
        outlets = len(self._outlets)
        inlets = len(self.manifold.inlets) if self.manifold is not None else 1
        taps = inlets if self.manifold is not None else 2
        for key, names, count in (
            ("drives", self.drives, inlets),
            ("flows", self.flows, outlets),
            ("pressures", self.pressures, taps),
            ("back_pressures", self.back_pressures, outlets),
        ):
            if names and len(names) != count:
                raise ValueError(f"{key} needs {count} names (null for none), got {len(names)}")
        if self.manifold is not None and self.back_pressures:
            raise ValueError("back_pressures belong to a network")
        self._build_device()
        return self

    @property
    def _outlets(self) -> Sequence[object]:
        if self.manifold is not None:
            return self.manifold.outlets
        assert self.network is not None
        return self.network.outlets

    def problems(self, study: Study) -> list[Problem]:
        """Channels and commands that the description and the study disagree on."""
        return list(self._find_problems(study))

    def setup(self, study: Study) -> DiagnosisSetup:
        """Model, candidate causes and options for a study."""
        if found := self.problems(study):
            raise ValueError("\n".join(str(p) for p in found))
        device = self._build_device()
        shown = self._list_shown_channels()
        columns = tuple(shown.index(c.name) for c in study.channels)
        base = tuple(self._list_parameters(device, [r.name for r in study.runs]))
        library: tuple[Effect, ...]
        model: SimModel
        if isinstance(device, ChannelDevice):
            model = device_model(device, base, commands=self.drives, columns=columns)
            library = stokes_library(device)
        else:
            back = self.back_pressures or (None,) * len(device.outlets)
            model = network_model(
                device,
                base,
                pump=self.drives[0],
                back_pressures=[b or f"no back pressure {i}" for i, b in enumerate(back)],
                columns=columns,
                corrected=self.is_corrected,
            )
            library = network_library(device)
        scales = self._measure_scales(study)
        if self.effects.only or self.samples == "time":
            library += self._list_signal_causes(study, scales)
        model.frame = {SCALES: scales.saved()}
        return DiagnosisSetup(
            model,
            chosen_effects(library, self.effects, study, self.plant(study)),
            settings=settings_with(DiagnosisSettings(), self.effort),
        )

    @property
    def _drives_flow(self) -> bool:
        """Whether what drives is pumps, not regulators of pressure."""
        return self.manifold is None or self.manifold.drive == "flow"

    def _measure_scales(self, study: Study) -> Scales:
        network = self.network
        return measure_scales(
            study, None if network is None else min(c.width.value for c in network.channels)
        )

    def _list_signal_causes(self, study: Study, scales: Scales) -> tuple[Effect, ...]:
        held = tuple(name for name in self.back_pressures if name)
        return signal_causes(
            study,
            scales,
            pumps=self.drives if self._drives_flow else (),
            pressures=held if self._drives_flow else self.drives,
            is_in_time=self.samples == "time",
        )

    def plant(self, study: Study) -> Plant:
        """What the device offers to causes of a user."""
        between = between_samples(self.samples)
        commands = (*self.drives, *(name for name in self.back_pressures if name))
        return Plant(
            kind="flow_device",
            scales=self._measure_scales(study),
            channels=study.channels,
            commands=dict.fromkeys(commands, between),
            numbers=STOKES_NUMBERS if self.manifold is not None else NETWORK_NUMBERS,
            facts={IN_TIME: self.samples == "time"},
        )

    def _build_device(self) -> ChannelDevice | NetworkDevice:
        if (m := self.manifold) is not None:
            return ChannelDevice(
                inlets=tuple(Opening(o.y, o.width) for o in m.inlets),
                outlets=tuple(Opening(o.y, o.width) for o in m.outlets),
                size=m.size,
                manifold=m.manifold,
                fillet=m.fillet,
                cells=m.cells,
                drive=m.drive,
                viscosity=self.viscosity.value,
                nominal_drive=m.nominal_drive,
                num_profile_points=len(self.velocities),
            )
        assert self.network is not None
        n = self.network
        spacing = min(c.width.value for c in n.channels) / _CELLS_PER_WIDTH
        return NetworkDevice(
            nodes=n.nodes,
            segments=tuple(Segment(c.name, c.start, c.end, c.width.value) for c in n.channels),
            outlets=n.outlets,
            tap=n.tap,
            size=n.size,
            cells=n.cells or (round(n.size[0] / spacing), round(n.size[1] / spacing)),
            depth=n.depth,
            viscosity=self.viscosity.value,
            shear_rate=self.shear_rate,
            density=self.density,
        )

    def _list_shown_channels(self) -> list[str | None]:
        """The study's channels in the order in which the model makes readings."""
        taps = len(self.drives) if self.manifold is not None else 2
        flows = self.flows or (None,) * len(self._outlets)
        return [*flows, *(self.pressures or (None,) * taps), *self.velocities]

    def _list_parameters(
        self, device: ChannelDevice | NetworkDevice, runs: Sequence[str]
    ) -> Iterator[Parameter]:
        keys = self.nuisances
        if self.viscosity.is_fitted:
            yield self.viscosity.parameter("viscosity")
        if keys.flow_gain > 0.0:
            for i in range(len(self._outlets)):
                yield Parameter(f"flow_gain_{i + 1}", 1.0, keys.flow_gain)
        if isinstance(device, ChannelDevice):
            if self.wall_offset.is_fitted:
                yield self.wall_offset.parameter("wall_offset")
            if keys.pump_gain > 0.0:
                for i in range(len(device.inlets)):
                    yield Parameter(f"drive_gain_{i + 1}", 1.0, keys.pump_gain)
            return
        assert self.network is not None
        for c in self.network.channels:
            if c.width.is_fitted:
                yield c.width.parameter(f"width_{c.name}")
        if keys.pressure_zero > 0.0:
            for i in range(2):
                yield Parameter(f"pressure_zero_{i + 1}", 0.0, keys.pressure_zero, "Pa")
        if keys.pump_gain > 0.0:
            yield from (Parameter(f"pump_gain@{run}", 1.0, keys.pump_gain) for run in runs)

    def _find_problems(self, study: Study) -> Iterator[Problem]:
        channels, shown = (
            [c.name for c in study.channels],
            [n for n in self._list_shown_channels() if n],
        )
        for name in shown:
            if name not in channels:
                said = f"no channel {name!r}{did_you_mean(name, channels)}"
                yield Problem("error", "model.flows, pressures or velocities", said)
        for name in channels:
            if name not in shown:
                said = "flows, pressures and velocities do not name it; take it out of channels"
                yield Problem("error", f"channel {name}", said)
        for key, commands in (("drives", self.drives), ("back_pressures", self.back_pressures)):
            for command in commands:
                for run in study.runs:
                    if command is not None and command not in run.command:
                        said = f"run {run.name} has no command {command!r}"
                        hint = did_you_mean(command, run.command)
                        yield Problem("error", f"model.{key}", said + hint)
                        break
