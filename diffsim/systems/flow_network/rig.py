"""A channel device on one grid: the flow solver, and how its openings and sensors are read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from diffsim.stokes import FlowField, Grid, Inlet, Open, StokesFlow
from diffsim.stokes.devices.losses import integral, on_face
from diffsim.systems.flow_network.corrections import FlowDerivatives
from diffsim.systems.flow_network.device import ChannelDevice, Opening
from diffsim.systems.flow_network.grid_fits import DEEP, MovingFit, average_corners, integrate_face


class FlowRig:
    """Device on its grid; scenes of all runs share it.

    Args:
        device: Device to be simulated.
        refine: Factor on the cell size (``Numerics.mesh``).
    """

    def __init__(self, device: ChannelDevice, refine: float = 1.0):
        self.device = device
        self.grid = Grid([max(1, round(n / refine)) for n in device.cells], size=device.size)
        if device.drive == "flow":
            inlets = [
                Inlet("x-", f"in_{i + 1}", self._select_inlet_nodes(i))
                for i in range(len(device.inlets))
            ]
            faces: list[Inlet | Open] = [*inlets, Open("x+")]
        else:
            faces = [Open("x-"), Open("x+")]
        # long channels raise much pressure: the usual 1e5 would lose 0.3 % of the flow on its way;
        # above, rounding errors grow in proportion
        self.solver = StokesFlow(self.grid, faces, viscosity=device.viscosity, bulk_ratio=1e6)
        self.phi = device.level_set(self.grid.nodes)
        self.width = device.local_width(self.grid.nodes)
        heights = self.grid.nodes[0, :, 1]
        self.inlet_masks = [
            _mark_between(heights, bounds) for bounds in _divide_openings(device.inlets)
        ]
        self.outlet_masks = [
            _mark_between(heights, bounds) for bounds in _divide_openings(device.outlets)
        ]
        self._known: tuple[Tensor, FlowDerivatives] | None = None

    def _select_inlet_nodes(self, inlet: int) -> Callable[[Tensor], Tensor]:
        """The inlet's nodes on its face: those in the fluid and one beyond each wall, on which the
        velocity goes on smoothly."""
        opening = self.device.inlets[inlet]
        reach = 0.5 * opening.width + 1.01 * self.grid.spacing[1]
        return lambda points: (points[:, 1] - opening.y).abs() < reach

    def derivatives(self, phi: Tensor) -> FlowDerivatives:
        """Derivative stencils of a shape; the last ones are kept. Their sources are cells whose
        center is in the fluid: velocities beyond the wall are held by little."""
        phi = phi.detach()
        level = average_corners(phi) / max(self.grid.spacing)
        fluid, inside = level > 0.0, level > DEEP
        # All that the stencils depend on: small moves of the walls leave them.
        key = torch.cat([m.reshape(-1) for m in (phi > 0.0, fluid, inside)])
        known = self._known  # read once: threads may share the rig
        if known is None or not torch.equal(known[0], key):
            known = key, FlowDerivatives(self.grid, phi, fluid, inside)
            self._known = known
        return known[1]

    def inflow(
        self, phi: Tensor, flow: Tensor, skew: Tensor, offset: Tensor, slip: Tensor
    ) -> dict[str, Tensor]:
        """Inlet velocities with exactly the given flows: developed profiles, leaned by the skew.

        Args:
            phi: Level set at the nodes, (*node_shape,) [m].
            flow: Flow through each inlet at each level, (levels, num_inlets) [m^2/s].
            skew: Velocity at the upper wall's side over that at the lower's, s of
                u (1 + s (y - y0) / (w / 2)) [-].
            offset: Distance by which both walls move outwards [m].
            slip: Slip length at the walls [m].
        """
        values = {}
        for i, (name, nodes) in enumerate(self.solver.boundary.inlets.items()):
            opening = self.device.inlets[i]
            y = self.grid.nodes.reshape(-1, 2)[nodes, 1] - opening.y
            width = opening.width + 2.0 * offset
            shape = (0.25 * width**2 + width * slip - y**2) * (1.0 + skew * y / (0.5 * width))
            through = torch.zeros(self.grid.num_nodes, dtype=torch.float64)
            through = through.index_copy(0, nodes, shape)
            unit = integrate_face(self.grid, phi, through.reshape(1, *self.grid.node_shape), "x-")
            along = flow[:, i, None] * shape / unit
            values[name] = torch.stack([along, torch.zeros_like(along)], -1)
        return values

    def traction(self, inlet_pressure: Tensor | None, outlet_pressure: Tensor) -> Tensor:
        """Traction -p n on the open faces, (levels, *node_shape, 2) [Pa].

        Args:
            inlet_pressure: (levels, num_inlets) [Pa]; None where pumps prescribe flows.
            outlet_pressure: Pressure beyond each outlet, (num_outlets,) [Pa].
        """
        right = -(outlet_pressure[:, None] * torch.stack(self.outlet_masks)).sum(0)[None]
        left = torch.zeros_like(right)
        if inlet_pressure is not None:
            left = (inlet_pressure[:, :, None] * torch.stack(self.inlet_masks)).sum(1)
            right = right.expand_as(left)
        middle = right.new_zeros(len(right), self.grid.shape[0] - 1, right.shape[-1])
        along = torch.cat([left[:, None], middle, right[:, None]], 1)
        return torch.stack([along, torch.zeros_like(along)], -1)

    def outlet_flows(self, field: FlowField) -> Tensor:
        """(levels, num_outlets) [m^2/s]."""
        out = on_face(self.grid, field.velocity[..., 0], "x+")
        return torch.stack([integral(field, "x+", out * mask) for mask in self.outlet_masks], -1)

    def tap_pressures(self, field: FlowField) -> Tensor:
        """Pressure at the inlets' taps, (levels, num_inlets) [Pa]."""
        cells, fit = self._taps
        return fit.at(field.pressure.flatten(1)[:, cells])

    @cached_property
    def _taps(self) -> tuple[Tensor, MovingFit]:
        """Cells well inside the fluid, whatever small wall offsets do, and the fit at the taps."""
        inside = average_corners(self.phi) > DEEP * max(self.grid.spacing)
        cells = inside.reshape(-1).nonzero()[:, 0]
        sources = self.grid.centers.reshape(-1, 2)[cells].numpy()
        return cells, MovingFit(sources, self.device.tap_points, min(self.grid.spacing))

    def profile(self, field: FlowField) -> Tensor:
        """Velocity along the last branch at its stations, (levels, num_profile_points) [m/s]."""
        return field.sample(torch.from_numpy(self.device.profile_points))[..., 0]


def _divide_openings(openings: Sequence[Opening]) -> list[tuple[float, float]]:
    """Bounds in y that part the openings of one side: middles of the walls between them [m]."""
    middles = [0.5 * (below.high + above.low) for below, above in pairwise(openings)]
    return list(zip([-np.inf, *middles], [*middles, np.inf], strict=True))


def _mark_between(heights: Tensor, bounds: tuple[float, float]) -> Tensor:
    low, high = bounds
    return ((heights > low) & (heights <= high)).to(torch.float64)
