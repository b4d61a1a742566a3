"""Loads that stand for what linear flow with one viscosity and resting walls leaves out.

Each term is evaluated on the flow before and applied as a body force, a wall velocity or a moved
wall; repeated, the flow converges to that of the extended equations. Gradients pass to the flow and
to the sizes. Two dimensions.
"""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor

from diffsim.stokes import Grid
from diffsim.systems.flow_network.grid_fits import MovingFit

MAX_SWEEPS = 60  # of linear flow under loads of the flow before


class FlowDerivatives:
    """Derivatives of grid flows, at cells and nodes of the fluid.

    Args:
        grid: Two-dimensional grid of the device.
        phi: Level set at the nodes; results are given at all nodes of cells with fluid.
        fluid: Cells whose velocities are used, (nx, ny) bool.
        inside: Cells whose pressures are used, (nx, ny) bool.
    """

    def __init__(self, grid: Grid, phi: Tensor, fluid: Tensor, inside: Tensor):
        self.grid, self.cells = grid, fluid.reshape(-1).nonzero()[:, 0]
        # a node belongs to a cell with fluid if it or one of its eight neighbors is in the fluid
        wet = (phi > 0.0).to(torch.float64)[None, None]
        touched = torch.nn.functional.max_pool2d(wet, 3, stride=1, padding=1)[0, 0] > 0.0
        self.nodes = touched.reshape(-1).nonzero()[:, 0]
        self.centers = grid.centers.reshape(-1, 2)[self.cells]
        targets = grid.nodes.reshape(-1, 2)[self.nodes]
        spacing = min(grid.spacing)
        self.fit = MovingFit(self.centers.numpy(), targets.numpy(), spacing)
        self.inside = inside.reshape(-1).nonzero()[:, 0]
        around = torch.nn.functional.max_pool2d(wet, 7, stride=1, padding=3)[0, 0] > 0.0
        self.around = around.reshape(-1).nonzero()[:, 0]  # walls may move by two cells

    @cached_property
    def fit_inside(self) -> MovingFit:
        """Of what is known in ``inside``, at the nodes ``around``."""
        sources = self.grid.centers.reshape(-1, 2)[self.inside]
        targets = self.grid.nodes.reshape(-1, 2)[self.around]
        return MovingFit(sources.numpy(), targets.numpy(), min(self.grid.spacing))

    def gradient(self, velocity: Tensor) -> Tensor:
        """d v_i / d x_j at the centers of fluid cells, (cases, 2, 2, num_fluid_cells) [1/s].

        Args:
            velocity: Velocity at the nodes, (cases, *node_shape, 2) [m/s].
        """
        dx, dy = self.grid.spacing
        along_x, along_y = velocity.diff(dim=1) / dx, velocity.diff(dim=2) / dy
        along_x = 0.5 * (along_x[:, :, 1:] + along_x[:, :, :-1])
        along_y = 0.5 * (along_y[:, 1:] + along_y[:, :-1])
        gradient = torch.stack([along_x, along_y], -1)  # (cases, nx, ny, i, j)
        return gradient.flatten(1, 2)[:, self.cells].permute(0, 2, 3, 1)

    def viscous_force(self, gradient: Tensor, extra_viscosity: Tensor) -> Tensor:
        """div(2 eta' D(v)) at the nodes, (cases, *node_shape, 2) [N/m^3].

        Args:
            gradient: Velocity gradient in fluid cells, as ``gradient`` returns it.
            extra_viscosity: eta' in fluid cells, (cases or 1, num_fluid_cells) [Pa s].
        """
        stress = extra_viscosity[:, None, None] * (gradient + gradient.transpose(1, 2))
        force = self.fit.along(0, stress[:, :, 0]) + self.fit.along(1, stress[:, :, 1])
        return self._spread(force)

    def convection(self, velocity: Tensor, gradient: Tensor) -> Tensor:
        """(v . grad) v at the nodes, (cases, *node_shape, 2) [m/s^2]."""
        at_nodes = self.fit.at(gradient)  # (cases, i, j, nodes)
        speed = velocity.flatten(1, 2)[:, self.nodes].transpose(1, 2)
        return self._spread((at_nodes * speed[:, None]).sum(2))

    def slip_velocity(self, gradient: Tensor, phi: Tensor) -> Tensor:
        """Tangential part of d v / d n at the nodes, n into the fluid: wall velocity over slip
        length (Navier), (cases, *node_shape, 2) [1/s]."""
        shear = self.fit.at(gradient)
        spacings = [float(h) for h in self.grid.spacing]
        normal = torch.stack(torch.gradient(phi, spacing=spacings), -1)
        normal = normal.reshape(-1, 2)[self.nodes].T
        normal = normal / normal.norm(dim=0).clamp(min=1e-12)  # a ridge deep inside has none
        along = (shear * normal).sum(2)
        tangential = along - normal * (along * normal).sum(1, keepdim=True)
        return self._spread(tangential)

    def pressure_at_nodes(self, pressure: Tensor) -> Tensor:
        """A cell field (cases, nx, ny) at the nodes in the fluid and three around it,
        (cases, *node_shape); zero elsewhere."""
        at_nodes = self.fit_inside.at(pressure.flatten(1)[:, None, self.inside])
        return self._spread(at_nodes, self.around)[..., 0]

    def _spread(self, at_nodes: Tensor, nodes: Tensor | None = None) -> Tensor:
        """(cases, components, nodes) -> (cases, *node_shape, components)."""
        nodes = self.nodes if nodes is None else nodes
        cases, components, _ = at_nodes.shape
        full = at_nodes.new_zeros(cases, self.grid.num_nodes, components)
        full = full.index_copy(1, nodes, at_nodes.transpose(1, 2))
        return full.reshape(cases, *self.grid.node_shape, components)


def shear_rate_squared(gradient: Tensor) -> Tensor:
    """2 D:D of velocity gradients (cases, 2, 2, n), (cases, n) [1/s^2]."""
    twice = gradient + gradient.transpose(1, 2)
    return 0.5 * (twice**2).sum((1, 2))
