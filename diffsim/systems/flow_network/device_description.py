"""``model: {system: flow_device}``: a planar device on the Stokes simulator, described in YAML."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from pydantic import model_validator

from diffsim.causes.plant import Plant
from diffsim.data.study import Study
from diffsim.data.study_check import Problem
from diffsim.identify.model import SimModel
from diffsim.systems.description import (
    BaseParameters,
    Quantity,
    mismatched_channels,
    missing_commands,
)
from diffsim.systems.flow_network.keys import FlowDeviceKeys
from diffsim.systems.flow_network.manifold import Manifold
from diffsim.systems.flow_network.plane import PlaneNetwork
from diffsim.systems.flow_network.steady import counted, plant_of


class FlowDeviceDescription(FlowDeviceKeys):
    """A planar device whose flow is solved on a grid: a manifold, or a network of channels."""

    one_of: ClassVar = ("manifold", "network")

    @model_validator(mode="after")
    def _check_one_device(self) -> FlowDeviceDescription:
        if any(q.per is not None for q in (self.viscosity, self.wall_offset)):
            raise ValueError("viscosity and wall_offset have one value for all runs; leave per out")
        device = self.device
        for key, names, count in (
            ("drives", self.drives, device.num_inlets),
            ("flows", self.flows, device.num_outlets),
            ("pressures", self.pressures, device.num_gauges),
            ("back_pressures", self.back_pressures, device.num_outlets),
        ):
            if names and len(names) != count:
                raise ValueError(f"{key} needs {count} names (null for none), got {len(names)}")
        if self.manifold is not None and self.back_pressures:
            raise ValueError("back_pressures belong to a network")
        return self

    @property
    def device(self) -> Manifold | PlaneNetwork:
        """The device on its grid."""
        if self.manifold is not None:
            return Manifold(self, self.manifold)
        assert self.network is not None
        return PlaneNetwork(self, self.network)

    def model(self, study: Study) -> SimModel:
        """The device as a model."""
        device, shown = self.device, self._list_shown_channels()
        meter = Quantity(value=1.0, sd=self.nuisances.flow_gain or None)
        quantities = {
            "viscosity": self.viscosity,
            **dict.fromkeys(counted(flow_gain=device.num_outlets), meter),
            **device.quantities(),
        }
        return device.model(
            BaseParameters(quantities, study.runs), [shown.index(c.name) for c in study.channels]
        )

    def plant(self, study: Study) -> Plant:
        """What the device tells of itself."""
        device = self.device
        held = tuple(name for name in self.back_pressures if name)
        return plant_of(
            study,
            kind=device.kind,
            samples=self.samples,
            pumps=self.drives if device.drives_flow else (),
            pressures=held if device.drives_flow else self.drives,
            asked=self.effects.only is not None,
            narrowest=device.narrowest,
            numbers=device.numbers,
            parts=device.parts,
            facts=dict.fromkeys(("walls", "sees_pressure", "pumped"), True),
        )

    def _list_shown_channels(self) -> list[str | None]:
        """The study's channels in the order in which the model makes readings."""
        flows = self.flows or (None,) * self.device.num_outlets
        return [*flows, *(self.pressures or (None,) * self.device.num_gauges), *self.velocities]

    def find_problems(self, study: Study) -> Iterator[Problem]:
        """Channels and commands that the description and the study disagree on."""
        where = "model.flows, pressures or velocities"
        shown = [(where, name) for name in self._list_shown_channels() if name]
        hint = "flows, pressures and velocities do not name it; take it out of channels"
        yield from mismatched_channels(shown, study, hint)
        drives = [("model.drives", name) for name in self.drives]
        held = [("model.back_pressures", name) for name in self.back_pressures]
        yield from missing_commands([*drives, *held], study.runs)
