"""What a flying vehicle looks like: the parts of a design, or arms and discs of a bare vehicle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from diffsim.copter.design.design import Design
from diffsim.copter.simulator import flight_rotors
from diffsim.copter.vehicle.multicopter import Multicopter
from diffsim.copter.vehicle.rotor import RotorModel
from diffsim.copter.vehicle.vehicle_record import FlyingVehicle
from diffsim.core.arrays import Array

if TYPE_CHECKING:
    import trimesh


UP = np.diag([1.0, -1.0, -1.0])  # north-west-up from north-east-down
SLOWER = 20.0  # propellers turn that much slower than they do: no eye and no screen follows them
_ARM = 0.05  # radius of an arm over that of its propeller
_DISC = 0.03  # thickness of a propeller over its radius
_HUB = 0.25  # radius of the body over the mean length of the arms


@dataclass(frozen=True, eq=False)
class FlightShapes:
    """Surfaces of a vehicle and what moves them."""

    vehicle: Multicopter  # mass properties and rotors
    rotors: tuple[RotorModel, ...]  # one model per rotor
    rotor_names: tuple[str, ...]  # one per rotor; the mesh ``NAME__propeller`` turns
    center_of_mass: Array  # in the frame of the meshes, (3,) [m]
    meshes: dict[str, trimesh.Trimesh]  # closed surfaces by name, forward, right, down [m]


def shapes_of(design: Design | FlyingVehicle) -> FlightShapes:
    """Shapes of a design, or stand-ins of a vehicle of which only rotors are known.

    Args:
        design: A composed design, or a vehicle as ``load_vehicle`` gives it.
    """
    if isinstance(design, FlyingVehicle):
        names = tuple(f"rotor_{k}" for k in range(design.vehicle.num_rotors))
        meshes = _stand_ins(design.vehicle, names)
        return FlightShapes(design.vehicle, design.rotors, names, np.zeros(3), meshes)
    vehicle = design.multicopter().detach()
    center = design.center_of_mass().detach().numpy()
    rotors = flight_rotors(vehicle)
    return FlightShapes(vehicle, rotors, design.rotor_names, center, design.meshes())


def _stand_ins(vehicle: Multicopter, names: tuple[str, ...]) -> dict[str, trimesh.Trimesh]:
    """A body, and an arm and a two-bladed propeller per rotor, about the center of mass."""
    import trimesh

    hubs, axes = vehicle.positions.numpy(), vehicle.directions.numpy()
    radii = vehicle.radii.numpy()
    size = _HUB * float(np.linalg.norm(hubs, axis=1).mean())
    meshes = {"body": trimesh.creation.icosphere(subdivisions=2, radius=size or 0.05)}
    for name, hub, axis, radius in zip(names, hubs, axes, radii, strict=True):
        if np.linalg.norm(hub) > 0.0:
            meshes[f"{name}__arm"] = trimesh.creation.cylinder(
                _ARM * radius, segment=[np.zeros(3), hub]
            )
        blade = trimesh.creation.box((2.0 * radius, 0.15 * radius, _DISC * radius))
        turn = trimesh.geometry.align_vectors([0.0, 0.0, 1.0], axis)
        turn[:3, 3] = hub
        meshes[f"{name}__propeller"] = blade.apply_transform(turn)
    return meshes
