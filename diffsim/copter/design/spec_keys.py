"""Keys of a design file; those of a part depend on its kind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, StrictBool

from diffsim.copter.vehicle.option_keys import option_keys
from diffsim.copter.vehicle.parts.database import PART_KINDS
from diffsim.core.check import require_choice
from diffsim.core.inside import require_file_name
from diffsim.core.schema import FinitePart
from diffsim.core.schema_numbers import Degrees, Meters, Ratio


def _require_order(interval: tuple[float, float]) -> tuple[float, float]:
    lower, upper = interval
    if not lower <= upper:
        raise ValueError(f"must be [lower, upper], got [{lower:g}, {upper:g}]")
    return interval


Interval = Annotated[tuple[Meters, Meters], AfterValidator(_require_order)]
Place = Annotated[
    tuple[Meters, ...],
    BeforeValidator(lambda given: [given] if isinstance(given, (int, float, str)) else given),
]


class PartKeys(FinitePart):
    """What every part may say; its kind adds its options."""

    kind: str = Field(description="Kind of the part in the database")
    bounds: dict[str, Interval] = Field({}, description="Of parameters, narrower than usual [m]")
    rotation: tuple[Degrees, Degrees, Degrees] | None = Field(
        None, description="Roll, pitch, yaw [deg]: R = Rz Ry Rx"
    )
    place: tuple[Meters, Meters, Meters] | None = Field(None, description="Of its origin [m]")
    anchored: StrictBool = Field(False, description="Whether it stays at its place")
    direction: tuple[Ratio, Ratio, Ratio] | None = Field(
        None, description="Direction of a motor's thrust"
    )
    propeller: StrictBool = Field(True, description="Whether a motor carries a propeller")


def _keys_of_kind(given: Any) -> PartKeys:
    if not isinstance(given, Mapping):
        raise ValueError(f"must map names to values, got {type(given).__name__}")
    if "kind" not in given:
        raise ValueError("kind is missing; say which part of the database this is")
    kind = require_choice("kind", str(given["kind"]), PART_KINDS)
    # what is wrong in there keeps its path, as pydantic adds the errors to its own
    return option_keys(PART_KINDS[kind], PartKeys).model_validate(given)  # type: ignore[return-value]


class ConnectionKeys(FinitePart):
    """Two patches that belong together; see ``diffsim.copter.design.spec.Connection``."""

    host: str = Field(description="Written as part.patch")
    guest: str = Field(description="Written as part.patch")
    at: Place | None = Field(None, description="Place on the host's patch [m]")
    guest_at: Place | None = Field(None, description="Place on the guest's patch [m]")
    angle: Degrees = Field(0.0, description="Turn about the host's flat patch [deg]")
    roll: Degrees = Field(0.0, description="Turn about the host's round patch [deg]")
    slide: StrictBool | None = Field(None, description="Whether the place is free")
    adapters: tuple[str, ...] | None = Field(None, description="Kinds to insert; [] for none")


class DesignKeys(FinitePart):
    """A whole design."""

    name: Annotated[str, AfterValidator(lambda given: require_file_name("name", given))] | None = (
        Field(None, description="Default: the name of the file")
    )
    notes: str = Field("", description="Where the numbers come from")
    parts: dict[str, Annotated[Any, BeforeValidator(_keys_of_kind)]] = Field(
        description="Parts by name, in the order in which they join"
    )
    connections: tuple[ConnectionKeys, ...] | None = Field(None, description="In their order")
    rigid: tuple[tuple[str, str], ...] | None = Field(
        None, description="Pairs of parts that keep their distance vector"
    )
    constraints: tuple[str, ...] | None = Field(None, description="Linear: ==, <= or >=")
    values: dict[str, Meters] = Field({}, description="Parameters, before those of the parts [m]")
