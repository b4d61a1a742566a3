"""What carries: carbon rods, plates, boxes. Frames are NED, up is -z."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from diffsim.copter.vehicle.geometry import (
    UP,
    LinearMesh,
    box,
    circle_loop,
    fan_prism,
    fixed_points,
    ring_prism,
    scaled_points,
)
from diffsim.copter.vehicle.parts.part import Parameter, Part, density_of, linear_center
from diffsim.copter.vehicle.patches import Patch, Slide
from diffsim.core.arrays import Array
from diffsim.core.check import require_number

if TYPE_CHECKING:
    from diffsim.core.schema_numbers import Meters

X, Y, DOWN = np.eye(3)
END_INSET = 0.02  # half the length of a round connector: it ends where the rod ends [m]
DENSITY_CARBON = 1638.9  # [kg/m^3]
DENSITY_ACRYLIC = 1180.0


def rod(
    length: Meters = 0.5, outer_diameter: Meters = 0.0146, inner_diameter: Meters = 0.0127
) -> Part:
    """A carbon tube along x, cut to length.

    Args:
        length: [m], a parameter.
        outer_diameter, inner_diameter: [m].
    """
    if not 0.0 < inner_diameter < outer_diameter:
        raise ValueError(
            f"inner_diameter must lie between 0 and outer_diameter = {outer_diameter:g} m, got "
            f"{inner_diameter:g} m"
        )
    vertices, faces = ring_prism(circle_loop(outer_diameter / 2), circle_loop(inner_diameter / 2))
    return rod_of_mesh(
        LinearMesh(scaled_points(vertices, [0]), faces),
        length,
        outer_diameter / 2,
        DENSITY_CARBON,
        {"outer_diameter": outer_diameter, "inner_diameter": inner_diameter},
    )


def rod_of_mesh(
    mesh: LinearMesh,
    length: float,
    radius: float,
    density: float,
    options: Mapping[str, object],
    kind: str = "rod",
    lower: float = 0.05,
    upper: float = 5.0,
) -> Part:
    """A rod of any cross-section along x whose length is the only parameter."""
    patches = {
        "shaft": Patch(
            "circular",
            "rod",
            fixed_points([0.0, 0.0, 0.0], 1),
            X,
            UP,
            radius,
            (Slide(X, 0.0, np.array([0.5])),),
            slides_by_default=True,
        )
    }
    for name, sign in (("start", -1.0), ("end", 1.0)):
        center = linear_center(-sign * END_INSET * X, sign * 0.5 * X[:, None])
        patches[name] = Patch("circular", "rod", center, X, UP, radius)
    return Part(
        kind,
        mesh,
        density,
        patches,
        (Parameter("length", length, lower, upper, "length of the rod"),),
        price_per_parameter=(30.0,),
        source="cut",
        rod_parameter=0,
        options=options,
    )


def plate(length: Meters = 0.15, width: Meters = 0.15, thickness: Meters = 0.0024) -> Part:
    """A rectangular plate: length along x, width along y are parameters [m]."""
    vertices, faces = box([1.0, 1.0, thickness])
    parameters = (
        Parameter("length", length, 0.02, 1.0, "along x"),
        Parameter("width", width, 0.02, 1.0, "along y"),
    )
    mesh = LinearMesh(scaled_points(vertices, [0, 1]), faces)
    return Part(
        "plate",
        mesh,
        DENSITY_ACRYLIC,
        _plate_faces(thickness, np.array([[0.5, 0.0], [0.0, 0.5]])),
        parameters,
        price=4.0,
        source="cut",
        options={"thickness": thickness},
    )


def circular_plate(diameter: Meters = 0.15, thickness: Meters = 0.0024) -> Part:
    """A round plate; the diameter is a parameter [m]."""
    vertices, faces = fan_prism(circle_loop(0.5), thickness)
    points = scaled_points(vertices, [0])
    points.basis[:, 1, 0] = vertices[:, 1]
    points.offset[:, 1] = 0.0
    inscribed = np.full((2, 1), 0.5 / np.sqrt(2.0))  # connections stay in the square inside
    return Part(
        "circular_plate",
        LinearMesh(points, faces),
        DENSITY_ACRYLIC,
        _plate_faces(thickness, inscribed),
        (Parameter("diameter", diameter, 0.02, 1.0, "of the plate"),),
        price=4.0,
        source="cut",
        options={"thickness": thickness},
    )


def _plate_faces(thickness: float, half_extents: Array) -> dict[str, Patch]:
    slides = tuple(Slide(axis, 0.0, row) for axis, row in zip((X, Y), half_extents, strict=True))
    num_parameters = half_extents.shape[1]
    return {
        name: Patch(
            "flat",
            "plate",
            fixed_points(0.5 * thickness * normal, num_parameters),
            normal,
            X,
            slides=slides,
        )
        for name, normal in (("top", UP), ("bottom", DOWN))
    }


def box_part(kind: str, size: Sequence[float], mass: float, price: float) -> Part:
    """A cuboid of constant size, strapped on by top or bottom: battery, electronics, payload."""
    if len(size) != 3:
        raise ValueError(f"size of a {kind} must be 3 lengths, got {list(size)}")
    for axis, value in zip("xyz", size, strict=True):
        require_number(f"size of a {kind} along {axis}", value, above=0.0)
    vertices, faces = box(size)
    mesh = LinearMesh(fixed_points(vertices), faces)
    half = 0.5 * np.asarray(size, dtype=np.float64)
    patches = {
        name: Patch("flat", "strap", fixed_points(half * normal), normal, X)
        for name, normal in (("top", UP), ("bottom", DOWN))
    }
    return Part(
        kind,
        mesh,
        density_of(mesh, mass),
        patches,
        price=price,
        options={"size": [float(v) for v in size], "mass": mass},
    )
