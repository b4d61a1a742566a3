"""Printed frames: an X of arms, any outline, any closed mesh. Frames are NED, up is -z."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from diffsim.copter.vehicle.geometry import (
    UP,
    LinearMesh,
    LinearPoints,
    fan_prism,
    fixed_points,
    scaled_points,
)
from diffsim.copter.vehicle.parts.part import Parameter, Part, linear_center
from diffsim.copter.vehicle.patches import Patch
from diffsim.mesh.closed_surface import closed_surface

if TYPE_CHECKING:
    from diffsim.core.schema_numbers import KilogramsPerCubicMeter, Meters, Ratio

X, Y, DOWN = np.eye(3)
DENSITY_PRINT = 1050.0  # [kg/m^3]


def x_frame(
    half_length: Meters = 0.16,
    half_width: Meters = 0.16,
    thickness: Meters = 0.008,
    arm_width: Meters = 0.03,
    hub: Meters = 0.035,
) -> Part:
    """A printed X of four arms; motor pads keep their size while the arms stretch.

    Args:
        half_length, half_width: Half sides of the rectangle of the motors, along x and y [m];
            parameters.
        thickness, arm_width: [m].
        hub: Half the width of the middle [m].
    """
    pad = 0.5 * arm_width
    across = pad * np.sqrt(2.0)
    outline, pulls = [], []
    for sx, sy in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        # three corners of the pad, counterclockwise, then the notch between two arms
        near_x, near_y = (sx * across, 0.0), (0.0, sy * across)
        far = (sx * pad, sy * pad)
        ordered = [near_x, far, near_y] if sx * sy > 0 else [near_y, far, near_x]
        outline += ordered
        pulls += [(sx, sy)] * 3
        outline.append((0.0, sy * hub) if sx == sy else (sx * hub, 0.0))
        pulls.append((0, 0))
    signs = np.array(pulls, dtype=np.float64)
    flat, faces = fan_prism(
        np.array(outline) + signs * [half_length, half_width], thickness
    )  # refuses proportions whose arms do not fit
    n = len(signs)
    basis = np.zeros((2 * n + 2, 3, 2))
    for level in range(2):
        basis[level * n : (level + 1) * n, 0, 0] = signs[:, 0]
        basis[level * n : (level + 1) * n, 1, 1] = signs[:, 1]
    values = np.array([half_length, half_width])
    points = LinearPoints(flat - basis @ values, basis)
    patches = {}
    for name, (sx, sy) in zip(
        ("front_right", "rear_right", "rear_left", "front_left"),
        ((1, 1), (-1, 1), (-1, -1), (1, -1)),
        strict=True,
    ):
        center = linear_center(0.5 * thickness * UP, np.array([[sx, 0.0], [0.0, sy], [0.0, 0.0]]))
        patches[name] = Patch("flat", "plate", center, UP, X)
    patches |= _middle(thickness, 2)
    return Part(
        "x_frame",
        LinearMesh(points, faces),
        DENSITY_PRINT,
        patches,
        (
            Parameter("half_length", half_length, 2.5 * hub, 0.5, "motors' rectangle along x"),
            Parameter("half_width", half_width, 2.5 * hub, 0.5, "motors' rectangle along y"),
        ),
        price_per_mass=60.0,
        source="printed",
        options={"thickness": thickness, "arm_width": arm_width, "hub": hub},
    )


def outline_frame(
    outline: Sequence[Sequence[Ratio]],
    mounts: Mapping[str, Sequence[Ratio]],
    length: Meters = 0.4,
    width: Meters = 0.4,
    thickness: Meters = 0.006,
) -> Part:
    """A printed plate of any star-shaped outline, stretched along x and y.

    Args:
        outline: Corners around (0, 0) per meter of length and width, counterclockwise seen from
            below (x forward, y right), (n, 2) [-].
        mounts: Places on top where other parts fit, name to (x, y), as the outline [-].
        length, width: What outline and mounts are scaled by along x and y [m]; parameters.
        thickness: Thickness [m].
    """
    vertices, faces = fan_prism(np.asarray(outline, dtype=np.float64), thickness)
    patches = {}
    for name, place in mounts.items():
        x, y = (float(v) for v in place)
        center = linear_center(0.5 * thickness * UP, np.array([[x, 0.0], [0.0, y], [0.0, 0.0]]))
        patches[name] = Patch("flat", "plate", center, UP, X)
    return Part(
        "outline_frame",
        LinearMesh(scaled_points(vertices, [0, 1]), faces),
        DENSITY_PRINT,
        patches | _middle(thickness, 2),
        (
            Parameter("length", length, 0.1, 1.5, "scale along x"),
            Parameter("width", width, 0.1, 1.5, "scale along y"),
        ),
        price_per_mass=60.0,
        source="printed",
        options={
            "outline": [list(map(float, p)) for p in outline],
            "mounts": {k: list(map(float, v)) for k, v in mounts.items()},
            "thickness": thickness,
        },
    )


def _middle(thickness: float, num_parameters: int) -> dict[str, Patch]:
    """Top and bottom at the origin of a frame."""
    return {
        name: Patch("flat", "plate", fixed_points(0.5 * thickness * n, num_parameters), n, X)
        for name, n in (("top", UP), ("bottom", DOWN))
    }


def mesh_frame(
    file: str | Path,
    mounts: Mapping[str, Mapping[Literal["center", "normal"], Sequence[float]]],
    scale_x: Ratio = 1.0,
    scale_y: Ratio = 1.0,
    scale_z: Ratio = 1.0,
    density: KilogramsPerCubicMeter = DENSITY_PRINT,
) -> Part:
    """A free-form frame from a closed surface file, stretched along its axes.

    Args:
        file: .stl, .obj, .ply, .off or .glb in meters, frame NED.
        mounts: Flat patches, name to ``center`` [m] at scale 1 and outward ``normal``, which must
            be along an axis: any other turns as the frame is stretched, which is not linear.
        scale_x, scale_y, scale_z: Parameters [-].
        density: Density [kg/m^3].

    Raises:
        MeshError: not closed.
        FileNotFoundError: no such file.
        ValueError: an oblique normal.
    """
    vertices, faces = closed_surface(file)
    patches = {}
    for name, mount in mounts.items():
        center = np.asarray(mount["center"], dtype=np.float64)
        normal = np.asarray(mount["normal"], dtype=np.float64)
        normal = normal / np.linalg.norm(normal)
        if not np.abs(normal).max() > 1.0 - 1e-6:
            raise ValueError(
                f"normal of mount {name!r} must be along x, y or z, got {list(mount['normal'])}; "
                "tilt what is mounted by its direction"
            )
        reference = X if abs(normal[0]) < 0.9 else Y
        points = linear_center(np.zeros(3), np.diag(center))
        patches[name] = Patch("flat", "plate", points, normal, reference)
    return Part(
        "mesh_frame",
        LinearMesh(scaled_points(vertices, [0, 1, 2]), faces),
        density,
        patches,
        tuple(
            Parameter(f"scale_{axis}", value, 0.2, 5.0, f"scale along {axis}")
            for axis, value in zip("xyz", (scale_x, scale_y, scale_z), strict=True)
        ),
        price_per_mass=60.0,
        source="printed",
        options={
            "file": str(file),
            "mounts": {
                k: {n: list(map(float, v)) for n, v in m.items()} for k, m in mounts.items()
            },
            "density": density,
        },
    )
