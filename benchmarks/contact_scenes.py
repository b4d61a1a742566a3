"""The scenes of benchmarks/contact.py: thesis 4.1.5 "Simulation with Contact" and Table 4.1."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from benchmarks.soft_scenes import Pass, mean, timed_pass, weighted_loss
from diffsim import contact, mesh, soft

RADIUS = 0.05  # of the rolling sphere [m]
WIDTH, OBSTACLE_RADIUS = 0.4, 0.5  # of the napkin, of what it falls on [m]
GAP, FALL_SPEED = 2e-3, 0.63  # at the napkin's start [m], [m/s]: after a fall of 2 cm
ROLLING_DT, NAPKIN_DT = 5e-3, 2e-3  # [s]


def rolling_sphere(spacing: float, contrast: float = 1.0) -> soft.SoftBody:
    """A ball of 5 cm radius, E = 2 MPa, nu = 0.4, that touches z = 0 at one node.

    Args:
        spacing: Edge length of the hexahedra at the surface [m].
        contrast: The half x > 0 is so many times stiffer.
    """
    return _rolling(mesh.hex_sphere(RADIUS, spacing, (0.0, 0.0, RADIUS)), contrast)


def voxel_sphere(cells: int = 10) -> soft.SoftBody:
    """The same of cubes, as in the thesis: those of ``cells``^3 whose center lies in the ball.

    10 cells give the thesis's 552 hexahedra.
    """
    ball = mesh.sdf.sphere(RADIUS, (0.0, 0.0, RADIUS))
    bounds = ((-RADIUS, -RADIUS, 0.0), (RADIUS, RADIUS, 2.0 * RADIUS))
    return _rolling(mesh.hex_from_sdf(ball, bounds, 2.0 * RADIUS / cells))


def _rolling(ball: mesh.HexMesh, contrast: float = 1.0) -> soft.SoftBody:
    stiff = ball.x_rest[ball.elements].mean(1)[:, 0] > 0.0
    return soft.SoftBody(
        ball,
        dt=ROLLING_DT,
        youngs_modulus=2e6 * torch.where(stiff, contrast, 1.0).double(),
        poissons_ratio=0.4,
        density=1e3,
        material=soft.Material(volume_weight="thesis"),
    )


def rolling_state(body: soft.SoftBody, *, slide: bool = False) -> tuple[Tensor, Tensor]:
    """Positions and velocities of rolling at 10 rad/s about y; leaves that want a gradient.

    With ``slide`` the ball moves as fast but does not turn.
    """
    x = body.x_rest.clone()
    spin = torch.tensor([0.0, 10.0, 0.0], dtype=x.dtype).expand_as(x)
    center = torch.tensor([0.0, 0.0, RADIUS], dtype=x.dtype).expand_as(x)
    v = torch.linalg.cross(spin, center if slide else x)
    return x.requires_grad_(), v.requires_grad_()


def rolling_pass(
    body: soft.SoftBody, num_steps: int, friction: float = math.inf, *, slide: bool = False
) -> Pass:
    """Forward and backward of the random loss of the final state, timed."""
    x, v = rolling_state(body, slide=slide)
    ground = contact.floor(friction=friction)

    def forward() -> tuple[Tensor, tuple[Tensor, Tensor]]:
        end = soft.rollout(body, soft.State(x, v), num_steps, obstacles=ground).final
        return weighted_loss(end), (x, v)

    return timed_pass(forward)


def napkin(cells: int, reach: float, solver: soft.SolverOptions | None = None) -> soft.SoftBody:
    """A napkin of ``cells`` x ``cells`` x 1 hexahedra of 0.4 x 0.4 m, E = 0.4 MPa, nu = 0.45.

    It lies 2 mm above the obstacle and has its curvature; its thickness is a cell's width. (The
    thesis drops a flat one; but one cell thick it is too stiff to stay on the obstacle with more
    than its middle.) Nodes of its lower side may touch that lie within ``reach`` half widths of
    the center: 0.4, 0.8, 1 and 1.6 are the thesis's 6, 24, 38 and 50 % of all nodes.
    """
    size = WIDTH / cells
    sheet = mesh.hex_box((cells, cells, 1), (WIDTH, WIDTH, size), (-WIDTH / 2, -WIDTH / 2, 0.0))
    x = sheet.x_rest
    r = x[:, :2].norm(dim=1)
    touching = (x[:, 2] < 0.5 * size) & (r <= reach * WIDTH / 2)
    angle, away = r / OBSTACLE_RADIUS, OBSTACLE_RADIUS + GAP + x[:, 2]
    out = torch.where(r > 0, away * torch.sin(angle) / r.clamp(min=1e-12), 1.0)
    bent = torch.cat([out[:, None] * x[:, :2], (away * torch.cos(angle))[:, None]], dim=1)
    return soft.SoftBody(
        mesh.HexMesh(bent, sheet.hexes),
        dt=NAPKIN_DT,
        youngs_modulus=4e5,
        poissons_ratio=0.45,
        density=1e3,
        material=soft.Material(volume_weight="thesis"),
        contact=soft.ContactOptions(contact_nodes=torch.nonzero(touching).flatten()),
        solver=solver,
    )


def falling(body: soft.SoftBody) -> soft.State:
    """The napkin at rest in its shape, falling at 0.63 m/s."""
    v = torch.zeros_like(body.x_rest)
    v[:, 2] = -FALL_SPEED
    return soft.State(body.x_rest.clone(), v)


def ball_obstacle(friction: float = math.inf) -> contact.Obstacle:
    """What the napkin falls on."""
    return contact.sphere(OBSTACLE_RADIUS, friction=friction)


VARIANTS: dict[str, dict[str, Any]] = {
    "auto": {"method": "auto"},
    "newton_pcg": {"method": "newton_pcg"},
    "uncached": {"method": "newton_pcg", "cache_columns": False},
    "newton_cholesky": {"method": "newton_cholesky"},
    "newton_jacobi": {"method": "newton_jacobi"},
}
"""Solvers compared; ``uncached`` is newton_pcg that makes columns of A^-1 anew for every set."""


def solver(variant: str, rtol: float) -> soft.SolverOptions:
    """Solver options that let an unconverged solve pass; it is marked in the results."""
    return soft.SolverOptions(rtol=rtol, on_failure="warn", **VARIANTS[variant])


def contact_counts(solves: list[soft.SolveStats]) -> dict[str, float]:
    """Contacts, and changes of their statuses, mean per step."""
    names = ("num_contacts", "num_slipping", "num_set_changes", "num_cycles")
    return {name: mean([float(getattr(s, name)) for s in solves]) for name in names}


def about(body: soft.SoftBody) -> dict[str, Any]:
    """Sizes."""
    return {
        "num_dof": 3 * body.mesh.num_nodes,
        "num_elements": body.mesh.num_elements,
        "num_contact_nodes": len(body.contact_nodes),
    }
