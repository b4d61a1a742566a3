"""Keys of ``model: {system: rod}``."""

from __future__ import annotations

import itertools
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from diffsim.causes.signals import Between
from diffsim.core.check import did_you_mean
from diffsim.core.schema import Part
from diffsim.core.schema_numbers import Meters, Radians
from diffsim.core.units import in_unit
from diffsim.systems.description import (
    Description,
    Quantity,
    known,
    quantities_of,
)
from diffsim.systems.quantities import Angle, Length, Mass, Plain, PositiveDensity, PositivePressure

Vector = tuple[float, float, float]


def _read_meters(given: Any) -> Any:
    """Three places with a unit, or in meters."""
    if isinstance(given, (list, tuple)) and len(given) == 3:
        return tuple(in_unit(one, "m") for one in given)
    return given


Place = Annotated[Vector, BeforeValidator(_read_meters)]


class Station(Part):
    """Radius of the rod at one place."""

    at: Meters = Field(ge=0, description="Arc length from the base [m]")
    radius: Meters = Field(gt=0, description="Radius there [m]")


class RodMaterial(Part):
    """Material of the rod, linear in bending, twist and stretch."""

    youngs_modulus: PositivePressure = Field(description="Young's modulus [Pa]")
    poissons_ratio: Plain = Field(
        known(0.45, "-"), description="Poisson's ratio; it says how stiff the rod is against twist"
    )
    density: PositiveDensity = Field(description="Density [kg/m^3]")


class Base(Part):
    """How the rod is held at its first end."""

    place: Place = Field((0.0, 0.0, 0.0), description="Where, in the frame of the recording [m]")
    along: Vector = Field((1.0, 0.0, 0.0), description="Direction of the axis there")
    across: Vector = Field((0.0, 1.0, 0.0), description="Direction of local y; z is along x y")
    twist: Angle = Field(known(0.0, "rad"), description="Turned about its axis [rad]")
    tilt_y: Angle = Field(known(0.0, "rad"), description="Turned about local y [rad]")
    tilt_z: Angle = Field(known(0.0, "rad"), description="Turned about local z [rad]")
    shift_x: Length = Field(known(0.0, "m"), description="Place along x, in addition [m]")
    shift_y: Length = Field(known(0.0, "m"), description="Place along y, in addition [m]")
    shift_z: Length = Field(known(0.0, "m"), description="Place along z, in addition [m]")

    @model_validator(mode="after")
    def _check_directions(self) -> Base:
        dot = sum(a * b for a, b in zip(self.along, self.across, strict=True))
        if not any(self.along) or not any(self.across) or abs(dot) > 1e-9:
            raise ValueError("along and across must be directions at right angles to each other")
        return self


class PathPoint(Part):
    """Where a tendon passes a section."""

    at: Meters = Field(ge=0, description="Arc length of the section [m]")
    angle: Radians = Field(description="Around the axis, from local y towards z [rad]")
    distance: Meters = Field(gt=0, description="From the axis [m]")


class RodTendon(Part):
    """A cable along the rod from its base, fixed at the last point of its path."""

    name: str = Field(description="Short name; base parameters are called by it")
    command: str = Field(description="Name of the command: the tension at the base [N]")
    path: tuple[PathPoint, ...] = Field(
        min_length=2, description="Sections that it passes, straight between them"
    )
    gain: Plain = Field(
        known(1.0, "-"), description="Tension per command: one over the radius of a pulley, say"
    )


class RodMass(Part):
    """A mass fixed to a section."""

    name: str = Field(description="Short name; base parameters are called by it")
    at: Meters = Field(ge=0, description="Arc length of its section [m]")
    offset: Place = Field((0.0, 0.0, 0.0), description="From the axis: along, local y, z [m]")
    mass: Mass = Field(description="Mass [kg]")


class RodMarker(Part):
    """A marker fixed to a section, perhaps on a stub."""

    at: Meters = Field(ge=0, description="Arc length of its section [m]")
    offset: Place = Field((0.0, 0.0, 0.0), description="From the axis: along, local y, z [m]")
    along: Length = Field(known(0.0, "m"), description="Shifted along the axis by [m]")
    y: Length = Field(known(0.0, "m"), description="Shifted along local y by [m]")
    z: Length = Field(known(0.0, "m"), description="Shifted along local z by [m]")


