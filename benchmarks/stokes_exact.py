"""Stokes flows with closed solutions in embedded geometry, for benchmarks and tests."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from diffsim.stokes.boundary import Inlet, Open
from diffsim.stokes.field import FlowField
from diffsim.stokes.grid import Grid

Points = Callable[[Tensor], Tensor]


@dataclass(frozen=True, kw_only=True)
class Exact:
    """A flow known in closed form; points are (..., 2) [m]."""

    name: str  # what tables and legends call it
    wall: str  # "no_slip" or "no_separation"
    level: Points  # level set, > 0 in the fluid [m]
    velocity: Points  # (..., 2) [m/s], smooth beyond the wall as well
    wall_velocity: Points | None = None  # of the embedded wall, (..., 2) [m/s]; None at rest
    faces: tuple[str, ...] = ()  # faces of the box with the exact velocity prescribed
    size: float = 1.0  # edge of the square box [m]
    origin: tuple[float, float] = (0.0, 0.0)  # its low corner [m]
    open_faces: tuple[str, ...] = field(default=())

    def grid(self, cells: int) -> Grid:
        return Grid((cells, cells), size=self.size, origin=self.origin)

    def conditions(self) -> list[Inlet | Open]:
        return [*map(Inlet, self.faces), *map(Open, self.open_faces)]

    def inlets(self, grid: Grid) -> dict[str, Tensor]:
        """Exact velocities on the prescribed faces."""
        positions = grid.nodes.reshape(-1, 2)
        return {face: self.velocity(positions[grid.face_nodes(face)]) for face in self.faces}

    def solve(self, flow, grid: Grid) -> FlowField:
        """The flow by a layer made for ``grid`` and ``conditions()``."""
        moving = None if self.wall_velocity is None else self.wall_velocity(grid.nodes)
        return flow(self.level(grid.nodes), self.inlets(grid), wall_velocity=moving)

    def error(self, found: FlowField) -> float:
        """Relative L2 error of the first case's velocity over the nodes in the fluid."""
        inside = found.phi.detach() > 0
        wanted = self.velocity(found.grid.nodes)[inside]
        return float((found.velocity[0].detach()[inside] - wanted).norm() / wanted.norm())


def _around(points: Tensor, center: Tensor) -> tuple[Tensor, Tensor]:
    """Distance to a center (at least 0.05), and the unit vector counter-clockwise around it."""
    arm = points - center
    radius = arm.norm(dim=-1).clamp(min=0.05)
    return radius, torch.stack([-arm[..., 1], arm[..., 0]], -1) / radius[..., None]


def pipe(wall: str = "no_slip", inner: float = 0.12, outer: float = 0.9) -> Exact:
    """A quarter bend between arcs about the origin, from the side x = 0 to y = 0.

    No slip: v_theta = A r + B / r + r ln r, with v = 0 at both radii, driven by a pressure linear
    in the angle. Slip: v_theta = r, the only such flow without shear at both walls; its pressure is
    constant.
    """
    if wall == "no_slip":
        radii = torch.tensor([inner, outer], dtype=torch.float64)
        matrix = torch.stack([radii, 1.0 / radii], dim=-1)
        a, b = torch.linalg.solve(matrix, -radii * radii.log()).tolist()
    center = torch.zeros(2, dtype=torch.float64)

    def velocity(points: Tensor) -> Tensor:
        r, direction = _around(points, center)
        speed = r if wall == "no_separation" else a * r + b / r + r * r.log()
        return speed[..., None] * direction

    def level(points: Tensor) -> Tensor:
        r = (points - center).norm(dim=-1)
        return torch.minimum(r - inner, outer - r)

    return Exact(
        name="pipe, no slip" if wall == "no_slip" else "pipe, slip",
        wall=wall,
        level=level,
        velocity=velocity,
        faces=("x-", "y-"),
    )


def rotated_channel(angle: float = 0.3, width: float = 0.5) -> Exact:
    """Poiseuille flow across the box, at an angle to the grid; exact velocity on the box."""
    normal = torch.tensor([-math.sin(angle), math.cos(angle)], dtype=torch.float64)
    along = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    center = torch.tensor([0.503, 0.507], dtype=torch.float64)

    def velocity(points: Tensor) -> Tensor:
        return (1.0 - (2.0 * ((points - center) @ normal) / width) ** 2)[..., None] * along

    return Exact(
        name="rotated channel",
        wall="no_slip",
        level=lambda points: 0.5 * width - ((points - center) @ normal).abs(),
        velocity=velocity,
        faces=("x-", "x+", "y-", "y+"),
    )


def couette(inner: float = 0.35, outer: float = 0.8) -> Exact:
    """Between a turning and a resting circle; the pressure is constant."""
    center = torch.tensor([0.01, 0.02], dtype=torch.float64)
    a = -(inner**2) / (outer**2 - inner**2)
    b = -a * outer**2

    def velocity(points: Tensor) -> Tensor:
        r, direction = _around(points, center)
        return (a * r + b / r)[..., None] * direction

    def wall_velocity(points: Tensor) -> Tensor:
        r, direction = _around(points, center)
        return (r * (r < 0.5 * (inner + outer)))[..., None] * direction

    def level(points: Tensor) -> Tensor:
        r = (points - center).norm(dim=-1)
        return torch.minimum(r - inner, outer - r)

    return Exact(
        name="Couette",
        wall="no_slip",
        level=level,
        velocity=velocity,
        wall_velocity=wall_velocity,
        size=2.0,
        origin=(-1.0, -1.0),
    )


def bubble(radius: float = 0.23) -> Exact:
    """Flow past a disk with a slip wall; exact velocity on the box.

    Stream function psi = r ln(r / a) sin(angle): no velocity through the wall and no shear on it.
    """
    center = torch.tensor([0.503, 0.507], dtype=torch.float64)

    def velocity(points: Tensor) -> Tensor:
        arm = points - center
        r = arm.norm(dim=-1).clamp(min=0.05)
        log, cosine, sine = (r / radius).log(), arm[..., 0] / r, arm[..., 1] / r
        return torch.stack([log + sine**2, -sine * cosine], dim=-1)

    return Exact(
        name="disk, slip",
        wall="no_separation",
        level=lambda points: (points - center).norm(dim=-1) - radius,
        velocity=velocity,
        faces=("x-", "x+", "y-", "y+"),
    )


def all_flows() -> list[Exact]:
    return [pipe(), pipe("no_separation"), bubble(), rotated_channel(), couette()]
