"""Flows of unit size through a channel network, kept by the walls' shape.

A steady slow flow is linear in what drives it. For every shape of the walls the Stokes simulator is
asked once: one factorization, one solve for each independent way through the network. What drives
the flow, the fluid and the sensors are then changed without another solve.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.core.memo import Memo
from diffsim.systems.flow_network.network import NetworkDevice
from diffsim.systems.flow_network.network_flow import NetworkFlow

NUM_LEVELS = 24
"""Of shear in each channel: cells of about the same shear are one group."""
WALL_STEP, NARROWING_STEP = 0.1, 0.05
"""Between shapes that are simulated, in cells and relative; others are interpolated. Smaller than
any change of shape that matters, larger than the kinks of the flow where a wall passes nodes."""


class ChannelShape(NamedTuple):
    """Walls of a network: all outwards [m], slip length [m], narrowing of each branch [-]."""

    offset: Tensor
    slip: Tensor
    narrowing: Tensor


@dataclass(frozen=True, eq=False)
class UnitFlows:
    """Flows with all that the pump gives leaving through one outlet, at the nominal viscosity."""

    # pressure drop from the pump to outlet i per flow to outlet j, (m, m) [Pa s/m^2]
    resistance: Tensor
    tap: Tensor  # pressure drop from the pump to the tap per flow to outlet j, (m,) [Pa s/m^2]
    # products of the strain rates of the unit flows, 2 D_i : D_j, integrated over groups of cells,
    # (groups, m, m) [1/m^2]
    energy: Tensor
    volume: Tensor  # fluid area of the groups, (groups,) [m^2]


class CellGroups(NamedTuple):
    """Cells of one channel with about the same shear, and what they share."""

    of_cell: Tensor  # group of every kept cell, (cells,)
    owner: Tensor  # index of the channel of each group, (groups,)
    height: Tensor  # mean y of the cells of each group, (groups,) [m]
    before_tap: Tensor  # between the two pressure sensors, (groups,) bool
    after_pump: Tensor  # beyond the first of them, (groups,) bool


class UnitFlowTable:
    """Unit flows of any shape: simulated on a lattice of shapes, interpolated smoothly between.

    Args:
        refine: Factor on the cell size [-].
        corrected: Multiply resistances by what halving the cells once changes them in the nominal
            shape, extrapolated to second order (Richardson).
    """

    def __init__(self, device: NetworkDevice, refine: float = 1.0, *, corrected: bool = True):
        self.device, self.refine, self.corrected = device, refine, corrected
        self.flow = NetworkFlow(device, refine)
        # the same on all grids, so that refining changes the flow only
        wall = WALL_STEP * max(s / n for s, n in zip(device.size, device.cells, strict=True))
        self.steps = (wall, wall, NARROWING_STEP)  # of offset, slip and narrowing
        self._recent: Memo[UnitFlows] = Memo(32)
        self._kept: Memo[UnitFlows] = Memo(256)

    def at(self, shape: ChannelShape) -> UnitFlows:
        """Unit flows of a shape; gradients pass to it through the interpolation."""
        if any(part.requires_grad for part in shape):
            return self._interpolate(shape)
        key = tuple(torch.cat([part.reshape(-1) for part in shape]).tolist())
        return self._recent(key, lambda: self._interpolate(shape))

    def _interpolate(self, shape: ChannelShape) -> UnitFlows:
        coordinates = [
            shape.offset / self.steps[0],
            shape.slip / self.steps[1],
            *(shape.narrowing / self.steps[2]).unbind(),
        ]
        axes = [_weigh_neighbors(c) for c in coordinates]
        parts = []
        for corner in product(*axes):
            # a product of two weights that are zero has neither value nor slope
            if sum(float(w.detach()) == 0.0 for _, w in corner) > 1:
                continue
            weight = reduce(lambda a, b: a * b, (w for _, w in corner))
            parts.append((weight, self._solve_flow(tuple(k for k, _ in corner))))
        if len(parts) == 1 and not parts[0][0].requires_grad:
            return parts[0][1]
        return UnitFlows(
            *(
                torch.stack([w * getattr(u, name) for w, u in parts]).sum(0)
                for name in ("resistance", "tap", "energy", "volume")
            )
        )

    @cached_property
    def groups(self) -> CellGroups:
        """Groups of the nominal shape; they serve all shapes."""
        device = self.device
        owner = device.owners(self.flow.centers)
        place = device.coordinates(self.flow.centers)[1][:, 0]
        # the inlet channel in three parts, then the others
        part = torch.where(owner > 0, owner + 2, (place > 0.0).long() + (place > device.tap).long())
        _, _, strain, volume = self._nominal_flows
        shear = (strain**2).sum((1, 2))
        shear = torch.where(volume > 0.0, shear, torch.inf)  # fluid only where walls move out
        of_cell = torch.zeros(len(part), dtype=torch.int64)
        for k in range(int(part.max()) + 1):
            own = (part == k).nonzero()[:, 0]
            rank = shear[own].argsort().argsort()
            of_cell[own] = k * NUM_LEVELS + rank * NUM_LEVELS // max(len(own), 1)
        used, of_cell = torch.unique(of_cell, return_inverse=True)
        part = used // NUM_LEVELS
        area = torch.zeros(len(used), dtype=torch.float64).index_add(0, of_cell, volume)
        moment = torch.zeros_like(area).index_add(0, of_cell, volume * self.flow.centers[:, 1])
        return CellGroups(
            of_cell, (part - 2).clamp(min=0), moment / area.clamp(min=1e-300), part == 1, part > 0
        )

    @cached_property
    def _nominal_flows(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        with torch.no_grad():
            return self.flow.solve(0.0, 0.0, (0.0,) * len(self.device.outlets))

    @cached_property
    def _correction(self) -> tuple[Tensor, Tensor]:
        """Factors on resistance and tap."""
        resistance, tap, *_ = self._nominal_flows
        if not self.corrected:
            return torch.ones_like(resistance), torch.ones_like(tap)
        finer = UnitFlowTable(self.device, 0.5 * self.refine, corrected=False)
        fine_resistance, fine_tap, *_ = finer._nominal_flows
        return (
            (4.0 * fine_resistance / resistance - 1.0) / 3.0,
            (4.0 * fine_tap / tap - 1.0) / 3.0,
        )

    def _solve_flow(self, key: tuple[int, ...]) -> UnitFlows:
        wall, slip, narrowing = self.steps
        return self._kept(
            key,
            lambda: self.simulated(
                key[0] * wall, key[1] * slip, tuple(k * narrowing for k in key[2:])
            ),
        )

    @torch.no_grad()
    def simulated(self, offset: float, slip: float, narrowing: tuple[float, ...]) -> UnitFlows:
        """Unit flows of a shape without interpolation; lengths in [m], narrowing relative."""
        is_nominal = not any((offset, slip, *narrowing))
        resistance, tap, strain, volume = (
            self._nominal_flows if is_nominal else self.flow.solve(offset, slip, narrowing)
        )
        groups, m = self.groups, len(tap)
        count = len(groups.owner)
        products = torch.einsum("csi,csj,c->cij", strain, strain, volume)
        factor, tap_factor = self._correction
        return UnitFlows(
            resistance=resistance * factor,
            tap=tap * tap_factor,
            energy=products.new_zeros(count, m, m).index_add(0, groups.of_cell, products),
            volume=volume.new_zeros(count).index_add(0, groups.of_cell, volume),
        )


def _weigh_neighbors(at: Tensor) -> list[tuple[int, Tensor]]:
    """Whole numbers around a coordinate and their weights: the quintic between two nodes whose
    values, central slopes and central second derivatives it takes, so that both stay continuous.
    Nodes with neither weight nor, where it is asked for, slope are left out."""
    low = int(torch.floor(at.detach()))
    t = at - low
    cube = t**3
    slope_0 = t - cube * (6.0 - t * (8.0 - 3.0 * t))
    slope_1 = -cube * (4.0 - t * (7.0 - 3.0 * t))
    bend_0 = 0.5 * t * t * (1.0 - t) ** 3
    bend_1 = 0.5 * cube * (1.0 - t) ** 2
    value_1 = cube * (10.0 - t * (15.0 - 6.0 * t))
    weights = (
        bend_0 - 0.5 * slope_0,
        1.0 - value_1 - 2.0 * bend_0 - 0.5 * slope_1 + bend_1,
        value_1 + 0.5 * slope_0 + bend_0 - 2.0 * bend_1,
        0.5 * slope_1 + bend_1,
    )
    is_node = float(t.detach()) == 0.0
    needed = (at.requires_grad, True, at.requires_grad, False) if is_node else (True,) * 4
    return [(low - 1 + k, w) for k, w in enumerate(weights) if needed[k]]
