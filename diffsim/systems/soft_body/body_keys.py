"""All keys of ``model: {system: soft_body}``."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from diffsim.causes.channel_groups import CLOCKS, clock_of
from diffsim.core.check import did_you_mean
from diffsim.core.schema_numbers import Meters
from diffsim.systems.description import Description, Quantity, quantities_of
from diffsim.systems.quantities import Time
from diffsim.systems.soft_body.keys import (
    Chamber,
    Clamp,
    DescribedMuscle,
    DescribedTendon,
    Drive,
    Gravity,
    Load,
    Material,
    MaterialRegion,
    Numerics,
    Start,
    Stop,
    Support,
    Vibration,
    Wall,
    Water,
)
from diffsim.systems.soft_body.places import Region
from diffsim.systems.soft_body.readings import Camera, Clock, MarkerPlace, Reading
from diffsim.systems.soft_body.shape_keys import BodyShape


class SoftBodyKeys(Description):
    """A body of soft material with what holds, pulls, loads and surrounds it."""

    system: Literal["soft_body"] = Field(description="Kind of system")
    body: BodyShape = Field(description="Shape of the body at rest, and where it is")
    material: Material = Field(description="Material of the body")
    regions: tuple[MaterialRegion, ...] = Field((), description="Parts of another material")
    fixed: tuple[Clamp, ...] = Field((), description="Clamps and planes of symmetry")
    gravity: Gravity = Field(Gravity(), description="Gravity; down along z by default")
    masses: tuple[Load, ...] = Field((), description="Masses that are attached, weights that hang")
    tendons: tuple[DescribedTendon, ...] = Field((), description="Cables that pull")
    muscles: tuple[DescribedMuscle, ...] = Field((), description="Parts that contract")
    chambers: tuple[Chamber, ...] = Field((), description="Cavities under pressure")
    water: Water | None = Field(None, description="A fluid around the body")
    walls: tuple[Wall, ...] = Field((), description="Flat obstacles")
    stops: tuple[Stop, ...] = Field(
        (), max_length=1, description="A stop that may be in the way: cause one_sided_stop"
    )
    sliding: Region | None = Field(
        None, description="Nodes that rub, on a rail say: dry friction acts there; default: all"
    )
    support: Support | None = Field(
        None, description="Recorded motion of what holds the body: cause support_motion"
    )
    vibration: Vibration | None = Field(
        None, description="A base that may shake unrecorded: cause base_vibration"
    )
    slack_string: Meters | None = Field(
        None,
        description="Attached masses may hang slack at first and be caught after a fall of about "
        "this height [m]: cause slack_string",
    )
    markers: dict[str, MarkerPlace] = Field(description="Points that are watched, by name")
    channels: dict[str, Reading] = Field(description="What each channel of the study shows")
    camera: Camera = Field(Camera(), description="What all channels share")
    clock: Clock = Field(Clock(), description="Clock of the recording against that of the commands")
    clocks: dict[str, Time] = Field({}, description=CLOCKS)
    start: Start = Field(Start(), description="How the body begins")
    numerics: Numerics = Field(Numerics(), description="Time step, mesh and tolerance")

    @model_validator(mode="after")
    def _check_markers_exist(self) -> SoftBodyKeys:
        for name, reading in self.channels.items():
            for marker in (*reading.markers, *reading.minus):
                if marker not in self.markers:
                    raise ValueError(
                        f"channels.{name}: no marker {marker!r}"
                        f"{did_you_mean(marker, self.markers)}; known: {', '.join(self.markers)}"
                    )
        return self

    @property
    def commands(self) -> tuple[str, ...]:
        """Names of the commands that drive something."""
        drives = (*self.tendons, *self.muscles, *self.chambers)
        return tuple(dict.fromkeys(d.command for d in drives))

    def quantities(self) -> dict[str, Quantity]:
        """All imperfectly known numbers, by name of their base parameter."""
        found = quantities_of(self.material) | quantities_of(self.gravity, "gravity_")
        for region in self.regions:
            own = quantities_of(region)
            found |= {f"{key}_{region.name}": q for key, q in own.items()}
        named: tuple[Load | Drive, ...] = (
            *self.masses, *self.tendons, *self.muscles, *self.chambers
        )  # fmt: skip
        for part in named:
            found |= quantities_of(part, f"{part.name}_")
        if self.water is not None:
            found |= quantities_of(self.water, "water_")
        found |= quantities_of(self.start, "start_") | quantities_of(self.clock, "clock_")
        found |= quantities_of(self.camera, "camera_")
        found |= {clock_of(name): q for name, q in self.clocks.items()}
        for name, reading in self.channels.items():
            found |= {f"{key}_{name}": q for key, q in quantities_of(reading).items()}
        return found
