"""Right arguments of what is public and takes no tensors, or reads them itself; tests spoil them.

All else: ``tests.derivatives``, spoiled by ``tests/test_arguments.py``.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch

from diffsim import linalg, mesh, soft

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


def state(n: int = 8) -> soft.State:
    return soft.State(tets().x_rest.clone(), torch.zeros(n, 3, dtype=torch.float64))


def _box() -> Arguments:
    import trimesh

    return {"surface": trimesh.creation.box((1.0, 1.0, 1.0)), "spacing": 0.5}


def _solved(matrix: Any, right: Any, **options: Any) -> Any:
    return linalg.SparseCholesky(matrix, **options).solve(right)


def _stepped(x: Any, v: Any, **signals: Any) -> Any:
    return soft.step(body(), soft.State(x, v), **signals).x


def _body(**arguments: Any) -> Any:
    made = soft.SoftBody(tets(), **arguments)
    return soft.step(made, state()).x


TETS, HEXES = tets, hexes
ENTRIES: dict[str, Entry] = {
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
    "soft.step": Entry(
        _stepped,
        lambda: {
            "x": TETS().x_rest.clone(),
            "v": torch.zeros(8, 3).double(),
            "external_force": 0.01 * torch.ones(8, 3).double(),
        },
    ),
    "soft.SolverOptions": Entry(
        lambda **a: _body(
            dt=0.01, youngs_modulus=100.0, poissons_ratio=0.3, solver=soft.SolverOptions(**a)
        ),
        lambda: {"method": "auto", "rtol": 1e-6, "max_iters": 100, "num_threads": 1},
    ),
}  # fmt: skip
