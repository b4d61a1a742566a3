"""Keys of a mission file."""

from __future__ import annotations

from typing import Any

from pydantic import Field, model_validator

from diffsim.core.schema import FinitePart
from diffsim.core.schema_numbers import (
    Degrees,
    DegreesPerSecond,
    Meters,
    MetersPerSecond,
    Seconds,
)


class TakeOff(FinitePart):
    """Straight up from the ground."""

    height: Meters = Field(gt=0, description="Above the ground [m]")
    speed: MetersPerSecond = Field(0.8, gt=0, description="Greatest on the way [m/s]")


class Hover(FinitePart):
    """Stay."""

    seconds: Seconds = Field(gt=0, description="How long [s]")


class FlyTo(FinitePart):
    """Straight to a place; what is left out stays."""

    north: Meters | None = Field(None, description="From the start [m]")
    east: Meters | None = Field(None, description="From the start [m]")
    height: Meters | None = Field(None, gt=0, description="Above the ground [m]")
    speed: MetersPerSecond = Field(1.5, gt=0, description="Greatest on the way [m/s]")


class Yaw(FinitePart):
    """Turn on the spot, the short way round."""

    degrees: Degrees = Field(description="Heading from north, clockwise seen from above [deg]")
    rate: DegreesPerSecond = Field(45.0, gt=0, description="Greatest on the way [deg/s]")


class Land(FinitePart):
    """Straight down to the ground, where the motors stand."""

    speed: MetersPerSecond = Field(0.5, gt=0, description="Greatest on the way [m/s]")


class Step(FinitePart):
    """One step: exactly one of these."""

    take_off: TakeOff | None = Field(None, description="From the ground")
    hover: Hover | None = Field(None, description="Stay")
    fly_to: FlyTo | None = Field(None, description="To a place")
    yaw: Yaw | None = Field(None, description="To a heading")
    land: Land | None = Field(None, description="To the ground")

    @model_validator(mode="before")
    @classmethod
    def _without_values(cls, given: Any) -> Any:
        """``land`` or ``land:`` for ``land: {}``."""
        given = {given: None} if isinstance(given, str) else given
        if not isinstance(given, dict) or len(given) != 1:
            names = ", ".join(cls.model_fields)
            raise ValueError(f"a step is one of {names}, with its values")
        return {name: {} if values is None else values for name, values in given.items()}

    @property
    def said(self) -> tuple[str, FinitePart]:
        """Name and values of the step."""
        (name,) = self.model_fields_set
        keys: FinitePart = getattr(self, name)
        return name, keys


class MissionKeys(FinitePart):
    """A mission."""

    name: str | None = Field(None, description="Default: the name of the file")
    steps: tuple[Step, ...] = Field(min_length=1, description="One after the other")
