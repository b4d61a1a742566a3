"""Compliance of a linear elastic solid of graded density, and its gradient, by diffsim's statics.

Linear elasticity is how an equilibrium answers to a small load: the derivative of
``static_equilibrium`` at rest along the load, K^-1 f, with the tangent K of the hyperelastic solid.
Stiffness follows the density as E = E_min + (E_max - E_min) rho^3 (SIMP, Bendsoe and Sigmund 2003,
ch. 1), with E_min = xmin E_max.

This file needs diffsim alone, and stands beside ``tesseract_api.py`` in a container.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim import mesh, soft

Floats = NDArray[np.floating]
Ints = NDArray[np.integer]

POWER = 3.0
# Greatest strain at which forces are taken for the gradient: even terms cancel between +u and -u,
# the next odd one is this squared [-].
_SMALL_STRAIN = 1e-4


@dataclass(frozen=True)
class Groups:
    """Values on groups of nodes."""

    mask: Ints  # group of each node, (num_nodes,); 0: none, k: that of ``values[k - 1]``
    values: Floats | None = None  # (num_groups, 3); None: zeros

    def nodal(self, size: int) -> Tensor:
        """Value of each node, zero outside of all groups, (size, 3)."""
        out = np.zeros((size, 3))
        mask = np.asarray(self.mask[:size], np.int64)
        if self.values is not None:
            out[mask > 0] = np.asarray(self.values, np.float64)[mask[mask > 0] - 1]
        return torch.from_numpy(out)

    def nodes(self, size: int) -> NDArray[np.bool_]:
        """Whether each node is in a group, (size,)."""
        return np.asarray(self.mask[:size]) > 0


@dataclass(frozen=True)
class Problem:
    """Mesh and boundary conditions; all but the density.

    Attributes:
        points: Nodes, (num_nodes, 3).
        cells: Nodes of the hexahedra in Abaqus's and VTK's order, (num_cells, 8).
        held: Prescribed displacements.
        loaded: Forces or tractions, as ``kind`` says.
        kind: ``force``: a force at each node of a group; ``traction``: force per area on faces all
            of whose nodes are in a group.
        e_max: Young's modulus at density 1.
        nu: Poisson's ratio.
        xmin: Young's modulus at density 0 over that at density 1.
    """

    points: Floats
    cells: Ints
    held: Groups
    loaded: Groups
    kind: Literal["force", "traction"] = "force"
    e_max: float = 70_000.0
    nu: float = 0.3
    xmin: float = 1e-3


@dataclass(frozen=True, eq=False)
class Prepared:
    """What a design loop needs once: the body, its load and its prescribed displacements."""

    problem: Problem
    body: soft.SoftBody
    force: Tensor
    shift: Tensor
    key: tuple[bytes, ...] = field(repr=False, default=())


def problem_of(inputs: Mapping[str, Any]) -> tuple[Problem, NDArray[np.float64]]:
    """Problem and densities of the domain's inputs, arrays cut to the sizes that are in use.

    Args:
        inputs: ``rho``, ``boundary_conditions`` and ``hex_mesh`` as Mosaic's schema names them;
            optionally ``E_max``, ``nu``, ``xmin`` and ``neumann_kind``.
    """
    solid, conditions = inputs["hex_mesh"], inputs["boundary_conditions"]
    points = np.asarray(solid["points"])
    num_nodes = len(points) if solid.get("n_points") is None else int(solid["n_points"])
    cells = np.asarray(solid["faces"])
    num_cells = len(cells) if solid.get("n_faces") is None else int(solid["n_faces"])
    groups = {
        name: Groups(np.zeros(num_nodes, np.int32))
        if conditions.get(name) is None
        else Groups(np.asarray(conditions[name]["mask"])[:num_nodes], conditions[name]["values"])
        for name in ("dirichlet", "neumann")
    }
    problem = Problem(
        points=points[:num_nodes],
        cells=cells[:num_cells],
        held=groups["dirichlet"],
        loaded=groups["neumann"],
        kind=inputs.get("neumann_kind", "force"),
        e_max=float(inputs.get("E_max", 70_000.0)),
        nu=float(inputs.get("nu", 0.3)),
        xmin=float(inputs.get("xmin", 1e-3)),
    )
    return problem, np.asarray(inputs["rho"], np.float64)[:num_cells]


def prepare(problem: Problem) -> Prepared:
    """Make the solid of a problem."""
    solid = mesh.HexMesh(
        np.asarray(problem.points, np.float64),
        np.asarray(problem.cells, np.int64)[:, mesh.HEX_FROM_VTK],
    )
    size = solid.num_nodes
    body = soft.SoftBody(
        solid,
        dt=1.0,  # not used: statics
        youngs_modulus=problem.e_max,
        poissons_ratio=problem.nu,
        material="corotated",  # any hyperelastic one has the same tangent at rest
        gravity=(0.0, 0.0, 0.0),
        fixed=problem.held.nodes(size),
    )
    value = problem.loaded.nodal(size)
    if problem.kind == "traction":
        value = _faces_force(solid, value, problem.loaded)
    return Prepared(problem, body, value, problem.held.nodal(size))


def compliance(prepared: Prepared, rho: Floats) -> float:
    """C = f . u.

    Args:
        prepared: The solid.
        rho: Densities, (num_cells,) in [0, 1].
    """
    return float((prepared.force * _displacement(prepared, _young(prepared.problem, rho))).sum())


def compliance_gradient(prepared: Prepared, rho: Floats) -> tuple[float, NDArray[np.float64]]:
    """C and dC/drho, (num_cells,).

    dC/dE = -l' (dK/dE) u, where l = K^-1 f without prescribed displacements; so l = u for clamped
    supports. The derivative of K u in E is that of the body's elastic force.
    """
    young = _young(prepared.problem, rho)
    u = _displacement(prepared, young)
    adjoint = _displacement(prepared, young, moved=False) if bool(prepared.shift.any()) else u
    slope = _force_slope(prepared, young, u, adjoint)
    e_max, xmin = prepared.problem.e_max, prepared.problem.xmin
    rise = (1.0 - xmin) * e_max * POWER * np.asarray(rho, np.float64) ** (POWER - 1.0)
    return float((prepared.force * u).sum()), slope.numpy() * rise


def cached(make: Callable[[Problem], Prepared] = prepare, keep: int = 4) -> Callable:
    """``prepare`` that keeps its last results: a design loop asks for one solid many times."""
    held: list[Prepared] = []

    def get(problem: Problem) -> Prepared:
        key = _key(problem)
        for entry in held:
            if entry.key == key:
                return entry
        made = make(problem)
        held.append(Prepared(made.problem, made.body, made.force, made.shift, key))
        del held[:-keep]
        return held[-1]

    return get


def _key(problem: Problem) -> tuple[bytes, ...]:
    arrays = [problem.points, problem.cells]
    for groups in (problem.held, problem.loaded):
        arrays += [groups.mask, np.zeros(0) if groups.values is None else groups.values]
    facts = repr((problem.kind, problem.e_max, problem.nu, problem.xmin))
    return (*(np.ascontiguousarray(a).tobytes() for a in arrays), facts.encode())


def _young(problem: Problem, rho: Floats) -> Tensor:
    density = np.asarray(rho, np.float64)
    if density.shape != (len(problem.cells),) or not np.isfinite(density).all():
        raise ValueError(f"rho must be ({len(problem.cells)},) finite numbers, got {density.shape}")
    share = problem.xmin + (1.0 - problem.xmin) * density**POWER
    return torch.from_numpy(problem.e_max * share)


def _displacement(prepared: Prepared, young: Tensor, *, moved: bool = True) -> Tensor:
    """K^-1 f, with the prescribed displacements, (num_nodes, 3)."""
    body = prepared.body
    along = soft.Directions(
        external_force=prepared.force[None],
        dirichlet_target=prepared.shift[None] if moved and bool(prepared.shift.any()) else None,
    )
    physics = body.physics(youngs_modulus=young)
    return soft.static_tangents(body, body.mesh.nodes, 1, along, physics=physics)[0]


def _force_slope(prepared: Prepared, young: Tensor, u: Tensor, adjoint: Tensor) -> Tensor:
    """Derivative of the linear elastic force at u along the adjoint in E, (num_cells,)."""
    body = prepared.body
    elements, nodes = body.mesh.elements, body.mesh.nodes
    corners = u[elements]
    shortest = (nodes[elements[:, 0]] - nodes[elements[:, 7]]).norm(dim=1).min() / 2.0
    strain = float((corners.amax(1) - corners.amin(1)).max() / shortest)
    small = _SMALL_STRAIN / max(strain, 1e-300)
    leaf = young.clone().requires_grad_()
    pair = torch.stack([nodes + small * u, nodes - small * u])
    force = body.elastic_force(pair, physics=body.physics(youngs_modulus=leaf))
    along = ((force[0] - force[1]) * adjoint).sum() / (2.0 * small)
    return torch.autograd.grad(along, leaf)[0]


def _faces_force(solid: mesh.HexMesh, traction: Tensor, groups: Groups) -> Tensor:
    """Consistent nodal forces of tractions: integral of N_i t over faces, 2 x 2 Gauss points."""
    quads = mesh.surface_quads(solid).faces
    marks = torch.from_numpy(np.asarray(groups.mask[: solid.num_nodes], np.int64))[quads]
    quads = quads[(marks > 0).all(1) & (marks == marks[:, :1]).all(1)]
    place = 0.5 / np.sqrt(3.0)
    out = torch.zeros_like(traction)
    for s, t in ((0.5 + a * place, 0.5 + b * place) for a in (-1, 1) for b in (-1, 1)):
        shape = torch.tensor([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t])
        along = torch.tensor([[-(1 - t), 1 - t, t, -t], [-(1 - s), -s, s, 1 - s]])
        edges = torch.einsum("dk,fkx->dfx", along.double(), solid.nodes[quads])
        area = 0.25 * torch.linalg.cross(edges[0], edges[1]).norm(dim=1)
        share = area[:, None, None] * shape.double()[None, :, None] * traction[quads[:, :1]]
        out.index_add_(0, quads.reshape(-1), share.reshape(-1, 3))
    return out
