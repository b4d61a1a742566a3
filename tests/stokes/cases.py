"""Exact Stokes flows in embedded geometry, and small problems with every kind of input."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim import stokes


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


@dataclass
class Exact:
    """A level set with the velocity that solves the Stokes equations in its fluid."""

    grid: stokes.Grid
    phi: Tensor
    velocity: Callable[[Tensor], Tensor]
    wall: str = "no_slip"
    wall_velocity: Tensor | None = None

    def solve(self, **options) -> tuple[float, stokes.FlowField]:
        """Relative error over the nodes in the fluid (root mean square), with the exact velocity
        prescribed on the box."""
        flow = stokes.StokesFlow(
            self.grid, [stokes.Inlet(f) for f in self.grid.faces], wall=self.wall, **options
        )
        values = {f: self.velocity(flow.inlet_positions(f)) for f in self.grid.faces}
        field = flow(self.phi, values, wall_velocity=self.wall_velocity)
        inside = self.phi > 0
        exact = self.velocity(self.grid.nodes)[inside]
        return float((field.velocity[0][inside] - exact).norm() / exact.norm()), field


def channel(n: int, angle: float = 0.3, width: float = 0.5) -> Exact:
    """Poiseuille flow in a channel at an angle to the grid."""
    grid = stokes.Grid((n, n), size=1.0)
    center = tensor(0.503, 0.507)
    along = tensor(math.cos(angle), math.sin(angle))
    across = tensor(-math.sin(angle), math.cos(angle))

    def velocity(x: Tensor) -> Tensor:
        return (1.0 - (2.0 * ((x - center) @ across) / width) ** 2)[..., None] * along

    return Exact(grid, width / 2 - ((grid.nodes - center) @ across).abs(), velocity)


def couette(n: int, inner: float = 0.35, outer: float = 0.8) -> Exact:
    """Flow between a turning inner and a resting outer circle; the annulus is inside the box."""
    grid = stokes.Grid((n, n), size=2.0, origin=(-1.0, -1.0))
    center = tensor(0.01, 0.02)
    a = -(inner**2) / (outer**2 - inner**2)
    b = -a * outer**2

    def turn(x: Tensor) -> Tensor:
        return torch.stack([center[1] - x[..., 1], x[..., 0] - center[0]], dim=-1)

    def velocity(x: Tensor) -> Tensor:
        r = (x - center).norm(dim=-1).clamp(min=0.05)
        return (a + b / r**2)[..., None] * turn(x)

    r = (grid.nodes - center).norm(dim=-1)
    wall = turn(grid.nodes) * (r < 0.5 * (inner + outer))[..., None]
    return Exact(grid, torch.minimum(r - inner, outer - r), velocity, wall_velocity=wall)


def rotation(n: int) -> Exact:
    """Rigid rotation in a disk with a slip wall."""
    grid = stokes.Grid((n, n), size=2.0, origin=(-1.0, -1.0))
    center = tensor(0.01, 0.02)

    def velocity(x: Tensor) -> Tensor:
        return torch.stack([center[1] - x[..., 1], x[..., 0] - center[0]], dim=-1)

    phi = 1.2 - (grid.nodes - center).norm(dim=-1)
    return Exact(grid, phi, velocity, wall="no_separation")


def pipe(n: int, wall: str, radius: float = 0.3) -> Exact:
    """Hagen-Poiseuille ("no_slip") or plug flow ("no_separation") in an inclined pipe."""
    grid = stokes.Grid((n, n, n // 2), size=(1.0, 1.0, 0.5))
    center = tensor(0.503, 0.507, 0.251)
    along = tensor(math.sin(0.3), math.sin(0.2), 1.0)
    along = along / along.norm()

    def distance(x: Tensor) -> Tensor:
        y = x - center
        return (y - (y @ along)[..., None] * along).norm(dim=-1)

    def velocity(x: Tensor) -> Tensor:
        speed = 1.0 - (distance(x) / radius) ** 2
        return (speed if wall == "no_slip" else torch.ones_like(speed))[..., None] * along

    return Exact(grid, radius - distance(grid.nodes), velocity, wall=wall)


def bubble(n: int, radius: float = 0.23) -> Exact:
    """Flow past a sphere that slips (Hadamard 1911, without viscosity inside)."""
    grid = stokes.Grid((n, n, n), size=1.0)
    center, along = tensor(0.503, 0.497, 0.508), tensor(1.0, 0.0, 0.0)

    def velocity(x: Tensor) -> Tensor:
        r = (x - center).norm(dim=-1, keepdim=True).clamp(min=0.05)
        normal = (x - center) / r
        near = radius / (2.0 * r)
        return (1.0 - near) * along - near * (normal @ along)[..., None] * normal

    distance = (grid.nodes - center).norm(dim=-1)
    return Exact(grid, distance - radius, velocity, wall="no_separation")


def small_flow(dim: int, **options) -> stokes.StokesFlow:
    """A box of a few cells with an inlet and an open face."""
    shape, spacing = ((5, 4), (0.2, 0.25)) if dim == 2 else ((4, 3, 3), (0.2, 0.25, 0.22))
    grid = stokes.Grid(shape, spacing)
    return stokes.StokesFlow(
        grid, [stokes.Inlet("x-"), stokes.Open("x+")], bulk_ratio=1e3, **options
    )


def small_inputs(flow: stokes.StokesFlow, cases: int = 2) -> dict[str, Tensor]:
    """Rough inputs of ``small_flow``, all with gradient."""
    grid, generator = flow.grid, torch.Generator().manual_seed(0)

    def rough(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    x = grid.nodes
    phi = 0.31 - (x[..., 1] - 0.5 * grid.size[1] + 0.1 * x[..., 0]).abs()
    inputs = {
        "phi": phi + 0.02 * rough(*grid.node_shape),
        "inlet": rough(cases, len(flow.boundary.inlets["x-"]), grid.dim),
        "viscosity": tensor(1.7),
        "wall_velocity": rough(cases, *grid.node_shape, grid.dim),
        "body_force": rough(*grid.node_shape, grid.dim),
        "traction": rough(cases, *grid.node_shape, grid.dim),
    }
    return {name: value.requires_grad_() for name, value in inputs.items()}
