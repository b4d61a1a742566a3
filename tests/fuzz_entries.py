"""Public functions and classes with arguments that are right, for tests that spoil them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch

from diffsim import contact, copter, linalg, mesh, ode, soft, stokes

Arguments = dict[str, Any]


@dataclass(frozen=True)
class Entry:
    """A public entry point.

    Attributes:
        call: Takes the arguments by name, returns tensors, arrays, numbers or tuples of them.
        arguments: Makes right arguments.
        fixed: Arguments that are not spoiled: a wrong one is a matter of types, or costs minutes.
        words: Further words by which a message may name an argument.
        passes_nan: NaN in, NaN out, as of a function of the standard library.
    """

    call: Callable[..., Any]
    arguments: Callable[[], Arguments]
    fixed: tuple[str, ...] = ()
    words: dict[str, str] = field(default_factory=dict)
    passes_nan: bool = False


def double(*values: Any) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


@cache
def hexes() -> mesh.HexMesh:
    return mesh.hex_box((1, 1, 1), (1.0, 1.0, 1.0))


@cache
def tets() -> mesh.TetMesh:
    return mesh.tet_box((1, 1, 1), (1.0, 1.0, 1.0))


@cache
def body() -> soft.SoftBody:
    return soft.SoftBody(
        tets(), dt=0.01, youngs_modulus=100.0, poissons_ratio=0.3, density=1.0,
        material="neo_hookean", fixed=torch.tensor([0, 1]),
    )  # fmt: skip


@cache
def vehicle() -> copter.Multicopter:
    return copter.load_design("quadcopter").multicopter().detach()


def state(n: int = 8) -> soft.State:
    return soft.State(tets().x_rest.clone(), torch.zeros(n, 3, dtype=torch.float64))


def flight_state() -> copter.FlightState:
    place, angles = torch.zeros(1, 3).double(), double([0.1, 0.0, 0.2])
    return copter.FlightState.at_rest(place, angles)


def _box() -> Arguments:
    import trimesh

    return {"surface": trimesh.creation.box((1.0, 1.0, 1.0)), "spacing": 0.5}


def _solved(matrix: Any, right: Any, **options: Any) -> Any:
    return linalg.SparseCholesky(matrix, **options).solve(right)


def _stepped(x: Any, v: Any, **signals: Any) -> Any:
    return soft.step(body(), soft.State(x, v), **signals).x


def _flown(commands: Any, dt: Any, substeps: Any, num_threads: Any) -> Any:
    flown = copter.fly(
        vehicle(), flight_state(), commands, dt=dt, substeps=substeps, num_threads=num_threads
    )
    return flown.state.position


def _integrated(time_s: Any, start: Any, inputs: Any, parameters: Any) -> Any:
    system = ode.Ode(
        rates={"x": "v", "v": "u - k*x"}, readings={"y": "x"}, inputs=["u"], parameters=["k"]
    )
    return system.solve(time_s, start, inputs, parameters)[0]


def _body(**arguments: Any) -> Any:
    made = soft.SoftBody(tets(), **arguments)
    return soft.step(made, state()).x


TETS, HEXES = tets, hexes
ENTRIES: dict[str, Entry] = {
    "mesh.TetMesh": Entry(
        lambda x_rest, tets: mesh.TetMesh(x_rest, tets).x_rest,
        lambda: {"x_rest": TETS().x_rest.clone(), "tets": TETS().tets.clone()},
    ),
    "mesh.HexMesh": Entry(
        lambda x_rest, hexes: mesh.HexMesh(x_rest, hexes).x_rest,
        lambda: {"x_rest": HEXES().x_rest.clone(), "hexes": HEXES().hexes.clone()},
    ),
    "mesh.hex_box": Entry(
        lambda **a: mesh.hex_box(**a).x_rest,
        lambda: {"cells": (1, 2, 1), "size": (1.0, 1.0, 1.0), "origin": (0.0, 0.0, 0.0)},
    ),
    "mesh.voxelize": Entry(
        lambda **a: mesh.voxelize(**a).x_rest, _box, words={"surface": "mesh file"}
    ),
    "mesh.tetrahedralize": Entry(
        lambda **a: mesh.tetrahedralize(**a).x_rest, _box, words={"surface": "mesh file"}
    ),
    "mesh.hex_sphere": Entry(
        lambda **a: mesh.hex_sphere(**a).x_rest,
        lambda: {"radius": 1.0, "spacing": 0.5, "center": (0.0, 0.0, 0.0)},
    ),
    "mesh.merge_duplicate_nodes": Entry(
        mesh.merge_duplicate_nodes,
        lambda: {"x": TETS().x_rest.clone(), "elements": TETS().tets.clone(), "tol": 1e-9},
    ),
    "mesh.flip_inverted": Entry(
        mesh.flip_inverted, lambda: {"x": TETS().x_rest.clone(), "elements": TETS().tets.clone()}
    ),
    "linalg.svd3": Entry(
        linalg.svd3,
        lambda: {"F": torch.eye(3).double()[None] * 1.5, "num_threads": 1},
        passes_nan=True,
    ),
    "linalg.polar3": Entry(
        linalg.polar3,
        lambda: {"F": torch.eye(3).double()[None] * 1.5, "num_threads": 1},
        passes_nan=True,
    ),
    "linalg.SparseCholesky": Entry(
        _solved,
        lambda: {
            "matrix": sp.csr_array(np.diag([2.0, 3.0, 4.0])),
            "right": double(1.0, 2.0, 3.0),
            "block": 1,
            "precision": "float64",
            "num_threads": 1,
        },
        words={"right": "b"},
    ),
    "soft.SoftBody": Entry(
        _body,
        lambda: {
            "dt": 0.01,
            "youngs_modulus": 100.0,
            "poissons_ratio": 0.3,
            "density": 1.0,
            "material": "pd",
            "gravity": (0.0, 0.0, -9.81),
            "fixed": torch.tensor([0, 1]),
            "integrator": "implicit_euler",
        },
    ),
    "soft.step": Entry(
        _stepped,
        lambda: {
            "x": TETS().x_rest.clone(),
            "v": torch.zeros(8, 3).double(),
            "external_force": 0.01 * torch.ones(8, 3).double(),
        },
    ),
    "soft.rollout": Entry(
        lambda num_steps, external_force: soft.rollout(
            body(), state(), num_steps, external_force=external_force
        ).x,
        lambda: {"num_steps": 2, "external_force": 0.01 * torch.ones(8, 3).double()},
    ),
    "soft.elastic_energy": Entry(
        lambda x: soft.elastic_energy(body(), x), lambda: {"x": 1.01 * TETS().x_rest}
    ),
    "soft.lame_parameters": Entry(
        soft.lame_parameters, lambda: {"youngs_modulus": double(1.0), "poissons_ratio": double(0.3)}
    ),
    "soft.sealed_pressure": Entry(
        soft.sealed_pressure,
        lambda: {
            "volume": double(1.0, 2.0),
            "filled_volume": 1.5,
            "filled_pressure": 10.0,
            "ambient_pressure": 1e5,
        },
    ),
    "soft.Muscle": Entry(
        lambda **a: _body(
            dt=0.01, youngs_modulus=100.0, poissons_ratio=0.3, muscles=[soft.Muscle(**a)]
        ),
        lambda: {
            "elements": torch.tensor([0, 1]),
            "direction": (1.0, 0.0, 0.0),
            "stiffness": 5.0,
            "kind": "length",
        },
    ),
    "soft.Tendon": Entry(
        lambda path, axial_stiffness: soft.Tendon(
            TETS(), path, axial_stiffness=axial_stiffness
        ).length(TETS().x_rest),
        lambda: {"path": [[0.2, 0.2, 0.1], [0.2, 0.2, 0.8]], "axial_stiffness": 3.0},
    ),
    "soft.Hydrodynamics": Entry(
        lambda **a: tuple(
            soft.Hydrodynamics(TETS(), **a)(TETS().x_rest, 0.1 * torch.ones(8, 3).double())
        ),
        lambda: {"density": 1000.0, "water_velocity": (0.0, 0.0, 0.1), "fade_angle": 0.1},
    ),
    "soft.SolverOptions": Entry(
        lambda **a: _body(
            dt=0.01, youngs_modulus=100.0, poissons_ratio=0.3, solver=soft.SolverOptions(**a)
        ),
        lambda: {"method": "auto", "rtol": 1e-6, "max_iters": 100, "num_threads": 1},
    ),
    "contact.plane": Entry(
        lambda **a: contact.penalty_force(
            [contact.plane(**a)], TETS().x_rest, 0.0 * TETS().x_rest, stiffness=1.0
        ),
        lambda: {"normal": (0.0, 0.0, 1.0), "offset": 0.1, "friction": 0.3},
    ),
    "contact.sphere": Entry(
        lambda **a: contact.penalty_force(
            [contact.sphere(**a)], TETS().x_rest, 0.0 * TETS().x_rest, stiffness=1.0
        ),
        lambda: {"radius": 0.5, "position": (0.0, 0.0, 0.0), "velocity": (0.0, 0.1, 0.0)},
    ),
    "contact.penalty_force": Entry(
        lambda **a: contact.penalty_force([contact.floor(0.1)], **a),
        lambda: {
            "x": TETS().x_rest.clone(),
            "v": torch.zeros(8, 3).double(),
            "stiffness": 10.0,
            "exponent": 2.0,
            "friction": 0.2,
            "nodes": torch.tensor([0, 1]),
        },
    ),
    "contact.detect": Entry(
        lambda **a: contact.detect([contact.floor(0.1)], **a).offset,
        lambda: {"x_start": TETS().x_rest.clone(), "x_end": TETS().x_rest - 0.1, "dt": 0.1},
    ),
    "copter.hover": Entry(
        lambda **a: copter.hover(vehicle(), **a).thrusts,
        lambda: {"weights": torch.ones(4).double(), "smoothing": 0.01, "load": 0.1},
    ),
    "copter.lqr": Entry(
        lambda **a: copter.lqr(**a)[0],
        lambda: {
            "A": double([0.0, 1.0], [0.0, 0.0]),
            "B": double([0.0], [1.0]),
            "Q": torch.eye(2).double(),
            "R": torch.eye(1).double(),
            "num_threads": 1,
        },
    ),
    "copter.lyapunov": Entry(
        copter.lyapunov,
        lambda: {"A": -torch.eye(2).double(), "Q": torch.eye(2).double(), "num_threads": 1},
    ),
    "copter.fly": Entry(
        _flown,
        lambda: {
            "commands": 3.0 * torch.ones(1, 2, 4).double(),
            "dt": 0.01,
            "substeps": 1,
            "num_threads": 1,
        },
    ),
    "copter.linearize": Entry(
        lambda thrusts, attitude, form: copter.linearize(
            vehicle(), thrusts, attitude, form=form
        ).A,
        lambda: {
            "thrusts": 3.0 * torch.ones(4).double(),
            "attitude": double(0.1, 0.0),
            "form": "euler",
        },
    ),
    "ode.Ode": Entry(
        _integrated,
        lambda: {
            "time_s": torch.linspace(0.0, 1.0, 4).double(),
            "start": double(1.0, 0.0),
            "inputs": torch.ones(4, 1).double(),
            "parameters": double(2.0),
        },
        words={"time_s": "time", "inputs": "input"},
    ),
    "stokes.Grid": Entry(
        lambda **a: stokes.Grid(**a).spacing,
        lambda: {"shape": (4, 3), "spacing": 0.1, "origin": (0.0, 0.0)},
    ),
    "stokes.StokesFlow": Entry(
        lambda phi, inlet, **a: stokes.StokesFlow(
            stokes.Grid((4, 3), 0.25), [stokes.Inlet("x-"), stokes.Open("x+")], **a
        )(phi, inlet).velocity,
        lambda: {
            "phi": torch.ones(5, 4).double(),
            "inlet": torch.ones(4, 2).double(),
            "viscosity": 1.0,
            "wall": "no_slip",
            "penalty": 20.0,
        },
        words={"phi": "level"},
    ),
    "stokes.cut_cells": Entry(
        lambda phi, num_threads: stokes.cut_cells(
            stokes.Grid((4, 3), 0.25), phi, num_threads=num_threads
        ).volume,
        lambda: {"phi": torch.ones(5, 4).double(), "num_threads": 1},
    ),
}  # fmt: skip
