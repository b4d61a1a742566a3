"""Parts with a rotation, and their points as linear functions of all parameters of a design."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from diffsim.copter.design.constraints import Constraint
from diffsim.copter.vehicle.geometry import LinearPoints
from diffsim.copter.vehicle.parts.part import Part
from diffsim.copter.vehicle.patches import Patch, Slide
from diffsim.core.arrays import Array
from diffsim.core.check import require_choice

AXES = "xyz"


@dataclass(frozen=True)
class LinearForm:
    """sum of coefficient * parameter + constant."""

    coefficients: Mapping[str, float]
    constant: float = 0.0

    def __add__(self, other: LinearForm) -> LinearForm:
        merged = dict(self.coefficients)
        for name, value in other.coefficients.items():
            merged[name] = merged.get(name, 0.0) + value
        return LinearForm(merged, self.constant + other.constant)

    def __rmul__(self, factor: float) -> LinearForm:
        scaled = {name: factor * value for name, value in self.coefficients.items()}
        return LinearForm(scaled, factor * self.constant)

    def __sub__(self, other: LinearForm) -> LinearForm:
        return self + -1.0 * other

    def equals(self, value: float, label: str) -> Constraint:
        """form == value."""
        return Constraint(label, _nonzero(self.coefficients), value - self.constant, "==")

    def at_most(self, other: LinearForm, label: str) -> Constraint:
        """form <= other."""
        difference = self - other
        return Constraint(label, _nonzero(difference.coefficients), -difference.constant, "<=")


def _nonzero(coefficients: Mapping[str, float]) -> dict[str, float]:
    return {name: value for name, value in coefficients.items() if abs(value) > 1e-12}


@dataclass(frozen=True, eq=False)
class PlacedPart:
    """A part in a design."""

    name: str
    part: Part  # the part, from the database
    rotation: Array = field(repr=False)  # design frame from part frame, (3, 3)
    automatic: bool = False  # inserted by a rule, not by the author

    @property
    def shape_names(self) -> tuple[str, ...]:
        """Full names of the shape parameters."""
        return tuple(f"{self.name}.{p.name}" for p in self.part.parameters)

    @property
    def position_names(self) -> tuple[str, ...]:
        """Full names of the origin's coordinates."""
        return tuple(f"{self.name}.{axis}" for axis in AXES)

    def patch(self, name: str) -> Patch:
        """A patch by name."""
        return self.part.patches[require_choice(f"patch of {self.name}", name, self.part.patches)]

    def coordinate(self, point: LinearPoints, direction: Array) -> LinearForm:
        """Coordinate of a point of the part along a direction of the design's frame [m]."""
        local = self.rotation.T @ direction
        shape = dict(zip(self.shape_names, local @ point.basis, strict=True))
        position = dict(zip(self.position_names, direction, strict=True))
        return LinearForm(shape | position, float(local @ point.offset))

    def half_extent(self, slide: Slide) -> LinearForm:
        """How far a connection may slide [m]."""
        coefficients = dict(zip(self.shape_names, slide.half_extent_basis, strict=True))
        return LinearForm(coefficients, slide.half_extent)


def distance_weights(parts: Sequence[PlacedPart]) -> Array:
    """Which parameters count as distance: all but the places of what rules inserted."""
    return np.array(
        [w for p in parts for w in [1.0] * len(p.shape_names) + [float(not p.automatic)] * 3]
    )
