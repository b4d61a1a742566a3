"""Geometry of a planar channel network, its openings and its measuring points."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from diffsim.core.arrays import Array
from diffsim.core.check import require_choice, require_number
from diffsim.core.checked import checked, checked_methods
from diffsim.stokes.shapes import Box, SmoothUnion

DRIVES = ("flow", "pressure")
MIN_GAP_CELLS = 3.0
"""Fewer cells of solid between two branches, and fits near one wall would reach across it."""


@checked
@dataclass(frozen=True)
class Opening:
    """A straight channel along x: an inlet on the left or an outlet branch on the right.

    Attributes:
        y: Height of its axis [m].
        width: Width of the channel [m].
    """

    y: float
    width: float

    def __post_init__(self) -> None:
        require_number("width", self.width, above=0.0)

    @property
    def low(self) -> float:
        """Height of the lower wall [m]."""
        return self.y - 0.5 * self.width

    @property
    def high(self) -> float:
        """Height of the upper wall [m]."""
        return self.y + 0.5 * self.width


@checked_methods
@dataclass(frozen=True, kw_only=True)
class ChannelDevice:
    """Inlets, a manifold across them, and outlet branches in a box.

    The odd sizes keep all straight walls about a quarter of a cell or more from the nodes of the
    grids of 96 and 192 cells: the flow's slope in the wall's place is worth little where nodes are
    passed.

    Attributes:
        inlets, outlets: Channels, from bottom to top.
        size: Size of the box along x and y [m].
        manifold: Lower and upper x of the manifold [m]; it spans all channels in y, and ``fillet``
            more.
        fillet: Width of the blend that rounds the corners where channels meet the manifold [m].
        cells: Number of grid cells along x and y.
        drive: "flow" (pumps prescribe flows) or "pressure" (regulators prescribe pressures).
        viscosity: Nominal viscosity of the fluid [Pa s].
        nominal_drive: A usual level of the command [m^2/s or Pa]; sets the shear rate to which the
            thinning refers.
        num_profile_points: Velocities measured across the middle 84 % of the last branch's width.
    """

    inlets: tuple[Opening, ...] = (Opening(4.566e-3, 1.931e-3),)
    outlets: tuple[Opening, ...] = (
        Opening(2.035e-3, 1.371e-3),
        Opening(4.527e-3, 1.629e-3),
        Opening(7.119e-3, 1.817e-3),
    )
    size: tuple[float, float] = (12e-3, 9e-3)
    manifold: tuple[float, float] = (1.411e-3, 3.713e-3)
    fillet: float = 0.433e-3
    cells: tuple[int, int] = (96, 72)
    drive: str = "flow"
    viscosity: float = 0.1
    nominal_drive: float = 1e-4
    num_profile_points: int = 7

    def __post_init__(self) -> None:
        require_choice("drive", self.drive, DRIVES)
        require_number("viscosity", self.viscosity, above=0.0)
        require_number("nominal_drive", self.nominal_drive, above=0.0)
        if not 0.0 < self.manifold[0] < self.manifold[1] < self.size[0]:
            raise ValueError(
                f"manifold must lie in the box, 0 < x0 < x1 < {self.size[0]:g} m, got "
                f"{self.manifold}"
            )
        spacing = self.size[1] / self.cells[1]
        for name, openings in (("inlets", self.inlets), ("outlets", self.outlets)):
            if not openings:
                raise ValueError(f"{name} must hold one channel or more")
            for below, above in pairwise(openings):
                if above.low - below.high < MIN_GAP_CELLS * spacing:
                    raise ValueError(
                        f"{name} must be ordered from bottom to top with {MIN_GAP_CELLS:g} cells "
                        f"({MIN_GAP_CELLS * spacing:g} m) of solid between them, got "
                        f"{above.low - below.high:g} m; refine cells, or move them"
                    )
            edge = self.fillet + spacing
            if openings[0].low <= edge or openings[-1].high >= self.size[1] - edge:
                raise ValueError(
                    f"{name} must keep a cell and the fillet, {edge:g} m, from the box's edge"
                )

    @property
    def tap_points(self) -> Array:
        """Pressure taps, (num_inlets, 2) [m]: on the axis of each inlet, halfway in."""
        return np.array([[0.5 * self.manifold[0], inlet.y] for inlet in self.inlets])

    @property
    def profile_points(self) -> Array:
        """Stations of the velocity profile, (num_profile_points, 2) [m]."""
        branch = self.outlets[-1]
        # Not nearer: what the grid says of a velocity on a wall is its error.
        inset = 0.08 * branch.width
        heights = np.linspace(branch.low + inset, branch.high - inset, self.num_profile_points)
        x = 0.5 * (self.manifold[1] + self.size[0])
        return np.stack([np.full_like(heights, x), heights], -1)

    @property
    def shear_rate(self) -> float:
        """6 U / w in the first inlet at the nominal drive [1/s], U from the flow or, where pressure
        drives, from the pressure over the length of the box."""
        width = self.inlets[0].width
        if self.drive == "flow":
            return 6.0 * self.nominal_drive / width**2
        return 0.5 * self.nominal_drive * width / (self.viscosity * self.size[0])

    def level_set(self, points: Tensor) -> Tensor:
        """phi at points (..., 2) [m], > 0 in the fluid: signed distance near straight walls."""
        length, (left, right) = self.size[0], self.manifold
        middle = 0.5 * (left + right)
        low = min(o.low for o in (*self.inlets, *self.outlets)) - self.fillet
        high = max(o.high for o in (*self.inlets, *self.outlets)) + self.fillet
        parts = [_make_rectangle(left, right, low, high)]
        # Channels reach beyond the box and to the middle of the manifold: no wall where they meet.
        parts += [_make_rectangle(-length, middle, o.low, o.high) for o in self.inlets]
        parts += [_make_rectangle(middle, 2.0 * length, o.low, o.high) for o in self.outlets]
        return SmoothUnion(*parts, radius=self.fillet)(points)

    def local_width(self, points: Tensor) -> Tensor:
        """Width of the channel nearest to points (..., 2): of the manifold along x between its ends
        [m]."""
        x, y = points[..., 0], points[..., 1]
        left, right = self.manifold
        width = torch.full_like(x, right - left)
        for side, openings in ((x < left, self.inlets), (x > right, self.outlets)):
            away = torch.stack([(y - o.y).abs() - 0.5 * o.width for o in openings])
            widths = torch.tensor([o.width for o in openings], dtype=x.dtype)
            width = torch.where(side, widths[away.argmin(0)], width)
        return width

    def throat(self, branch: int, points: Tensor) -> Tensor:
        """Region of an outlet branch where something may lodge, (...) in [0, 1]: 1 over the middle
        third of its length, falling to 0 over a width on both sides."""
        opening = self.outlets[branch]
        start, end = self.manifold[1], self.size[0]
        away = (points[..., 0] - 0.5 * (start + end)).abs() - (end - start) / 6.0
        ramp = (away / opening.width).clamp(0.0, 1.0)
        spacing = self.size[1] / self.cells[1]
        near = (points[..., 1] - opening.y).abs() < 0.5 * (opening.width + MIN_GAP_CELLS * spacing)
        return torch.where(near, 0.5 + 0.5 * torch.cos(torch.pi * ramp), 0.0)


def _make_rectangle(left: float, right: float, low: float, high: float) -> Box:
    return Box(
        (right - left, high - low), (0.5 * (left + right), 0.5 * (low + high)), fluid="inside"
    )
