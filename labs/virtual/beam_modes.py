"""Timoshenko cantilever by staggered differences, reduced to its lowest modes.

Deflection and rotation at nodes, curvature and shear between them (second order, no locking);
lumped masses. Not the discretization of ``clamped_beam``, and no solid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BeamShape:
    """A bar of silicone foam, clamped at x = 0; SI units.

    Slender, and without lateral contraction: a clamped solid that cannot contract at its root
    bends otherwise than any beam theory, by more than what the laboratory hides.
    """

    length: float = 0.15
    width: float = 0.02  # across the plane of bending
    depth: float = 0.02  # in the plane of bending
    density: float = 1070.0
    poissons_ratio: float = 0.0
    num_cells: int = 80

    @property
    def area(self) -> float:
        """Area of the cross-section [m^2]."""
        return self.width * self.depth

    @property
    def inertia(self) -> float:
        """Second moment of area [m^4]."""
        return self.width * self.depth**3 / 12.0


@dataclass(frozen=True)
class BeamModes:
    """Mass-normalized modes of a bar."""

    x: Array  # nodes without the clamped one, (n,) [m]
    omega: Array  # angular eigenfrequencies of m modes, ascending, (m,) [rad/s]
    # deflection, rotation: at the nodes per modal coordinate, (n, m)
    deflection: Array
    rotation: Array
    curvature: Array  # curvature of each mode in the n cells, (n, m) [1/m]
    cell: float  # length of a cell along the bar [m]
    node_volume: Array  # volume of the bar that belongs to each node, (n,) [m^3]

    def at(self, place: float) -> Array:
        """Deflection at a place [m] per modal coordinate, (m,)."""
        x = np.concatenate([[0.0], self.x])
        full = np.vstack([np.zeros(len(self.omega)), self.deflection])
        return np.array([np.interp(place, x, full[:, i]) for i in range(full.shape[1])])


def beam_modes(
    shape: BeamShape, youngs_modulus: float, added_density: float = 0.0, num_modes: int = 12
) -> BeamModes:
    """Compute the lowest bending modes of a clamped bar.

    Args:
        youngs_modulus: Young's modulus of the bar [Pa].
        added_density: Mass that moves along without inertia of rotation or weight [kg/m^3].
    """
    n, h = shape.num_cells, shape.length / shape.num_cells
    nu = shape.poissons_ratio
    kappa = 10.0 * (1.0 + nu) / (12.0 + 11.0 * nu)  # rectangle, Cowper 1966
    shear = kappa * youngs_modulus / (2.0 * (1.0 + nu)) * shape.area
    forward = (np.eye(n) - np.eye(n, k=-1)) / h  # the clamped node is zero
    middle = 0.5 * (np.eye(n) + np.eye(n, k=-1))
    zero = np.zeros((n, n))
    bend, slide = np.hstack([zero, forward]), np.hstack([forward, -middle])
    stiffness = h * (youngs_modulus * shape.inertia * bend.T @ bend + shear * slide.T @ slide)
    share = np.ones(n)
    share[-1] = 0.5
    mass = np.concatenate(
        [
            (shape.density + added_density) * shape.area * h * share,
            shape.density * shape.inertia * h * share,
        ]
    )
    square, phi = linalg.eigh(stiffness, np.diag(mass), subset_by_index=[0, num_modes - 1])
    return BeamModes(
        x=np.linspace(h, shape.length, n),
        omega=np.sqrt(square),
        deflection=phi[:n],
        rotation=phi[n:],
        curvature=forward @ phi[n:],
        cell=h,
        node_volume=shape.area * h * share,
    )
