"""Small arguments for public functions, by the function's name or by class and method.

``MAKE`` has arguments of classes (or a function that makes the object of them), ``CALL`` those of
functions and methods, ``USE`` what to do with an object that has no method that takes tensors. A
method of a base class serves its subclasses too. ``LOOK`` has what to look at in a result that is
no tensor, ``FACTORIES`` what makes objects that are not made by their class, or
functions that stand for one of that name.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from diffsim import contact, control, copter, linalg, mesh, ode, soft, stokes
from diffsim.stokes import shapes
from tests.copter.flight_cases import all_effects, crooked_copter, tumbling
from tests.soft.cases import SHARP, deformed, irregular_mesh, noise, soft_body, two_muscles
from tests.stokes.cases import small_flow, small_inputs

Arguments = Callable[[], dict[str, Any]]
MAKE: dict[type, Arguments] = {}
CALL: dict[str, Arguments] = {}
USE: dict[type, Callable[[Any], Any]] = {}
LOOK: dict[str, Callable[[Any], Any]] = {}
FACTORIES: dict[type | str, Callable[..., Any]] = {}
ABSTRACT = (contact.Shape, control.OpenLoop, soft.ActuatorDynamics, shapes.Shape)
"""Their subclasses are what is called."""
LATER: list[str] = []
"""Patterns of names that have no example yet; the layers that they stand on have."""


def strong_copter() -> copter.Multicopter:
    """A level hexacopter that can lose a rotor, nearly but not quite regular."""
    angle = torch.arange(6, dtype=torch.float64) * (torch.pi / 3.0) + 0.05 * noise(6)
    arms = torch.stack([0.4 * angle.cos(), 0.4 * angle.sin(), 0.0 * angle], dim=-1)
    return copter.Multicopter(
        mass=real(1.4),
        inertia=torch.diag(real(0.02, 0.02, 0.04)),
        positions=arms,
        directions=real(0.0, 0.0, -1.0).expand(6, 3),
        spins=real(1.0, -1.0, 1.0, -1.0, 1.0, -1.0),
        torque_ratios=0.015 + 0.001 * noise(6, seed=1),
        max_thrusts=9.0 + 0.5 * noise(6, seed=2),
        radii=real([0.12] * 6),
    )


def real(*values: Any) -> Tensor:
    return torch.tensor(values if len(values) != 1 else values[0], dtype=torch.float64)


def points() -> Tensor:
    """A few points around the unit cube, none of them on an axis or a symmetry."""
    return noise(5, 3, seed=3)


def call(*names: str) -> Callable[[Arguments], Arguments]:
    def put(arguments: Arguments) -> Arguments:
        CALL.update(dict.fromkeys(names, arguments))
        return arguments

    return put


BAR = irregular_mesh("tet", (1, 1, 1))
FIXED = torch.tensor([0, 1])


# --- contact

MAKE |= {
    contact.Box: lambda: {"size": real(1.0, 0.7, 0.5)},
    contact.Capsule: lambda: {
        "start": real(0.1, 0.0, 0.2), "end": real(0.5, 0.3, 1.0), "radius": real(0.3),
    },
    contact.Custom: lambda: {"sdf": lambda x: (x * real(1.0, 0.8, 0.6)).norm(dim=-1) - 0.4},
    contact.HeightField: lambda: {"heights": 0.2 * noise(5, 6, seed=4), "spacing": 0.5,
                                  "origin": real(-1.0, -1.0, 0.0)},
    contact.MeshShape: lambda: {"surface": mesh.hex_box((1, 1, 1), (1.0, 0.7, 0.5))},
    contact.Plane: lambda: {"normal": real(0.1, 0.3, 1.0), "offset": real(0.2)},
    contact.Sphere: lambda: {"radius": real(0.7)},
    contact.Trough: lambda: {"radius": real(1.5), "angle": 1.2},
    contact.Obstacle: lambda: {
        "shape": contact.Box((1.0, 0.7, 0.5)),
        "position": real(0.1, 0.2, 0.1), "rotation": real(0.3, 0.1, -0.2),
        "velocity": real(0.4, 0.1, 0.2), "angular_velocity": real(0.1, 0.3, 0.5),
        "friction": real(0.3), "restitution": real(0.2),
    },
    contact.BodyContact: lambda: {
        "mesh_a": mesh.hex_box((1, 1, 1)), "mesh_b": mesh.hex_box((2, 2, 1), (2.0, 2.0, 1.0)),
        "stiffness": real(50.0), "damping": real(0.3), "friction": real(0.2), "slip_speed": 0.1,
    },
}  # fmt: skip


@call(
    *("Shape.__call__", "Shape.distance_normal", "Shape.evaluate", "MeshShape.nearest"),
    *("Obstacle.distance_normal", "Obstacle.point_velocity", "Obstacle.to_local"),
)
def _places() -> dict[str, Any]:
    return {"x": points()}


CALL["Obstacle.displacement"] = lambda: {"x": points(), "dt": 0.1}
CALL["Obstacle.to_world"] = lambda: {"y": points()}
CALL["floor"] = lambda: {"height": real(0.3), "friction": real(0.2)}
CALL["plane"] = lambda: {**MAKE[contact.Plane](), "position": real(0.1, 0.2, 0.3)}
for _shape in (contact.Box, contact.Capsule, contact.Sphere):
    CALL[_shape.__name__.lower()] = MAKE[_shape]
LOOK |= dict.fromkeys(
    ("plane", "box", "capsule", "sphere", "floor"),
    lambda solid: [solid.distance_normal(points()), solid],
)


@call("BodyContact.forward")
def _touching() -> dict[str, Any]:
    a, b = mesh.hex_box((1, 1, 1)), mesh.hex_box((2, 2, 1), (2.0, 2.0, 1.0))
    above = a.x_rest + real(0.37, 0.41, 0.93)
    return {
        "x_a": above + 0.01 * noise(8, 3), "v_a": noise(8, 3, seed=1),
        "x_b": b.x_rest + 0.01 * noise(18, 3, seed=2), "v_b": noise(18, 3, seed=3),
    }  # fmt: skip


def _ground() -> contact.Obstacle:
    return contact.plane(
        real(0.1, 0.2, 1.0), real(0.1), friction=real(0.3), velocity=real(0.1, 0.2, 0.0)
    )


@call("penalty_force")
def _pressed() -> dict[str, Any]:
    return {
        "obstacles": [_ground()], "x": 0.3 * points(), "v": noise(5, 3, seed=1),
        "stiffness": real(40.0), "friction": real(0.3), "viscous_cap": real(5.0),
        "damping": real(0.4),
    }  # fmt: skip


@call("detect")
def _met() -> dict[str, Any]:
    start = points() + real(0.0, 0.0, 1.0)
    return {"obstacles": [_ground()], "x_start": start, "x_end": start - 0.4, "dt": 0.1}


@call("check_clear")
def _clear() -> dict[str, Any]:
    return {"obstacles": [contact.floor(-5.0)], "mesh": BAR, "x": BAR.x_rest}


@call("ball_force")
def _balls() -> dict[str, Any]:
    ball = torch.tensor([[0, 1], [2, 3]])
    return {
        "x": 0.4 * noise(4, 3, seed=2), "v": noise(4, 3, seed=3), "balls": ball,
        "radius": real(0.5), "stiffness": real(30.0), "friction": real(0.2),
    }  # fmt: skip


# --- control, linear algebra, differential equations

MAKE |= {
    control.Knots: lambda: {"num_commands": 2, "dt": 0.1, "num_knots": 4, "duration": 1.0,
                            "start": 0.3 * noise(4, 2)},
    control.Sinusoid: lambda: {"num_commands": 2, "dt": 0.1, "amplitudes": real(0.3, 0.4),
                               "phases": real(0.1, 0.2)},
    control.Normalizer: lambda: {"size": 3},
    control.MLPController: lambda: {"num_observations": 3, "num_commands": 2,
                                    "input_gains": real(1.0, 2.0, 0.5)},
    linalg.SparseCholesky: lambda: {"matrix": _definite().to_sparse_csr(), "coords": noise(4, 3)},
    ode.Ode: lambda: {"rates": {"x": "v", "v": "-k*sin(x) - c*v*abs(v) + u"},
                      "readings": {"y": "x + 0.1*v**2"}, "parameters": ["k", "c"],
                      "inputs": ["u"], "limits": {"x": (-9.0, 9.0)}},
}  # fmt: skip
CALL |= {
    "OpenLoop.forward": lambda: {"observation": noise(2, 3), "step": 3},
    "Knots.signal": lambda: {"time": real(0.11, 0.57)},
    "Sinusoid.signal": lambda: {"time": real(0.11, 0.57)},
    "Normalizer.forward": lambda: {"observation": noise(2, 3)},
    "Normalizer.update": lambda: {"observations": noise(2, 3)},
    "MLPController.forward": lambda: {"observation": noise(2, 3)},
    "SparseCholesky.solve": lambda: {"b": noise(4, 2)},
    "SparseCholesky.refactor": lambda: {"matrix": _definite().to_sparse_csr()},
    "svd3": lambda: {"F": torch.eye(3).double() + 0.4 * noise(2, 3, 3)},
    "polar3": lambda: {"F": torch.eye(3).double() + 0.4 * noise(2, 3, 3)},
    "Ode.problem": lambda: {"times": real(0.0, 0.1), "num_steps": 1, "num_threads": 1},
}


def _definite() -> Tensor:
    root = noise(4, 4)
    return root @ root.T + 3.0 * torch.eye(4).double()


@call("Ode.solve")
def _swing() -> dict[str, Any]:
    times = torch.linspace(0.0, 1.0, 6, dtype=torch.float64)
    return {
        "times": times, "start": real(0.4, 0.3), "inputs": times[:, None].sin(),
        "parameters": real(3.0, 0.4), "num_steps": 2,
    }  # fmt: skip


# --- meshes

MAKE |= {
    mesh.HexMesh: lambda: {"x_rest": mesh.hex_box((1, 1, 1)).x_rest,
                           "hexes": mesh.hex_box((1, 1, 1)).hexes},
    mesh.TetMesh: lambda: {"x_rest": BAR.x_rest, "tets": BAR.tets},
    mesh.RegionMesh: lambda: {"mesh": BAR, "names": ("a", "b"),
                              "region": torch.tensor([0, 0, 0, 1, 1, 1])},
    mesh.Cage: lambda: {"mesh": irregular_mesh("hex"), "points": (3, 2, 2)},
    mesh.Blend: lambda: {"mesh": BAR, "shapes": BAR.x_rest + 0.1 * noise(2, *BAR.x_rest.shape)},
}  # fmt: skip
USE |= {
    mesh.HexMesh: lambda m: [m.x_rest, mesh.element_volumes(m)],
    mesh.TetMesh: lambda m: [m.x_rest, mesh.element_volumes(m)],
}


@call("flip_inverted", "merge_duplicate_nodes", "remove_degenerate", "remove_unreferenced_nodes",
      "repair")  # fmt: skip
def _raw() -> dict[str, Any]:
    return {"x": BAR.x_rest, "elements": BAR.tets}


CALL |= dict.fromkeys(
    (
        *("cavities", "element_size", "element_volumes"),
        *("quality", "shape_gradients", "surface_quads", "surface_triangles"),
        *("surface_vertices", "total_volume"),
    ),
    lambda: {"mesh": irregular_mesh("hex")},
)
CALL |= dict.fromkeys(
    ("nodal_shares", "nodal_volume"),
    lambda: {"mesh": irregular_mesh("hex"), "x_rest": deformed(irregular_mesh("hex"), 0.1)},
)
CALL |= {
    "save": lambda: {"mesh": BAR, "path": Path(tempfile.mkdtemp()) / "bar.vtu", "x": BAR.x_rest},
    "RegionMesh.values": lambda: {"of": {"a": real(1.0), "b": real(2.0)}},
    "split_tets": lambda: {"mesh": BAR},
    "split_positions": lambda: {"mesh": BAR, "x": BAR.x_rest + 0.05 * noise(*BAR.x_rest.shape)},
    "Cage.__call__": lambda: {"offsets": 0.1 * noise(3, 2, 2, 3)},
    "Blend.__call__": lambda: {"weights": real(0.3, -0.2)},
    "safe_share": lambda: {"mesh": BAR, "x": BAR.x_rest, "moved": BAR.x_rest + 0.01},
    "to_trimesh": lambda: {"mesh": BAR, "x": BAR.x_rest},
}


# --- soft bodies

MAKE |= {
    soft.FirstOrderLag: lambda: {"time_constant": real(0.2)},
    soft.RateLimit: lambda: {"max_rate": real(0.8)},
    soft.Hydrodynamics: lambda: {
        "mesh": irregular_mesh("hex"), "density": real(1000.0),
        "water_velocity": real(0.1, 0.2, 0.0),
        "drag_coefficients": real(0.05, 0.1, 1.85, 2.05),
        "thrust_coefficients": real(-0.8, -0.5, 0.1, 2.5),
    },
    soft.Material: lambda: {"law": "stvk"},
    soft.Muscle: lambda: {"elements": torch.tensor([0, 1]), "direction": real(1.0, 0.2, 0.1),
                          "stiffness": 8.0, "weights": real(1.0, 0.5)},
    soft.ContactOptions: lambda: {"contact_nodes": torch.tensor([0, 1])},
    soft.PressureChamber: lambda: {"faces": mesh.surface_triangles(BAR).faces},
    soft.Tendon: lambda: {"mesh": mesh.hex_box((3, 1, 1), (3.0, 1.0, 1.0)),
                          "path": real([[0.1, 0.5, 0.5], [1.6, 0.4, 0.6], [2.9, 0.5, 0.5]]),
                          "axial_stiffness": 4.0},
    soft.SoftBody: lambda: {
        "mesh": irregular_mesh("hex"), "dt": 0.1, "youngs_modulus": real(30.0, 40.0),
        "poissons_ratio": real(0.3), "density": real(1.5), "gravity": real(0.3, -0.2, -1.0),
        "fixed": FIXED, "muscles": two_muscles(),
        "damping": soft.Damping(rayleigh_alpha=real(0.2), rayleigh_beta=real(0.01)),
        "masses": soft.Masses(attached_mass=0.1 * noise(12, seed=8).abs(),
                              added_mass=0.1 * noise(12, seed=9).abs()),
        "solver": soft.SolverOptions(**SHARP),
    },
}  # fmt: skip
USE |= {
    soft.Muscle: lambda m: [m.direction],
    soft.ContactOptions: lambda c: [],
}


def _swimming() -> dict[str, Any]:
    m = irregular_mesh("hex")
    return {
        "x": deformed(m), "v": noise(12, 3, seed=5), "water_velocity": real(0.3, 0.1, 0.2),
    }  # fmt: skip


CALL |= {
    "ActuatorDynamics.forward": lambda: {
        "command": real(0.5, -0.4), "dt": 0.1,
        "state": soft.ActuatorState(real(0.45, 0.2), torch.zeros(0, 2).double()),
    },
    "ActuatorDynamics.initial_state": lambda: {"value": real(0.5, 0.4)},
    "ActuatorDynamics.sequence": lambda: {"commands": noise(4, 2), "dt": 0.1,
                                          "initial": real(0.3, 0.2)},
    "Hydrodynamics.drag_coefficient": lambda: {"alpha": real(0.2, 0.7)},
    "Hydrodynamics.thrust_coefficient": lambda: {"alpha": real(0.2, 0.7)},
    "Hydrodynamics.evaluate": _swimming,
    "Hydrodynamics.forward": _swimming,
    "Material.weights": lambda: {"youngs_modulus": real(30.0, 40.0),
                                 "poissons_ratio": real(0.3, 0.2)},
    "PressureChamber.volume": lambda: {"x": deformed(BAR)},
    "Tendon.activation": lambda: {"length_command": real(0.8)},
    "Tendon.length": lambda: {"x": deformed(mesh.hex_box((3, 1, 1), (3.0, 1.0, 1.0)))},
    "Tendon.stretch": lambda: {"x": deformed(mesh.hex_box((3, 1, 1), (3.0, 1.0, 1.0)))},
    "Tendon.tension": lambda: {"x": deformed(mesh.hex_box((3, 1, 1), (3.0, 1.0, 1.0))),
                               "activation": real(0.9), "axial_stiffness": real(4.0)},
    "buoyancy": lambda: {"volume": real(0.1, 0.2), "density": real(1000.0),
                         "gravity": real(0.0, 0.1, -9.81)},
    "lame_parameters": lambda: {"youngs_modulus": real(30.0), "poissons_ratio": real(0.3)},
    "pd_weights": lambda: {"youngs_modulus": real(30.0), "poissons_ratio": real(0.3)},
    "sealed_pressure": lambda: {"volume": real(0.9), "filled_volume": real(1.0),
                                "filled_pressure": real(2e4)},
}  # fmt: skip


def _body() -> soft.SoftBody:
    return soft_body(irregular_mesh("hex"), fixed=FIXED, muscles=two_muscles())


def _strained() -> dict[str, Any]:
    return {"x": deformed(irregular_mesh("hex")), "activation": real(0.8, 1.1)}


def _moving() -> dict[str, Any]:
    m = irregular_mesh("hex")
    body = _body()
    return {
        "state": soft.State(deformed(m, 0.1), 0.2 * noise(12, 3, seed=2)),
        "external_force": 0.1 * noise(12, 3, seed=4), "activation": real(0.8, 1.1),
        "dirichlet_target": m.x_rest + 0.05, "physics": body.physics(),
        "obstacles": contact.plane(real(0.0, 0.1, 1.0), real(-9.0), velocity=real(0.0, 0.1, 0.2)),
    }  # fmt: skip


def _still() -> dict[str, Any]:
    given = _moving()
    del given["state"], given["obstacles"]
    return given


CALL |= {
    "elastic_energy": lambda: {"body": _body(), **_strained()},
    "elastic_force": lambda: {"body": _body(), **_strained()},
    "SoftBody.elastic_energy": _strained,
    "SoftBody.elastic_force": _strained,
    "SoftBody.forward": lambda: {k: v for k, v in _moving().items() if k != "physics"},
    "step": lambda: {"body": _body(), **_moving()},
    "static_equilibrium": lambda: {"body": _body(), **_still(), "guess": _body().x_rest},
    "static_tangents": lambda: {
        "body": _body(), **_still(), "x": deformed(irregular_mesh("hex")), "count": 1,
        "directions": soft.Directions(external_force=noise(1, 12, 3)),
    },
    "physics_directions": lambda: {
        "body": _body(), "values": {"density": real(1.5)},
        "directions": {"density": real([1.0])},
    },
}  # fmt: skip


def _rolled() -> dict[str, Any]:
    given = {k: v for k, v in _moving().items() if k not in ("dirichlet_target", "obstacles")}
    return {"body": _body(), **given, "num_steps": 2}


CALL |= {
    "SoftBody.physics": lambda: {"density": real(1.5), "youngs_modulus": real(30.0),
                                 "x_rest": deformed(irregular_mesh("hex"), 0.1)},
    "SoftBody.rest_state": lambda: {
        "physics": _body().physics(x_rest=deformed(irregular_mesh("hex"), 0.1)),
    },
    "rollout": _rolled,
    "rollout_tangents": lambda: {
        **_rolled(), "count": 1, "directions": soft.Directions(v=noise(1, 12, 3)),
    },
    "added_mass": lambda: {"source": irregular_mesh("hex"), "coefficient": real(0.5),
                           "density": real(1000.0)},
    "PressureChamber.from_cavity": lambda: {"mesh": _hollow()},
}  # fmt: skip


def _hollow() -> mesh.HexMesh:
    cube = mesh.hex_box((3, 3, 3))
    return mesh.HexMesh(cube.x_rest, torch.cat([cube.hexes[:13], cube.hexes[14:]]))


# --- multicopters

CALL |= {
    "Fleet.of": lambda: {"vehicles": [crooked_copter(5), crooked_copter(5, 1)]},
    "disc_clearances": lambda: {"copter": strong_copter()},
    "min_clearance": lambda: {"copter": strong_copter()},
    "hover_map_singular_value": lambda: {"copter": crooked_copter(5)},
    "prepare_flight": lambda: {"vehicle": crooked_copter(5), "dt": 0.03,
                               "effects": all_effects(5, 1)},
    "RotorModel.thrust": lambda: {"speed": real(300.0, 500.0)},
    "RotorModel.speed": lambda: {"thrust": real(2.0, 4.0)},
    "RotorModel.torque": lambda: {"thrust": real(2.0, 4.0)},
    "RotorModel.power": lambda: {"thrust": real(2.0, 4.0)},
    "RotorModel.current": lambda: {"thrust": real(2.0, 4.0), "voltage": real(13.0)},
    "RotorModel.signal": lambda: {"thrust": real(2.0, 4.0), "voltage": real(13.0)},
    "RotorModel.speed_at": lambda: {"signal": real(1500.0, 1700.0), "voltage": real(13.0)},
    "save_design": lambda: {"design": copter.load_design("x_quadcopter"),
                            "path": Path(tempfile.mkdtemp()) / "design.yaml"},
    "fly": lambda: {"vehicle": crooked_copter(5), "start": tumbling(2, 5),
                    "commands": 3.0 + 0.3 * noise(2, 2, 5), "dt": 0.03,
                    "feedback": copter.Feedback(gain=0.1 * noise(5, 12), reference=noise(2, 12)),
                    "effects": all_effects(5, 2), "substeps": 2},
    "hover": lambda: {"copter": crooked_copter(5), "weights": real(1.0, 1.1, 0.9, 1.2, 1.0),
                      "load": real(0.1)},
    "lyapunov": lambda: {"A": noise(3, 3) - 3.0 * torch.eye(3).double(), "Q": _symmetric(3)},
    "lqr": lambda: {"A": noise(3, 3), "B": noise(3, 2, seed=1), "Q": _symmetric(3),
                    "R": _symmetric(2)},
    "lqr_stats": lambda: {"A": noise(3, 3), "B": noise(3, 2, seed=1), "Q": _symmetric(3),
                          "R": _symmetric(2)},
    "controllability": lambda: {"A": noise(3, 3), "B": noise(3, 2, seed=1)},
    "response_time": lambda: {"A": noise(3, 3) - 3.0 * torch.eye(3).double(),
                              "B": noise(3, 2, seed=1), "K": 0.1 * noise(2, 3, seed=2)},
    "state_rate": lambda: {"copter": crooked_copter(5), "state": 0.3 * noise(12),
                           "thrusts": 3.0 + noise(5, seed=1)},
    "linearize": lambda: {"copter": crooked_copter(5), "thrusts": 3.0 + 0.1 * noise(5),
                          "attitude": real(0.1, 0.2)},
    "max_hover_weight": lambda: {"copter": strong_copter(), "torque": real(0.01, 0.01, 0.001)},
    "control_authority": lambda: {"copter": strong_copter(), "torque": real(1.0, 1.0, 0.1),
                                  "load": real(0.1)},
    "rotor_out_margins": lambda: {"copter": strong_copter(), "load": real(0.1)},
    "hover_thrusts": lambda: {
        "force_matrix": _efforts()[0], "torque_matrix": _efforts()[1], "weight": real([13.0]),
        "max_thrusts": real([[7.0] * 5]), "weights": real([[1.0, 1.1, 0.9, 1.2, 1.0]]),
    },
    "FlightState.at_rest": lambda: {"position": noise(2, 3), "rpy": 0.3 * noise(2, 3)},
    "FlightState.from_minimal": lambda: {"x12": 0.3 * noise(2, 12)},
    "Hover.forward": lambda: {"copter": crooked_copter(5), "load": real(0.1)},
    "LQR.forward": lambda: {"A": noise(3, 3), "B": noise(3, 2, seed=1)},
    "Battery.current_for_power": lambda: {"charge": real(0.7), "power": real(90.0)},
    "Battery.endurance": lambda: {"power": real(90.0)},
    "Battery.open_circuit": lambda: {"charge": real(0.7)},
    "Battery.voltage": lambda: {"charge": real(0.7), "current": real(9.0)},
    "PreparedFlight.fly": lambda: {"start": tumbling(1, 5), "commands": 3.0 + noise(1, 1, 5)},
    "PreparedFlight.step": lambda: {"start": tumbling(1, 5), "thrusts": 3.0 + noise(1, 5)},
}  # fmt: skip


def _symmetric(n: int) -> Tensor:
    root = noise(n, n, seed=5)
    return root @ root.T + torch.eye(n).double()


def _efforts() -> tuple[Tensor, Tensor]:
    craft = crooked_copter(5)
    force = craft.directions.T
    torque = torch.linalg.cross(craft.positions, craft.directions).T
    return force[None].contiguous(), torque[None].contiguous()


def _rotor() -> dict[str, Any]:
    given = vars(copter.rotor_model("kde2814_10in")).copy()
    return {k: real(v) if isinstance(v, float) else v for k, v in given.items()}


MAKE |= {
    copter.RotorModel: _rotor,
    copter.Battery: lambda: {"capacity": real(5.0), "resistance": real(0.03),
                             "open_circuit_coefficients": real(9.0, 3.0, -1.5, 2.0),
                             "nominal_voltage": real(11.1)},
    copter.BodyDrag: lambda: {"linear": real(0.1, 0.2, 0.3), "quadratic": real(0.2, 0.1, 0.15)},
    copter.Feedback: lambda: {"gain": noise(5, 12), "reference": noise(12)},
    copter.FlightEffects: lambda: {
        "wind": noise(2, 3),
        "body_drag": copter.BodyDrag(linear=real(0.1, 0.2, 0.3), quadratic=real(0.2, 0.1, 0.1)),
    },
    copter.FlightState: lambda: {k: getattr(tumbling(1, 5), k) for k in
                                 ("position", "quaternion", "velocity", "body_rates", "thrusts",
                                  "charge")},
    copter.Hover: lambda: {"weights": real(1.0, 1.1, 0.9, 1.2, 1.0)},
    copter.LQR: lambda: {"q": real(1.0, 2.0, 3.0), "r": real(1.0, 2.0)},
    copter.MotorLag: lambda: {"time_constants": real(0.04, 0.05)},
    copter.Multicopter: lambda: {k: getattr(crooked_copter(5), k) for k in
                                 ("mass", "inertia", "positions", "directions", "spins",
                                  "torque_ratios", "max_thrusts", "radii")},
}  # fmt: skip
USE |= {
    copter.BodyDrag: lambda d: [d.linear, d.quadratic],
    copter.Feedback: lambda f: [f.gain, f.reference],
    copter.FlightEffects: lambda e: [e.wind],
    copter.FlightState: lambda s: s,
    copter.MotorLag: lambda lag: [lag.time_constants],
    copter.Multicopter: lambda c: [copter.hover(c).thrusts],
}


# --- Stokes flow


def _flow_inputs() -> dict[str, Any]:
    return {k: v.detach() for k, v in small_inputs(small_flow(2)).items()}


def _field() -> stokes.FlowField:
    return small_flow(2)(**_flow_inputs())


def _two_balls() -> dict[str, Any]:
    return {"shapes": [shapes.Sphere(0.8), shapes.Sphere(0.7, (0.5, 0.3, 0.1))]}


def _join(kind: type) -> Callable[..., Any]:
    return lambda shapes, **options: kind(*shapes, **options)


FACTORIES |= {
    kind: _join(kind)
    for kind in (shapes.Union, shapes.Intersection, shapes.SmoothUnion, shapes.SmoothIntersection)
}
FACTORIES[stokes.FlowField] = lambda **given: small_flow(2)(**given)
FACTORIES[copter.PreparedFlight] = copter.prepare_flight
MAKE |= {
    copter.PreparedFlight: lambda: {
        "vehicle": crooked_copter(5), "dt": 0.03, "effects": all_effects(5, 1),
    },
    stokes.StokesFlow: lambda: {
        "grid": small_flow(2).grid, "boundary": [stokes.Inlet("x-"), stokes.Open("x+")],
        "bulk_ratio": 1e3, "solver": stokes.SolverOptions(tolerance=1e-11, rtol=1e-11),
    },
    stokes.Boundary: lambda: {"grid": small_flow(2).grid,
                              "conditions": [stokes.Inlet("x-"), stokes.Open("x+")]},
    stokes.Grid: lambda: {"shape": (5, 4), "spacing": (0.2, 0.25)},
    shapes.BezierCurve2d: lambda: {
        "control_points": real([[0.0, 0.0], [0.3, 0.6], [0.7, 0.4], [1.0, 0.0]]),
        "weights": real(1.0, 1.2, 0.9, 1.0),
    },
    shapes.NurbsSurface: lambda: {"control_points": _tube(),
                                  "weights": 1.0 + 0.1 * noise(6, 4).abs()},
    shapes.BSplineSurface: lambda: {"control_points": _tube()},
    shapes.Box: lambda: {"size": real(1.0, 0.7, 0.5), "center": real(0.1, 0.2, 0.0)},
    shapes.Sphere: lambda: {"radius": real(0.6), "center": real(0.1, 0.2, 0.0)},
    shapes.Plane: lambda: {"normal": real(0.1, 0.3, 1.0), "offset": real(0.2)},
    shapes.Complement: lambda: {"shape": shapes.Sphere(0.6)},
    shapes.Custom: lambda: {"level_set": lambda x: x.norm(dim=-1) - 0.4, "dim": 3},
    shapes.Extrude: lambda: {"shape": shapes.Sphere(0.6, (0.1, 0.2))},
    shapes.Rotate: lambda: {"shape": shapes.Box((1.0, 0.7, 0.5)), "angle": real(0.3)},
    shapes.Translate: lambda: {"shape": shapes.Sphere(0.6), "by": real(0.1, 0.2, 0.3)},
    shapes.Union: _two_balls,
    shapes.Intersection: _two_balls,
    shapes.SmoothUnion: lambda: {**_two_balls(), "radius": real(0.2)},
    shapes.SmoothIntersection: lambda: {**_two_balls(), "radius": real(0.2)},
    stokes.FlowField: _flow_inputs,
    shapes.SplineBasis: lambda: {"num": 6, "degree": 3, "periodic": False},
}  # fmt: skip
CALL |= {
    "StokesFlow.forward": _flow_inputs,
    "StokesFlow.report": lambda: {"phi": _flow_inputs()["phi"]},
    "FlowField.sample": lambda: {"points": 0.2 + 0.1 * noise(3, 2).abs()},
    "Boundary.inlet_velocities": lambda: {"inlet": _flow_inputs()["inlet"]},
    "Grid.nodal_vectors": lambda: {"name": "body_force", "value": real(0.1, 0.2)},
    "cut_cells": lambda: {"grid": small_flow(2).grid, "phi": _flow_inputs()["phi"]},
    "Shape.forward": lambda: {"points": points()},
    "Shape.level": lambda: {"points": points()},
    "BezierCurve2d.forward": lambda: {"points": 0.5 * noise(4, 2, seed=2)},
    "BezierCurve2d.level": lambda: {"points": 0.5 * noise(4, 2, seed=2)},
    "BezierCurve2d.closest": lambda: {"points": 0.5 * noise(4, 2, seed=2)},
    "BezierCurve2d.point": lambda: {"tau": real(0.2, 0.7)},
    "NurbsSurface.point": lambda: {"uv": real([[0.2, 0.3], [0.6, 0.7]])},
    "SplineBasis.__call__": lambda: {"u": real(0.2, 0.7)},
    "grid_nodes": lambda: {"num_cells": (2, 2), "spacing": 0.1, "origin": real(0.1, 0.2)},
    "interface": lambda: {"phi": _flow_inputs()["phi"], "nodes": small_flow(2).grid.nodes},
    "sample": lambda: {"shape": shapes.Sphere(0.4, (0.5, 0.5)), "nodes": small_flow(2).grid.nodes},
}  # fmt: skip


def _tube() -> Tensor:
    angle = torch.arange(6, dtype=torch.float64) * torch.pi / 3.0
    ring = torch.stack([angle.cos(), angle.sin()], -1)
    height = torch.linspace(-1.0, 1.0, 4, dtype=torch.float64)
    tube = torch.cat([ring[:, None].expand(6, 4, 2), height[None, :, None].expand(6, 4, 1)], -1)
    return tube + 0.05 * noise(6, 4, 3)
