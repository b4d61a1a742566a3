"""A clamped bar on hexahedra, bent by a moment at its tip, and what its mesh is known to miss."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.linalg import expm
from scipy.optimize import brentq
from torch import Tensor

from diffsim import mesh, soft

# Far below the bar's own 100 N per strain: the tendons pull and push, and hardly stiffen.
TENDON_STIFFNESS_N = 0.1
FORCE_ATOL_N = 1e-11  # far below what moves a marker by a noise sd; an unloaded bar has no scale
SMALL = 1e-3  # tip displacement over length of the trials that corrections come from
POWER_ITERATIONS = 4  # each leaves a fortieth of the second mode


@dataclass(frozen=True)
class BarShape:
    """Along x, bending in y; SI units.

    Attributes:
        length, depth, width: Length along x, depth in the plane of bending and width across it [m].
        density: Density of the material [kg/m^3].
        poissons_ratio: Poisson's ratio of the material [-].
        youngs_modulus: That corrections are made for; they hardly depend on it [Pa].
    """

    length: float
    depth: float
    width: float
    density: float
    poissons_ratio: float
    youngs_modulus: float

    @property
    def inertia(self) -> float:
        """Second moment of area [m^4]."""
        return self.width * self.depth**3 / 12.0

    def tip_of_moment(self, moment: float) -> float:
        """Tip displacement under a moment there, M L^2 / (2 E I) [m]."""
        return moment * self.length**2 / (2.0 * self.youngs_modulus * self.inertia)

    def first_frequency(self) -> float:
        """First angular frequency of Timoshenko's cantilever [rad/s].

        Place, slope, moment and shear are carried along by an exponential; shear correction
        10 (1 + nu) / (12 + 11 nu) (Cowper 1966).
        """
        nu, young, area = self.poissons_ratio, self.youngs_modulus, self.depth * self.width
        correction = 10.0 * (1.0 + nu) / (12.0 + 11.0 * nu)
        shear = correction * young / (2.0 * (1.0 + nu)) * area
        mass, rotary = self.density * area, self.density * self.inertia

        def free_end(w: float) -> float:
            rates = np.zeros((4, 4))
            rates[0, 1], rates[0, 3] = 1.0, 1.0 / shear
            rates[1, 2] = 1.0 / (young * self.inertia)
            rates[2, 1], rates[2, 3] = -rotary * w**2, -1.0
            rates[3, 0] = -mass * w**2
            return float(np.linalg.det(expm(rates * self.length)[2:, 2:]))

        slender = 1.8751**2 * np.sqrt(young * self.inertia / mass) / self.length**2
        return float(brentq(free_end, 0.7 * slender, 1.01 * slender))


class TendonBar:
    """A bar with a tendon that pulls on one side and one that pushes on the other.

    A pair gives the moment of one tendon without compressing the bar.

    Args:
        shape: Size and material of the bar.
        cells: Elements along, in the plane of bending (even) and across.
        dt_s, integrator: Time step [s] and integrator of the body.
        rtol: Relative tolerance of every time step's solution [-].
    """

    def __init__(
        self,
        shape: BarShape,
        cells: tuple[int, int, int],
        dt_s: float,
        integrator: str,
        rtol: float,
    ):
        if cells[1] % 2:
            raise ValueError(f"cells: an even number in the plane of bending, got {cells}")
        self.shape, self.dt_s, self.integrator = shape, dt_s, integrator
        length, depth, width = shape.length, shape.depth, shape.width
        box = mesh.hex_box(cells, (length, depth, width))
        # the layer of elements nearest to half way out, so that refining keeps the arm
        layer = depth / cells[1]
        self.arm = layer * (max(0, round(0.25 * depth / layer - 0.5)) + 0.5)
        tendons = [
            soft.Tendon(
                box,
                [[0.0, 0.5 * depth + y, 0.5 * width], [length, 0.5 * depth + y, 0.5 * width]],
                axial_stiffness=TENDON_STIFFNESS_N,
                slack=False,
            )
            for y in (self.arm, -self.arm)
        ]
        self.body = soft.SoftBody(
            box,
            dt=dt_s,
            integrator=integrator,
            youngs_modulus=shape.youngs_modulus,
            poissons_ratio=shape.poissons_ratio,
            density=shape.density,
            gravity=(0.0, 0.0, 0.0),
            damping=soft.Damping(rayleigh_beta=1e-3),
            fixed=box.nodes_near_plane("x", 0.0),
            muscles=[t.muscle for t in tendons],
            solver=soft.SolverOptions(rtol=rtol, atol=FORCE_ATOL_N),
        )
        x = box.x_rest
        self.axis = torch.stack(
            [box.nodes_near_plane("x", length * i / cells[0]) for i in range(cells[0] + 1)]
        )
        self._rest = x[self.axis][:, :, 1].mean(1)
        face = box.nodes_near_plane("x", length)
        self.tip = torch.zeros(box.num_nodes, dtype=torch.float64)
        self.tip[face] = 1.0 / len(face)

    def look(self, x: Tensor) -> Tensor:
        """Displacements in y of the axis at all stations, (..., num_stations) [m]."""
        return x[..., self.axis, 1].mean(-1) - self._rest

    def sideways(self, y: Tensor, places: Tensor) -> Tensor:
        """The same at ``places`` (m,) [m], (..., m), by cubics between stations."""
        spacing = self.shape.length / (len(self.axis) - 1)
        left = (places.detach() / spacing).floor().long().clamp(1, len(self.axis) - 3)
        s = places / spacing - left
        # Lagrange through four stations around the place
        weights = torch.stack(
            [
                -s * (s - 1.0) * (s - 2.0) / 6.0,
                (s + 1.0) * (s - 1.0) * (s - 2.0) / 2.0,
                -(s + 1.0) * s * (s - 2.0) / 2.0,
                (s + 1.0) * s * (s - 1.0) / 6.0,
            ]
        )
        return torch.stack([weights[i] * y[..., left - 1 + i] for i in range(4)]).sum(0)

    def activation(self, moment: Tensor) -> Tensor:
        """Commanded lengths over rest lengths, (..., 2), for a moment (..., 1) [N m]."""
        share = moment / (2.0 * self.arm * TENDON_STIFFNESS_N)
        return torch.cat([1.0 - share, 1.0 + share], -1)

    @cached_property
    def softness(self) -> float:
        """Tip displacement of the mesh over beam theory's, for a small moment at the tip [-].

        Few cells bend too little (locking): the model's Young's modulus is multiplied by this.
        """
        shape = self.shape
        moment = SMALL * shape.length / shape.tip_of_moment(1.0)
        x = self._rest_under(
            activation=self.activation(torch.tensor([moment], dtype=torch.float64))
        )
        tip = float(self.look(x)[-1])
        return tip / shape.tip_of_moment(moment)

    @cached_property
    def lightness(self) -> float:
        """Density by which the first mode swings, as stepped, at beam theory's frequency [-].

        Over the true density, with the corrected Young's modulus. A step of h swings a mode of
        frequency w at (2 / h) atan(w h / 2) (implicit midpoint).
        """
        if self.integrator != "implicit_midpoint":
            raise ValueError(
                f"the bar's corrections are for integrator implicit_midpoint, got {self.integrator}"
            )
        h, wanted = self.dt_s, self.shape.first_frequency()
        needed = 2.0 / h * np.tan(0.5 * wanted * h)
        return float(self.mesh_frequency() ** 2 / needed**2)

    def mesh_frequency(self) -> float:
        """Angular frequency of the mesh's first mode, Young's modulus corrected [rad/s], by power
        iteration."""
        shape = self.shape
        mass = shape.density * self.body.nodal_volume[:, None]
        young = torch.tensor(shape.youngs_modulus * self.softness, dtype=torch.float64)
        shown = torch.zeros_like(self.body.x_rest)
        shown[:, 1] = SMALL * shape.length * (self.body.x_rest[:, 0] / shape.length) ** 2
        guess, squared = shape.first_frequency() ** 2, 0.0
        for _ in range(POWER_ITERATIONS):
            force = guess * mass * shown
            moved = self._still(force, young)
            squared = float((moved * force).sum() / (mass * moved * moved).sum())
            shown = moved * (SMALL * shape.length / moved.abs().max())
        return float(np.sqrt(squared))

    def _still(self, force: Tensor, young: Tensor) -> Tensor:
        physics = self.body.physics(youngs_modulus=young)
        x = self._rest_under(
            external_force=force, physics=physics, activation=torch.ones(2, dtype=torch.float64)
        )
        return x - self.body.x_rest

    def _rest_under(self, **loads: object) -> Tensor:
        with torch.no_grad():
            x: Tensor = self.body.static_equilibrium(**loads).x
        return x
