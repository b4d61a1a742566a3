"""Channels of a described soft body: markers on it, read by cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import (
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)
from torch import Tensor

from diffsim.core.arrays import Array
from diffsim.core.rotation import matrix_from_rotation_vector
from diffsim.core.schema import Names, Part, standing_alone
from diffsim.systems.description import Quantity, quantity_in
from diffsim.systems.quantities import Angle, Plain, Time
from diffsim.systems.soft_body.places import AnyMesh, Point, Region, carried_weights, point_weights

AXES: dict[str, tuple[float, float, float]] = {
    "x": (1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
}


class Marker(Part):
    """A point that moves with the body; a list of three numbers is its place."""

    at: Point = Field(description="Its place while the body is at rest [m]")
    carried_by: Region | None = Field(
        None, description="Nodes that carry it, of a marker on a stub; default: the cell around it"
    )


#: A marker, or its place alone.
MarkerPlace = Annotated[Marker, standing_alone("at", list, tuple)]


class Reading(Part):
    """What one channel of the study shows."""

    markers: Names = Field(description="One marker, or several: their mean, or what they turn with")
    minus: Names = Field((), description="Markers whose mean is taken off")
    axis: Literal["x", "y", "z"] | tuple[float, float, float] | None = Field(
        None, description="Direction of the displacement that is read"
    )
    about: Literal["x", "y", "z"] | None = Field(
        None, description="Instead of `axis`: the rotation of the markers about it [rad]"
    )
    zero: Quantity = Field(
        Quantity(value=0.0), description="What it reads at no displacement [m], or rotation [rad]"
    )
    scale: Plain = Field(Quantity(value=1.0), description="Factor on what it reads")

    @field_validator("zero", mode="before")
    @classmethod
    def _check_unit(cls, given: Any, info: ValidationInfo) -> Any:
        unit = "m" if info.data.get("about") is None else "rad"
        return quantity_in(unit).read(given)

    @model_validator(mode="after")
    def _check_one_motion(self) -> Reading:
        if (self.axis is None) == (self.about is None):
            raise ValueError("give axis, the direction of a displacement, or about, of a rotation")
        return self


class Camera(Part):
    """What all channels share."""

    relative_to: Literal["rest", "first", "place"] = Field(
        "rest",
        description="`rest`: displacement from the unstrained shape; `first`: from the mean of the "
        "first samples; `place`: where the markers are",
    )
    first_samples: int = Field(1, ge=1, description="For first: how many samples")
    scale: Plain = Field(Quantity(value=1.0), description="Factor on all lengths that are read")
    roll: Angle = Field(
        Quantity(value=0.0), description="Its axes are turned about x by this [rad]"
    )
    pitch: Angle = Field(
        Quantity(value=0.0), description="Its axes are turned about y by this [rad]"
    )
    yaw: Angle = Field(Quantity(value=0.0), description="Its axes are turned about z by this [rad]")


class Clock(Part):
    """Clock of the recording against that of the commands and of the start."""

    offset: Time = Field(
        Quantity(value=0.0), description="What the record shows at t happened at t - offset [s]"
    )
    rate: Plain = Field(Quantity(value=1.0), description="True seconds per second of the record")


@dataclass(frozen=True, eq=False)
class Look:
    """Markers on one mesh, and channels as linear functions of their places."""

    markers: tuple[str, ...]  # names of the markers
    nodes: Tensor  # (n,) nodes that carry markers
    weights: Tensor  # (num_markers, n) place of each marker by the places of the nodes
    rest: Tensor  # (3 num_markers,) places at rest [m]
    rows: Tensor  # (num_channels, 3 num_markers) of the channels
    turns: Tensor  # (num_channels,) which channels show rotations

    def places(self, x: Tensor) -> Tensor:
        """Places of all markers in a row, (..., 3 num_markers), of nodes (..., V, 3)."""
        return (self.weights @ x[..., self.nodes, :]).flatten(-2)

    def shares(self, num_nodes: int) -> dict[str, Tensor]:
        """Each marker's displacement along each axis, (num_nodes, 3) of the nodes', by "tip.z"."""
        found = {}
        for name, weights in zip(self.markers, self.weights, strict=True):
            for k, axis in enumerate("xyz"):
                own = torch.zeros(num_nodes, 3, dtype=torch.float64)
                own[self.nodes, k] = weights
                found[f"{name}.{axis}"] = own
        return found


def look_of(
    mesh: AnyMesh, markers: Mapping[str, Marker], readings: Sequence[tuple[str, Reading]]
) -> Look:
    """Markers that the channels use, and how.

    Args:
        readings: Names and readings of the channels, in the order of the study.

    Raises:
        ValueError: a marker is outside of the body or there is none of that name; the message
            begins with the key.
    """
    used = list(dict.fromkeys(m for _, r in readings for m in (*r.markers, *r.minus)))
    index = {name: k for k, name in enumerate(used)}
    dense = np.zeros((len(used), mesh.num_nodes))
    places = np.array([markers[name].at for name in used])
    for k, name in enumerate(used):
        marker = markers[name]
        try:
            if marker.carried_by is None:
                nodes, own = point_weights(mesh, places[k])
            else:
                nodes = marker.carried_by.nodes(mesh).numpy()
                own = carried_weights(mesh.x_rest[nodes].numpy(), places[k : k + 1])[0]
        except ValueError as error:
            raise ValueError(f"markers.{name}: {error}") from None
        np.add.at(dense[k], nodes, own)
    nodes = np.flatnonzero((dense != 0.0).any(0))
    weights = dense[:, nodes]
    at_rest = weights @ mesh.x_rest.numpy()[nodes]
    rows = [_make_row(reading, index, at_rest) for _, reading in readings]
    return Look(
        tuple(used),
        torch.from_numpy(nodes),
        torch.from_numpy(weights),
        torch.from_numpy(at_rest.reshape(-1)),
        torch.from_numpy(np.array(rows)),
        torch.tensor([r.about is not None for _, r in readings], dtype=torch.bool),
    )


def _make_row(reading: Reading, index: Mapping[str, int], places: Array) -> Array:
    """(3 num_markers,) of one channel."""
    row = np.zeros_like(places)
    if reading.about is not None:
        own = [index[m] for m in reading.markers]
        lever = np.cross(AXES[reading.about], places[own] - places[own].mean(0))
        row[own] = lever / (lever * lever).sum()
        return row.reshape(-1)
    axis = AXES[reading.axis] if isinstance(reading.axis, str) else reading.axis
    for sign, names in ((1.0, reading.markers), (-1.0, reading.minus)):
        for name in names:
            row[index[name]] += sign * np.array(axis) / len(names)
    return row.reshape(-1)


def main_axis(reading: Reading) -> int:
    """Axis of space, 0, 1 or 2, that a channel shows most of."""
    if reading.about is not None:
        return "xyz".index(reading.about)
    axis = AXES[reading.axis] if isinstance(reading.axis, str) else reading.axis
    return int(np.abs(np.array(axis)).argmax())


def seen(look: Look, camera: Camera, values: Mapping[str, Tensor], channels: Sequence[str]) -> Any:
    """Function of places (num_samples, 3 num_markers) and times that gives the channels.

    Args:
        camera: What displacements count from.
        values: Quantities of the run: ``camera_...``, and ``zero_`` and ``scale_`` of channels.
    """
    turn = torch.stack([values[f"camera_{n}"] for n in ("roll", "pitch", "yaw")])
    rotation = matrix_from_rotation_vector(turn)
    # of bodies that nobody watches, such as a task's, there are none
    none = torch.zeros(0, dtype=torch.float64)
    zero = torch.stack([values[f"zero_{c}"] for c in channels]) if channels else none
    scale = torch.stack([values[f"scale_{c}"] for c in channels]) if channels else none
    scale = scale * torch.where(look.turns, torch.ones_like(scale), values["camera_scale"])

    def channels_of(places: Tensor, times: Tensor) -> Tensor:
        moved = places
        if camera.relative_to == "rest":
            moved = places - look.rest
        elif camera.relative_to == "first":
            moved = places - places[: camera.first_samples].mean(0)
        # components along axes that are turned: each row is R' u
        points = moved.reshape(len(moved), -1, 3) @ rotation
        return (points.flatten(1) @ look.rows.T) * scale + zero

    return channels_of
