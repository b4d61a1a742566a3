"""The clamped beam as a soft body: mesh, markers, load, one simulated release.

The beam starts straight, at rest and unstrained, as published; gravity acts along the model's -z.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim import mesh, soft
from diffsim.data.beam import TIP_MARKERS, BeamGeometry
from diffsim.systems.soft_body.markers import marker_weights

Array = NDArray[np.float64]
Tick = Callable[[], None]

WEIGHT_AS = ("force", "mass")


@dataclass(frozen=True, kw_only=True)
class Setup:
    """Options of the simulated release, apart from what is identified.

    Attributes:
        cells: Elements along, across and up the bar.
        poissons_ratio: Poisson's ratio of the material [-].
        integrator, dt_s: Integrator and time step [s], see :class:`diffsim.soft.SoftBody`.
        weight_as: A hanging weight is a constant ``force`` (published) or a ``mass`` on the
            upper edge of the tip face.
        rtol: Relative tolerance of every time step's solution [-].
    """

    cells: tuple[int, int, int] = (20, 4, 4)
    poissons_ratio: float = 0.45
    integrator: str = "implicit_euler"
    dt_s: float = 1e-2
    weight_as: str = "force"
    rtol: float = 1e-5

    def __post_init__(self) -> None:
        if self.weight_as not in WEIGHT_AS:
            raise ValueError(f"weight_as must be one of {WEIGHT_AS}, got {self.weight_as!r}")

    def changed(self, **changes: Any) -> Setup:
        """A copy with some entries replaced."""
        return replace(self, **changes)


@dataclass(frozen=True)
class Release:
    """A simulated release of the bar.

    Attributes:
        time_s: Times of the samples after the release, (N,) [s].
        tip_m: (N, 3) displacement of the mean tip marker [m]; carries the gradient.
        nodes_m: (N, num_nodes, 3) places of the kept nodes, without gradient; None: not kept.
    """

    time_s: Array
    tip_m: Tensor
    nodes_m: Tensor | None = None


class Beam:
    """One bar on one mesh; every method is differentiable in the parameters.

    Parameters are a mapping with ``youngs_modulus`` [Pa] and, where there is damping,
    ``rayleigh_beta`` [s] and ``rayleigh_alpha`` [1/s].

    Args:
        bar: Size and material of the bar.
        setup: Numerics and the meaning of the weight.
        load_kg: Mass that hangs from the tip.
    """

    def __init__(self, bar: BeamGeometry, setup: Setup, load_kg: float = 0.0):
        size = (bar.length_m, bar.width_m, bar.height_m)
        self.bar, self.setup, self.load_kg = bar, setup, load_kg
        self.mesh = mesh.hex_box(setup.cells, size, origin=(-bar.length_m, 0.0, 0.0))
        self.face = self.mesh.nodes_near_plane("x", 0.0)
        places = np.array([bar.marker_place_m[name] for name in TIP_MARKERS])
        weights = marker_weights(self.mesh.x_rest[self.face].numpy(), places)
        self._mean = torch.from_numpy(weights.mean(axis=0))
        self._held = self._mean @ self.mesh.x_rest[self.face]
        edge = self._edge_shares()
        gravity = torch.tensor([0.0, 0.0, -bar.gravity_m_s2], dtype=torch.float64)
        is_mass = setup.weight_as == "mass" and load_kg > 0
        self._force = None
        if load_kg > 0 and not is_mass:
            self._force = load_kg * edge[:, None] * gravity
        self.body = soft.SoftBody(
            self.mesh,
            dt=setup.dt_s,
            integrator=setup.integrator,
            youngs_modulus=bar.youngs_modulus_published_Pa,
            poissons_ratio=setup.poissons_ratio,
            density=bar.density_kg_m3,
            gravity=gravity,
            fixed=self.mesh.nodes_near_plane("x", -bar.length_m),
            masses=soft.Masses(attached_mass=load_kg * edge if is_mass else None),
            solver=soft.SolverOptions(rtol=setup.rtol),
        )

    def _edge_shares(self) -> Tensor:
        """(V,) share of a load spread evenly along the upper edge of the tip face; sums to 1."""
        x = self.mesh.x_rest
        tol = 1e-9
        edge = self.mesh.nodes_where(
            lambda p: (p[:, 0].abs() < tol) & ((p[:, 2] - self.bar.height_m).abs() < tol)
        )
        share = torch.ones(len(edge), dtype=torch.float64)
        ends = (x[edge, 1] < tol) | (x[edge, 1] > self.bar.width_m - tol)
        share[ends] = 0.5
        shares = torch.zeros(self.mesh.num_nodes, dtype=torch.float64)
        shares[edge] = share / share.sum()
        return shares

    def tip(self, x: Tensor) -> Tensor:
        """Displacement of the mean tip marker from the held state, (..., 3) [m]."""
        return self._mean @ x[..., self.face, :] - self._held

    def sag(self, parameters: Mapping[str, Tensor | float]) -> Tensor:
        """Static sag of the mean tip marker, positive down, 0-d [m]."""
        state = self.body.static_equilibrium(
            external_force=self._force, physics=self._physics(parameters)
        )
        return -self.tip(state.x)[2]

    def release(
        self,
        parameters: Mapping[str, Tensor | float],
        until_s: float,
        *,
        tick: Tick | None = None,
        keep_nodes: Tensor | None = None,
    ) -> Release:
        """Let go of the straight beam at t = 0.

        Args:
            parameters: Values of the bar's parameters by name, as the class lists them.
            until_s: Time that is simulated after the release [s].
            tick: Called after every step; may raise to stop.
            keep_nodes: Node indices whose places are returned, too.
        """
        num_steps = int(np.ceil(until_s / self.setup.dt_s - 1e-9))
        nodes: list[Tensor] = []

        def keep(state: soft.State) -> Tensor:
            if tick is not None:
                tick()
            if keep_nodes is not None:
                nodes.append(state.x.detach()[keep_nodes])
            return self.tip(state.x)

        trajectory = soft.rollout(
            self.body,
            self.body.rest_state(),
            num_steps,
            external_force=self._force,
            physics=self._physics(parameters),
            keep=keep,
        )
        return Release(
            time_s=np.arange(num_steps + 1, dtype=np.float64) * self.setup.dt_s,
            tip_m=trajectory.x,
            nodes_m=torch.stack(nodes) if nodes else None,
        )

    def _physics(self, parameters: Mapping[str, Tensor | float]) -> soft.Physics:
        return self.body.physics(**parameters)


def timoshenko_sag(bar: BeamGeometry, youngs_modulus: float, poissons_ratio: float) -> float:
    """Tip sag of a clamped Timoshenko beam under its own weight [m].

    q L^4 / (8 E I) + q L^2 / (2 kappa G A), kappa = 10 (1 + nu) / (12 + 11 nu) (Cowper 1966). Its
    clamped section is free to contract sideways, which a clamped solid is not.
    """
    area = bar.width_m * bar.height_m
    inertia = bar.width_m * bar.height_m**3 / 12.0
    load = bar.density_kg_m3 * area * bar.gravity_m_s2
    nu = poissons_ratio
    shear = youngs_modulus / (2.0 * (1.0 + nu)) * 10.0 * (1.0 + nu) / (12.0 + 11.0 * nu) * area
    length = bar.length_m
    return load * length**4 / (8.0 * youngs_modulus * inertia) + load * length**2 / (2.0 * shear)