class RodReading(Part):
    """What one channel shows."""

    marker: str = Field(description="Name of the marker")
    axis: Literal["x", "y", "z"] = Field(description="Axis of the recording: its place there")


class RodNumerics(Part):
    """How it is simulated."""

    cells: int = Field(
        24, ge=4, le=10_000, description="Number of elements; the error falls with its square"
    )
    tolerance: float = Field(
        1e-9, gt=0, lt=1, description="Turn of the last step of the solver [rad]"
    )


class RodKeys(Description):
    """A slender round rod, held at one end, in equilibrium under tendons and weight."""

    system: Literal["rod"] = Field("rod", description="Kind of system: `rod`")
    stations: tuple[Station, ...] = Field(
        min_length=2, description="Radius at two places or more, straight between them"
    )
    material: RodMaterial = Field(description="Material")
    base: Base = Field(Base(), description="How it is held")
    gravity: Vector = Field((0.0, 0.0, -9.81), description="Acceleration of free fall [m/s^2]")
    tendons: tuple[RodTendon, ...] = Field((), description="Cables that pull")
    masses: tuple[RodMass, ...] = Field((), description="Masses fixed to it")
    markers: dict[str, RodMarker] = Field(description="Markers by name")
    channels: dict[str, RodReading] = Field(
        {}, description="What channels show; one called MARKER_x, or MARKER_x_m, needs no entry"
    )
    sessions: str | None = Field(
        None,
        description="Fact of the runs' `setup` that says in which session they were recorded; "
        "opens causes between sessions: a marker that was put elsewhere, a clamp that was turned",
    )
    samples: Literal["poses", "time"] = Field(
        "poses",
        description="What the samples of a run are: `poses`, each by itself, or poses one after "
        "the other in `time`: then what is late, lags or has play is a cause, too",
    )
    numerics: RodNumerics = Field(RodNumerics(), description="Elements and tolerance")

    @model_validator(mode="after")
    def _check_on_rod(self) -> RodKeys:
        at = [s.at for s in self.stations]
        if at[0] != 0.0 or any(b <= a for a, b in itertools.pairwise(at)):
            raise ValueError("stations: the first is at 0, and each lies beyond the one before")
        where = {f"masses[{i}]": [m.at] for i, m in enumerate(self.masses)}
        where |= {f"markers.{name}": [m.at] for name, m in self.markers.items()}
        where |= {f"tendons[{i}].path": [p.at for p in t.path] for i, t in enumerate(self.tendons)}
        for key, places in where.items():
            if max(places) > at[-1] + 1e-9:
                raise ValueError(f"{key}: {max(places):g} m is beyond the rod's end, {at[-1]:g} m")
        for i, tendon in enumerate(self.tendons):
            own = [p.at for p in tendon.path]
            if own[0] != 0.0 or any(b <= a for a, b in itertools.pairwise(own)):
                raise ValueError(f"tendons[{i}].path: from 0 on, each point beyond the one before")
        return self

    @model_validator(mode="after")
    def _check_markers(self) -> RodKeys:
        for name, reading in self.channels.items():
            if reading.marker not in self.markers:
                raise ValueError(
                    f"channels.{name}: no marker {reading.marker!r}"
                    f"{did_you_mean(reading.marker, self.markers)}; "
                    f"known: {', '.join(self.markers)}"
                )
        return self

    def reading(self, channel: str) -> RodReading | None:
        """What a channel shows; None: neither described nor called after a marker."""
        if channel in self.channels:
            return self.channels[channel]
        for tail in ("", "_m"):
            marker, _, axis = channel.removesuffix(tail).rpartition("_")
            if marker in self.markers and axis in ("x", "y", "z"):
                return RodReading(marker=marker, axis=axis)
        return None

    @property
    def is_in_time(self) -> bool:
        """Whether samples of a run follow each other in time."""
        return self.samples == "time"

    @property
    def between_samples(self) -> Between:
        """What commands do between samples; each pose has its own."""
        return "straight" if self.is_in_time else "held"

    def quantities(self) -> dict[str, Quantity]:
        """All imperfectly known numbers, by name of their base parameter."""
        found = quantities_of(self.material) | quantities_of(self.base, "base_")
        for tendon in self.tendons:
            found |= quantities_of(tendon, f"{tendon.name}_")
        for load in self.masses:
            found |= quantities_of(load, f"{load.name}_")
        for name, marker in self.markers.items():
            found |= quantities_of(marker, f"{name}_")
        return found
