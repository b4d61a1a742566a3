"""A soft body: mesh, material, actuators and boundary conditions, stepped as a PyTorch layer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from diffsim.contact import Obstacle
from diffsim.soft.forces import elastic_energy, elastic_force
from diffsim.soft.physics import Physics
from diffsim.soft.solid import Solid
from diffsim.soft.state import State
from diffsim.soft.statics import static_equilibrium
from diffsim.soft.step import step


class SoftBody(Solid):
    """Elastic solid on a hexahedral or tetrahedral mesh; calling it takes one time step.

    One of the materials of :mod:`diffsim.soft.materials` with muscle fibers, tendons, pneumatic
    chambers, gravity, Rayleigh damping, attached and added masses and Dirichlet conditions per node
    and axis. Obstacles are given step by step; water acts through ``external_force``
    (:class:`~diffsim.soft.Hydrodynamics`). Not modeled here: plasticity, anisotropic solids.

    Physical parameters may be numbers, tensors or ``nn.Parameter``; each can be replaced for one
    call by ``body.physics(name=value)``, with gradient.

    Args:
        mesh: Rest shape, :class:`~diffsim.mesh.HexMesh` or :class:`~diffsim.mesh.TetMesh` [m].
        dt: Time step [s].
        youngs_modulus: Young's modulus, scalar or (num_elements,) [Pa], > 0.
        poissons_ratio: Poisson's ratio, scalar or (num_elements,) [-], in (-1, 0.5); for ``pd`` in
            [0, 0.5).
        density: Mass per rest volume, scalar, (num_elements,) or (num_nodes,) [kg/m^3], > 0.
        material: Energy of the solid: ``pd`` (projective dynamics, corotated and volume energies,
            thesis eq. 4.12), another of ``MATERIALS``, or a :class:`~diffsim.soft.Material`.
        element: One of ``ELEMENTS``, see :mod:`diffsim.soft.elements`: ``assumed_strain`` for
            hexahedra that bend and that are nearly incompressible; None: ``standard``.
        gravity: Acceleration of free fall, (3,) [m/s^2].
        fixed: Dirichlet set: node indices (k,) int64 (all axes), a mask (num_nodes,) or one per
            axis (num_nodes, 3) bool; None: free.
        muscles: Muscles and tendons, each driven by one activation.
        chambers: Pneumatic chambers, each driven by one pressure.
        damping: Rayleigh damping, :class:`~diffsim.soft.Damping`; None: no damping.
        masses: Masses of nodes besides the solid's, :class:`~diffsim.soft.Masses`; None: none.
        contact: Which nodes meet obstacles, :class:`~diffsim.soft.ContactOptions`; None: all free
            surface nodes.
        integrator: ``implicit_euler``, ``bdf2``, ``implicit_midpoint`` or ``semi_implicit_euler``
            (explicit).
        solver: Solver and tolerances, :class:`~diffsim.soft.SolverOptions`; None: its defaults.

    Example::

        damping = Damping(rayleigh_beta=2e-3)
        body = SoftBody(mesh, dt=0.01, youngs_modulus=1e5, poissons_ratio=0.4, damping=damping)

    Raises:
        TypeError, ValueError: an argument of wrong type, shape or range; the message names it.
    """

    def forward(
        self,
        state: State,
        *,
        external_force: Tensor | None = None,
        activation: Tensor | None = None,
        pressure: Tensor | None = None,
        dirichlet_target: Tensor | None = None,
        obstacles: Sequence[Obstacle] | Obstacle | None = None,
        physics: Physics | None = None,
    ) -> State:
        """One time step; see :func:`diffsim.soft.step`."""
        return step(
            self,
            state,
            external_force=external_force,
            activation=activation,
            pressure=pressure,
            dirichlet_target=dirichlet_target,
            obstacles=obstacles,
            physics=physics,
        )

    def static_equilibrium(self, **inputs: Any) -> State:
        """Rest under load; see :func:`diffsim.soft.static_equilibrium`."""
        return static_equilibrium(self, **inputs)

    def elastic_force(self, x: Tensor, **inputs: Any) -> Tensor:
        """-d(E - p V)/dx; see :func:`diffsim.soft.elastic_force`."""
        return elastic_force(self, x, **inputs)

    def elastic_energy(self, x: Tensor, **inputs: Any) -> Tensor:
        """E(x) - p V(x); see :func:`diffsim.soft.elastic_energy`."""
        return elastic_energy(self, x, **inputs)
