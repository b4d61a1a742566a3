"""``model: {system: flow_device}``: a planar device on the Stokes simulator, described in YAML."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import ClassVar

import torch
from pydantic import model_validator
from torch import Tensor

from diffsim.causes.plant import Plant
from diffsim.causes.scene import grid_of
from diffsim.data.study import Run, Study
from diffsim.data.study_check import Problem
from diffsim.identify.model import SimModel
from diffsim.identify.numerics import Numerics
from diffsim.systems.description import (
    BaseParameters,
    Quantity,
    mismatched_channels,
    missing_commands,
)
from diffsim.systems.flow_network.keys import FlowDeviceKeys, PlaneKeys
from diffsim.systems.flow_network.manifold import Manifold
from diffsim.systems.flow_network.network import NetworkDevice, Segment
from diffsim.systems.flow_network.network_balance import RTOL, NetworkScene
from diffsim.systems.flow_network.steady import (
    Parts,
    counted,
    drive_commands,
    meter_gains,
    numbered,
    plant_of,
)
from diffsim.systems.flow_network.unit_flows import UnitFlowTable

_GAUGES = 2  # at the pump and at the tap
_SINGLE = (
    *("viscosity", "wall_offset", "slip_length", "viscosity_gradient", "thinning"),
    *("compliance", "entrance_loss", "leak"),
)


class PlaneNetwork:
    """One pump and straight channels between nodes.

    Args:
        given: Description.
    """

    kind = "flow_device"
    drives_flow = True
    num_inlets, num_gauges = 1, _GAUGES

    def __init__(self, given: FlowDeviceKeys, plane: PlaneKeys):
        self.given, self.plane = given, plane
        self.num_outlets = len(plane.outlets)
        spacing = self.narrowest / 6.8  # cells across the narrowest channel
        self.device = NetworkDevice(
            nodes=plane.nodes,
            segments=tuple(Segment(c.name, c.start, c.end, c.width.value) for c in plane.channels),
            outlets=plane.outlets,
            tap=plane.tap,
            size=plane.size,
            cells=plane.cells or (round(plane.size[0] / spacing), round(plane.size[1] / spacing)),
            depth=plane.depth,
            viscosity=given.viscosity.value,
            shear_rate=given.shear_rate,
            density=given.density,
        )

    @property
    def narrowest(self) -> float:
        """Width of the narrowest channel [m]."""
        return min(c.width.value for c in self.plane.channels)

    @property
    def parts(self) -> Parts:
        """Parts that are alike, and what stands for them in names of numbers and commands."""
        outlets = numbered(self.num_outlets)
        return {
            "gauge": numbered(_GAUGES, start=self.num_outlets + 1),
            "inlet": numbered(1, "inlet_"),
            **dict.fromkeys(("meter", "branch", "outlet"), outlets),
        }

    @property
    def numbers(self) -> tuple[str, ...]:
        """Numbers that causes may change."""
        count = self.num_outlets
        more = counted(meter=count + _GAUGES, narrowing=count, outlet_pressure=count)
        return (*_SINGLE, *more)

    def quantities(self) -> dict[str, Quantity]:
        """What is known of the device and its instruments, by name of the base parameter."""
        keys = self.given.nuisances
        widths = {f"width_{c.name}": c.width for c in self.plane.channels}
        zero = Quantity(value=0.0, sd=keys.pressure_zero or None, unit="Pa")
        gain = Quantity(value=1.0, sd=keys.pump_gain or None, per="run")
        return {
            **widths,
            **dict.fromkeys((f"pressure_zero_{i + 1}" for i in range(_GAUGES)), zero),
            "pump_gain": gain,
        }

    def model(self, parameters: BaseParameters, columns: Sequence[int]) -> SimModel:
        """The network as a model: unit flows are simulated when first needed and kept with it.

        ``Numerics.mesh`` scales the cells, ``tolerance`` the balance.

        Args:
            columns: Which of the readings are channels of the study.
        """
        given, one = self.given, torch.ones((), dtype=torch.float64)
        corrected = given.is_corrected
        held = given.back_pressures or (None,) * self.num_outlets

        @lru_cache(maxsize=4)
        def table(mesh: float) -> UnitFlowTable:
            return UnitFlowTable(self.device, mesh, corrected=corrected)

        def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> NetworkScene:
            # a run that nobody has recorded yet is pumped as described
            v = parameters.in_run({f"pump_gain@{run.name}": one, **values}, run)
            return NetworkScene(
                grid=grid_of(run),
                numbers={**v, **meter_gains(v, self.num_outlets + _GAUGES)},
                zeros=self.numbers,
                commands=drive_commands(run, given.drives, [v["pump_gain"]], held),
                num_drives=1,
                is_in_time=given.is_in_time,
                rtol=RTOL * numerics.tolerance,
                table=table(numerics.mesh),
                columns=tuple(columns),
            )

        return SimModel(build, parameters.base, name="channel network")


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
