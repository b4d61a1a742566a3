"""What joins and drives: connectors, mounts, clips, motors, propellers. Up is -z."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from diffsim.copter.vehicle.geometry import (
    UP,
    LinearMesh,
    LinearPoints,
    circle_loop,
    fan_prism,
    fixed_points,
    ring_prism,
    square_loop,
)
from diffsim.copter.vehicle.parts.part import Parameter, Part, RotorMount, density_of, linear_center
from diffsim.copter.vehicle.parts.rotors import RotorData, rotor_data
from diffsim.copter.vehicle.patches import Patch
from diffsim.core.check import require_choice

if TYPE_CHECKING:
    from diffsim.core.schema_numbers import Kilograms, Meters, Ratio

X, Y, DOWN = np.eye(3)
MOTOR_RADIUS = 0.018  # [m]
MOTOR_HEIGHT = 0.032
PROPELLER_ABOVE_BASE = 0.037  # bottom of the motor to the propeller's plane [m]
SPINS = {"cw": 1, "ccw": -1}


def round_connector(rod_diameter: Meters = 0.0146, mass: Kilograms = 0.0434197707992) -> Part:
    """A block with a bore along x for a rod and four flat faces, 40 x 45.6 x 45.6 mm."""
    half = 0.0228
    vertices, faces = ring_prism(square_loop(half), circle_loop(rod_diameter / 2))
    mesh = LinearMesh(fixed_points(vertices * [0.04, 1.0, 1.0]), faces)
    patches = {"bore": Patch("circular", "mount", fixed_points([0.0] * 3), X, UP, rod_diameter / 2)}
    sides = {"top": UP, "bottom": DOWN, "right": Y, "left": -Y}
    for name, normal in sides.items():
        patches[name] = Patch("flat", "mount", fixed_points(half * normal), normal, X)
    return Part(
        "round_connector",
        mesh,
        density_of(mesh, mass),
        patches,
        price=3.0,
        source="printed",
        options={"rod_diameter": rod_diameter, "mass": mass},
    )


def screw_mount(height: Meters = 0.02, diameter: Meters = 0.012, kind: str = "screw_mount") -> Part:
    """A round post with a screw in both ends; the height is a parameter [m]."""
    vertices, faces = fan_prism(circle_loop(diameter / 2), 1.0)
    basis = np.zeros((*vertices.shape, 1))
    basis[:, 2, 0] = vertices[:, 2]
    mesh = LinearMesh(LinearPoints(vertices * [1.0, 1.0, 0.0], basis), faces)
    patches = {
        name: Patch("flat", "mount", linear_center(np.zeros(3), 0.5 * normal[:, None]), normal, X)
        for name, normal in (("top", UP), ("bottom", DOWN))
    }
    return Part(
        kind,
        mesh,
        1200.0,
        patches,
        (Parameter("height", height, 0.004, 0.3, "of the post"),),
        price=0.5,
        price_per_parameter=(5.0,),
        source="printed",
        options={"diameter": diameter},
    )


def standoff(height: Meters = 0.05, diameter: Meters = 0.016) -> Part:
    """A post that lifts a motor above its frame; the height is a parameter [m]."""
    return screw_mount(height, diameter, "standoff")


def compound_angle_clip(normal: Sequence[Ratio], height: Meters = 0.006) -> Part:
    """A wedge whose top is tilted in any direction (thesis 3.6, Fig. 3-4).

    Args:
        normal: Outward normal of the top, unit, in the clip's frame; straight up is (0, 0, -1).
        height: Least thickness [m].

    Raises:
        ValueError: tilted by 60 degrees or more.
    """
    n = np.asarray(normal, dtype=np.float64)
    if not np.isfinite(n).all() or abs(np.linalg.norm(n) - 1.0) > 1e-6 or -n[2] <= 0.5:
        raise ValueError(
            "normal of a compound-angle clip must be a unit vector less than 60 degrees off "
            f"(0, 0, -1), got {n.tolist()}"
        )
    radius = MOTOR_RADIUS
    vertices, faces = fan_prism(circle_loop(radius), 1.0)
    slope = n[:2] / -n[2]  # rise of the top per meter along x and y, downhill along the normal
    reach = float(np.linalg.norm(vertices[0, :2]))
    middle = height + reach * float(np.linalg.norm(slope))
    top = vertices[:, 2] < 0.0
    vertices = vertices.copy()
    vertices[~top, 2] = 0.0
    vertices[top, 2] = -(middle - vertices[top, :2] @ slope)
    reference = X - n * n[0]
    return Part(
        "compound_angle_clip",
        LinearMesh(fixed_points(vertices), faces),
        1200.0,
        {
            "bottom": Patch("flat", "mount", fixed_points([0.0] * 3), DOWN, X),
            "top": Patch("flat", "mount", fixed_points(middle * UP), n, reference),
        },
        price=1.0,
        price_per_mass=60.0,
        source="printed",
        options={"normal": n.tolist(), "height": height},
    )


def motor(rotor: str = "kde2814_10in", spin: str = "cw", pusher: bool = False) -> Part:
    """A motor; its origin is the center of the propeller, where the thrust acts.

    Args:
        rotor: Name of the rotor's model.
        spin: "cw" or "ccw", seen from the propeller's side.
        pusher: The propeller is mounted the other way round and pushes the motor from below
            (the lower one of a coaxial pair): the thrust points from propeller to base.
    """
    data = rotor_data(rotor)
    vertices, faces = fan_prism(circle_loop(MOTOR_RADIUS), MOTOR_HEIGHT)
    vertices[:, 2] += PROPELLER_ABOVE_BASE - 0.5 * MOTOR_HEIGHT
    mesh = LinearMesh(fixed_points(vertices), faces)
    return motor_of_mesh(
        mesh,
        data,
        density_of(mesh, data.motor_mass),
        {"rotor": rotor, "spin": spin, "pusher": pusher},
        base=PROPELLER_ABOVE_BASE,
        spin=spin,
        pusher=pusher,
    )


def motor_of_mesh(
    mesh: LinearMesh,
    data: RotorData,
    density: float,
    options: Mapping[str, object],
    *,
    base: float,
    spin: str,
    pusher: bool,
    kind: str = "motor",
) -> Part:
    """A motor of any shape whose propeller is at the origin and whose base is below, at z = base.

    The rotor's spin is counted about the thrust: a pusher that turns clockwise seen from its own
    side turns counterclockwise seen against the thrust.
    """
    sign = SPINS[require_choice("spin", spin, SPINS)]
    return Part(
        kind,
        mesh,
        density,
        {
            "base": Patch("flat", "motor", fixed_points([0.0, 0.0, base]), DOWN, X),
            "shaft": Patch("circular", "shaft", fixed_points([0.0] * 3), UP, X, 0.003),
        },
        price=data.motor_price,
        rotor_mount=RotorMount(data, DOWN if pusher else UP, -sign if pusher else sign),
        options=options,
    )


def propeller(rotor: str = "kde2814_10in") -> Part:
    """Two tapered blades across a hub, at rest along y."""
    data = rotor_data(rotor)
    reach, chord = data.radius, 0.13 * data.radius
    half = [(0.25, 0.55), (0.5, 0.5), (1.0, 0.2)]  # along the radius, in chords
    right = [(c * chord, r * reach) for r, c in half] + [
        (-c * chord, r * reach) for r, c in reversed(half)
    ]
    outline = np.array([*right, *[(-x, -y) for x, y in right]])
    vertices, faces = fan_prism(outline, 0.003)
    mesh = LinearMesh(fixed_points(vertices), faces)
    return Part(
        "propeller",
        mesh,
        density_of(mesh, data.propeller_mass),
        {"hub": Patch("circular", "shaft", fixed_points([0.0] * 3), UP, X, 0.003)},
        price=data.propeller_price,
        options={"rotor": rotor},
    )
