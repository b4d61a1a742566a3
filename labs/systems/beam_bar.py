"""The laboratory's bar as a described soft body, and what its mesh is known to miss."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.linalg import expm
from scipy.optimize import brentq
from torch import Tensor

from diffsim.identify.numerics import Numerics
from diffsim.systems.description import BaseParameters
from diffsim.systems.soft_body.described import DescribedModel
from diffsim.systems.soft_body.description import SoftBodyDescription
from diffsim.systems.soft_body.rig import SOFT_CABLE_N
from diffsim.systems.soft_body.scene import SoftScene

if TYPE_CHECKING:
    from diffsim.data.study import Run

SMALL = 1e-3  # tip displacement over length of the trials that corrections come from
POWER_ITERATIONS = 4  # each leaves a fortieth of the second mode


@dataclass(frozen=True)
class BarShape:
    """Along x, bending in y; SI units."""

    # length, depth, width: length along x, depth in the plane of bending and width across it [m]
    length: float
    depth: float
    width: float
    density: float  # density of the material [kg/m^3]
    poissons_ratio: float  # Poisson's ratio of the material [-]
    youngs_modulus: float  # that corrections are made for; they hardly depend on it [Pa]

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
    """A described bar with a rod that pulls on one side and one that pushes on the other.

    A pair gives the moment of one tendon without compressing the bar.

    Args:
        shape: Size and material of the bar.
        cells: Elements along, in the plane of bending (even) and across.
        arm: Distance of the laboratory's tendon from the bar's axis [m].
        command: Name of the command with the tension [N].
        dt_s: Time step [s].
        rtol: Relative tolerance of every time step's solution [-].
    """

    def __init__(
        self,
        shape: BarShape,
        cells: tuple[int, int, int],
        arm: float,
        command: str,
        dt_s: float,
        rtol: float,
    ):
        if cells[1] % 2:
            raise ValueError(f"cells: an even number in the plane of bending, got {cells}")
        self.shape, self.dt_s = shape, dt_s
        # the layer of elements nearest to half way out, so that refining keeps the arm
        layer = shape.depth / cells[1]
        out = layer * (max(0, round(0.25 * shape.depth / layer - 0.5)) + 0.5)
        self._per_moment = 0.5 / (out * SOFT_CABLE_N)
        given = SoftBodyDescription.model_validate(
            {
                "system": "soft_body",
                "body": {
                    "bar": {"size": [shape.length, shape.depth, shape.width], "cells": list(cells)}
                },
                "material": {
                    "youngs_modulus": {"value": shape.youngs_modulus, "percent": 10},
                    "poissons_ratio": shape.poissons_ratio,
                    "density": {"value": shape.density, "percent": 1},
                    "rayleigh_beta": {"value": 1e-3, "percent": 30},
                },
                "fixed": [{"x": 0}],
                "gravity": {"vector": [0.0, 0.0, 0.0]},
                "tendons": [
                    self._rod("pull", command, out, 0.5 * arm / out),
                    self._rod("push", command, -out, -0.5 * arm / out),
                ],
                "sliding": {"x": shape.length},
                "markers": {"tip": [shape.length, 0.5 * shape.depth, 0.5 * shape.width]},
                "channels": {"tip": {"markers": "tip", "axis": "y"}},
                "numerics": {"time_step": dt_s, "tolerance": rtol, "correct_mesh": False},
            }
        )
        quantities = given.quantities()
        self._described = DescribedModel(given, None, ("tip",), BaseParameters(quantities, ()))
        self._known = {n: torch.tensor(q.value).double() for n, q in quantities.items()}
        self.body, box = self._described.rig().body, self._described.rig().mesh
        self.axis = torch.stack(
            [box.nodes_near_plane("x", shape.length * i / cells[0]) for i in range(cells[0] + 1)]
        )
        self._rest = box.x_rest[self.axis][:, :, 1].mean(1)

    def _rod(self, name: str, command: str, off_axis: float, gain: float) -> dict[str, Any]:
        y, z = 0.5 * self.shape.depth + off_axis, 0.5 * self.shape.width
        path = [[0.0, y, z], [self.shape.length, y, z]]
        rod = {"name": name, "command": command, "gain": gain, "path": path}
        return {**rod, "means": "force", "pushes": True}

    def scene(self, youngs_modulus: Tensor, rayleigh_beta: Tensor, run: Run) -> SoftScene:
        """A run that begins in equilibrium under its first tension; the axis is observed."""
        values = {
            "youngs_modulus": youngs_modulus * self.softness,
            "rayleigh_beta": rayleigh_beta,
            "density": torch.tensor(self.shape.density * self.lightness, dtype=torch.float64),
        }
        made = self._described.build(self._known | values, run, Numerics())
        return made.changed(observe=self.look, rest_places=None, output_maps=())

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

    @cached_property
    def softness(self) -> float:
        """Tip displacement of the mesh over beam theory's, for a small moment at the tip [-].

        Few cells bend too little (locking): the model's Young's modulus is multiplied by this.
        """
        shape = self.shape
        moment = SMALL * shape.length / shape.tip_of_moment(1.0)
        share = moment * self._per_moment
        x = self._rest_under(
            activation=torch.tensor([1.0 - share, 1.0 + share], dtype=torch.float64)
        )
        tip = float(self.look(x)[-1])
        return tip / shape.tip_of_moment(moment)

    @cached_property
    def lightness(self) -> float:
        """Density by which the first mode swings, as stepped, at beam theory's frequency [-].

        Over the true density, with the corrected Young's modulus. A step of h swings a mode of
        frequency w at (2 / h) atan(w h / 2) (implicit midpoint).
        """
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
