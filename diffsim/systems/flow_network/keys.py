"""Keys of ``model: {system: flow_network}`` and ``{system: flow_device}``, below the topmost."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field, model_validator

from diffsim.core.schema import FewCells2, Part
from diffsim.core.schema_numbers import (
    KilogramsPerCubicMeter,
    Meters,
    Pascals,
    PerSecond,
    Ratio,
)
from diffsim.systems.description import Description, Quantity
from diffsim.systems.flow_network.steady import Samples
from diffsim.systems.quantities import Length, Resistance, Viscosity


class TubeKeys(Part):
    """One channel between two nodes; flows count from `start` to `end`."""

    name: str = Field(description="Name of the channel, unique")
    start: str = Field(alias="from", description="Node at its start")
    end: str = Field(alias="to", description="Node at its end")
    width: Length | None = Field(None, description="Width; of a slit, the gap [m]")
    height: Length | None = Field(
        None, description="Height; of a slit, its extent across the gap [m]"
    )
    diameter: Length | None = Field(None, description="In their place, for a round channel [m]")
    length: Length | None = Field(None, description="Length [m]")
    resistance: Resistance | None = Field(
        None, description="In place of all sizes: pressure over flow [Pa s/m^3]"
    )
    is_slit: bool = Field(
        False, description="Whether the sides count for nothing: a slit, flow ~ height width^3"
    )

    @property
    def shape(self) -> str:
        """ "slit", "rectangle", "round" or "resistance"."""
        if self.resistance is not None:
            return "resistance"
        if self.diameter is not None:
            return "round"
        return "slit" if self.is_slit else "rectangle"

    @property
    def sizes(self) -> tuple[str, ...]:
        """Keys of its sizes."""
        if self.resistance is not None:
            return ("resistance",)
        return (
            ("diameter", "length") if self.diameter is not None else ("width", "height", "length")
        )

    @model_validator(mode="after")
    def _check_one_shape(self) -> TubeKeys:
        sizes = [self.width, self.height, self.diameter, self.length]
        if self.resistance is not None:
            if any(s is not None for s in sizes):
                raise ValueError(f"channel {self.name}: give a resistance or sizes, not both")
        elif self.length is None:
            raise ValueError(f"channel {self.name}: give its length, or its resistance")
        elif (self.diameter is None) == (self.width is None or self.height is None):
            raise ValueError(f"channel {self.name}: give width and height, or the diameter")
        if self.start == self.end:
            raise ValueError(f"channel {self.name} joins {self.start} to itself")
        return self


class SourceKeys(Part):
    """A pump that gives a flow, or a place whose pressure is known."""

    node: str = Field(description="Node where it acts")
    flow: str | None = Field(None, description="Command that is the pump's flow [m^3/s]")
    pressure: str | float | None = Field(
        None, description="Command that is the pressure, or a number: 0 is the atmosphere [Pa]"
    )

    one_of: ClassVar = ("flow", "pressure")


class MeterKeys(Part):
    """What one of the study's channels measures."""

    channel: str = Field(description="Channel of the study")
    flow_in: str | None = Field(None, description="Channel of the network, its flow [m^3/s]")
    pressure_at: str | None = Field(None, description="Node, its pressure [Pa]")
    pressure_in: str | None = Field(
        None, description="Channel inside which a pressure is read [Pa]"
    )
    share: Ratio | None = Field(
        None, ge=0, le=1, description="Place of `pressure_in`, from 0 at its start to 1 at its end"
    )

    @model_validator(mode="after")
    def _check_one_kind(self) -> MeterKeys:
        given = [self.flow_in, self.pressure_at, self.pressure_in]
        if sum(g is not None for g in given) != 1:
            raise ValueError(
                f"meter {self.channel}: give one of flow_in, pressure_at and pressure_in"
            )
        if (self.pressure_in is None) != (self.share is None):
            raise ValueError(f"meter {self.channel}: pressure_in and share belong together")
        return self


class FlowNuisanceKeys(Part):
    """What no set-up is without, as standard deviations; 0 leaves one out."""

    pump_gain: Ratio = Field(0.005, ge=0, description="Gain of the pumps, of its own in every run")
    flow_gain: Ratio = Field(0.005, ge=0, description="Gain of every flow meter")
    pressure_zero: Pascals = Field(0.2, ge=0, description="Zero of every pressure sensor [Pa]")


class SlitKeys(Part):
    """A straight channel of a plane network; the first one is the inlet."""

    name: str = Field(description="Name of the channel, unique")
    start: str = Field(alias="from", description="Node at its start")
    end: str = Field(alias="to", description="Node at its end")
    width: Length = Field(description="Width [m]")


class PlaneKeys(Part):
    """A plane network of straight channels in a box, from its left face to its right one."""

    nodes: dict[str, tuple[Meters, Meters]] = Field(description="Places [x, y] by name [m]")
    channels: tuple[SlitKeys, ...] = Field(min_length=1, description="The first is the inlet")
    outlets: tuple[str, ...] = Field(min_length=1, description="Nodes on the right face")
    tap: Ratio = Field(
        0.5, gt=0, le=1, description="Where on the inlet a second pressure is read, as a share"
    )
    size: tuple[Meters, Meters] = Field(description="Size of the box along x and y [m]")
    cells: FewCells2 | None = Field(
        None, description="Grid cells along x and y; default: 6.8 across the narrowest channel"
    )
    depth: Meters = Field(gt=0, description="Out of the plane; plane flows times this are flows")


class OpeningKeys(Part):
    """A straight inlet or outlet of a manifold, along x."""

    y: Meters = Field(description="Height of its axis [m]")
    width: Meters = Field(gt=0, description="Width [m]")


class ManifoldKeys(Part):
    """A box with inlets on its left, a manifold across, and outlets on its right."""

    inlets: tuple[OpeningKeys, ...] = Field(description="From bottom to top")
    outlets: tuple[OpeningKeys, ...] = Field(description="From bottom to top")
    size: tuple[Meters, Meters] = Field(description="Size of the box along x and y [m]")
    manifold: tuple[Meters, Meters] = Field(description="Lower and upper x of the manifold [m]")
    fillet: Meters = Field(gt=0, description="Blend that rounds the corners [m]")
    cells: FewCells2 = Field((96, 72), description="Grid cells along x and y")
    drive: Literal["flow", "pressure"] = Field("flow", description="What the commands prescribe")
    nominal_drive: float = Field(
        1e-4, gt=0, description="A usual level of the command [m^2/s or Pa]"
    )


class FlowDeviceKeys(Description):
    """Keys of a planar device on a grid; a manifold or a network."""

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
    samples: Samples = "levels"
    nuisances: FlowNuisanceKeys = Field(FlowNuisanceKeys(), description="Gains and zeros")

    @property
    def is_in_time(self) -> bool:
        """Whether samples of a run follow each other in time."""
        return self.samples == "time"
