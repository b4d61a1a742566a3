"""Keys of a vehicle file: a multicopter by mass, inertia and rotors, without its parts."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field, field_validator, model_validator

from diffsim.core.inertia import entries_of_matrix
from diffsim.core.schema import FinitePart
from diffsim.core.schema_numbers import (
    Kilograms,
    Meters,
    MilliampHours,
    Newtons,
    Ohms,
    RadiansPerSecond,
    Seconds,
)
from diffsim.core.schema_paths import PathInside

Point = tuple[Meters, Meters, Meters]


class RotorFacts(FinitePart):
    """What is known of a rotor: a shipped model, or its own numbers."""

    model: str | None = Field(
        None, description="Name of a shipped rotor; in place of all keys below but time_constant"
    )
    radius: Meters | None = Field(None, gt=0, description="Radius of the propeller [m]")
    max_thrust: Newtons | None = Field(
        None, gt=0, description="Thrust at full signal and nominal voltage [N]"
    )
    torque_ratio: Meters | None = Field(None, gt=0, description="Reaction torque over thrust [m]")
    thrust_exponent: float = Field(2.0, gt=0, description="Power of the speed in the thrust")
    max_speed: RadiansPerSecond | None = Field(
        None,
        gt=0,
        description="Speed at full signal [rad/s]; default: that of a usual propeller of this size",
    )
    time_constant: Seconds | None = Field(
        None, gt=0, description="Lag of the thrust behind the signal [s]; default 0.03, assumed"
    )

    @model_validator(mode="after")
    def _whole(self) -> RotorFacts:
        own = ("radius", "max_thrust", "torque_ratio")
        missing = [name for name in own if getattr(self, name) is None]
        if self.model is None and missing:
            raise ValueError(f"without model, {', '.join(missing)} must be given")
        given = [name for name in (*own, "max_speed") if getattr(self, name) is not None]
        if self.model is not None and given:
            raise ValueError(f"model gives {', '.join(given)}; leave these keys out")
        return self


class RotorPlace(FinitePart):
    """Where a rotor is and how it turns."""

    at: Point | None = Field(
        None, description="Center of the propeller, in the frame of center_of_mass [m]"
    )
    body: str | None = Field(
        None, description="In place of at: name of a link, body or site of the file of `body_file`"
    )
    spin: Literal["cw", "ccw"] = Field(
        description="Sense of rotation seen against its thrust (from above, if upright)"
    )
    axis: tuple[float, float, float] | None = Field(
        None, description="Direction of the thrust; default: up"
    )
    rotor: RotorFacts | None = Field(None, description="Of its own; default: that of the file")

    one_of: ClassVar = ("at", "body")


class BatteryFacts(FinitePart):
    """A lithium-polymer pack."""

    cells: int = Field(ge=1, description="Cells in series")
    capacity: MilliampHours = Field(gt=0, description="Capacity [mA h]")
    resistance: Ohms | None = Field(
        None, ge=0, description="Of the whole pack [ohm]; default 0.012 per cell"
    )


class VehicleFile(FinitePart):
    """A multicopter by its numbers."""

    name: str | None = Field(None, description="Default: the name of the file")
    body: Literal["FRD", "FLU"] = Field(
        description="Axes of all places: FRD (forward, right, down) or FLU (forward, left, up)"
    )
    mass: Kilograms | None = Field(None, gt=0, description="Mass with the battery [kg]")
    inertia: tuple[float, ...] | None = Field(
        None,
        description="[xx, yy, zz], [xx, yy, zz, xy, xz, yz] or three rows of three, about the "
        "center of mass [kg m^2]",
    )
    center_of_mass: Point | None = Field(
        None, description="In the frame that rotors are placed in; default: its origin [m]"
    )
    body_file: PathInside | None = Field(
        None,
        description="URDF, MJCF or SDF beside this file: mass, inertia and center of mass (FLU)",
    )
    rotors: tuple[RotorPlace, ...] = Field(min_length=1, description="One entry per rotor")
    rotor: RotorFacts | None = Field(None, description="Of all rotors that have none of their own")
    battery: BatteryFacts | None = Field(
        None, description="Default: three cells of 2200 mA h (for a flight in closed loop only)"
    )

    @field_validator("inertia", mode="before")
    @classmethod
    def _read_matrix(cls, given: Any) -> Any:
        return entries_of_matrix(given)

    @field_validator("inertia")
    @classmethod
    def _entries(cls, given: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if given is not None and len(given) not in (3, 6):
            raise ValueError(
                f"needs 3 numbers (xx, yy, zz) or 6 (xx, yy, zz, xy, xz, yz), got {len(given)}"
            )
        return given

    @model_validator(mode="after")
    def _whole(self) -> VehicleFile:
        masses = ("mass", "inertia")
        if self.body_file is None:
            missing = [name for name in masses if getattr(self, name) is None]
            if missing:
                raise ValueError(f"without body_file, {', '.join(missing)} must be given")
            named = [r.body for r in self.rotors if r.body is not None]
            if named:
                raise ValueError(f"rotors: body {named[0]!r} needs body_file; or give at")
        else:
            given = [n for n in (*masses, "center_of_mass") if getattr(self, n) is not None]
            if given:
                raise ValueError(f"body_file gives {', '.join(given)}; leave these keys out")
            if self.body != "FLU":
                raise ValueError("body must be FLU where body_file is given (URDF, MJCF, SDF)")
        if self.rotor is None and any(r.rotor is None for r in self.rotors):
            raise ValueError("give rotor (model, or radius, max_thrust, torque_ratio)")
        return self
