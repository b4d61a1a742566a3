"""A soft body: mesh, material, actuators and boundary conditions, stepped as a PyTorch layer."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from diffsim.contact import Obstacle
from diffsim.core.check import require, require_choice, require_indices, require_number
from diffsim.mesh import HexMesh, TetMesh, nodal_volume, shape_gradients, surface_vertices
from diffsim.soft._context import SoftContext
from diffsim.soft.chambers import ChamberSet, PressureChamber
from diffsim.soft.forces import elastic_energy, elastic_force
from diffsim.soft.integrators import INTEGRATORS
from diffsim.soft.materials import MATERIALS, VOLUME_WEIGHTS
from diffsim.soft.muscles import Muscle, MuscleSet
from diffsim.soft.options import SolverOptions
from diffsim.soft.parameters import Value, as_tensor, hold
from diffsim.soft.physics import Physics, make_physics
from diffsim.soft.state import State
from diffsim.soft.statics import static_equilibrium
from diffsim.soft.step import step

_PARAMETERS = (
    "youngs_modulus",
    "poissons_ratio",
    "density",
    "gravity",
    "rayleigh_alpha",
    "rayleigh_beta",
    "attached_mass",
    "added_mass",
    "node_mass",
    "fibre_stiffness",
)


class SoftBody(nn.Module):
    """Elastic solid on a hexahedral or tetrahedral mesh; calling it takes one time step.

    One of five materials (:mod:`diffsim.soft.materials`) with muscle fibres, tendons, pneumatic
    chambers, gravity, Rayleigh damping, attached and added masses and Dirichlet conditions per node
    and axis. Obstacles are given step by step; water acts through ``external_force``
    (:class:`~diffsim.soft.Hydrodynamics`). Not modelled here: plasticity, anisotropic solids; rest
    positions carry no gradient.

    Physical parameters may be numbers, tensors or ``nn.Parameter``; each can be replaced for one
    call by ``body.physics(name=value)``, with gradient.

    Args:
        mesh: Rest shape, :class:`~diffsim.mesh.HexMesh` or :class:`~diffsim.mesh.TetMesh` [m].
        dt: Time step [s].
        youngs_modulus: Scalar or (num_elements,) [Pa], > 0.
        poissons_ratio: Scalar or (num_elements,) [-], in (-1, 0.5); for ``pd`` in [0, 0.5).
        material: Energy of the solid: ``pd`` (projective dynamics, corotated and volume energies,
            thesis eq. 4.12), ``corotated``, ``stable_neo_hookean``, ``neo_hookean`` or ``stvk``.
        density: Scalar or (num_vertices,) [kg/m^3], > 0.
        integrator: ``implicit_euler``, ``bdf2``, ``implicit_midpoint`` or ``semi_implicit_euler``
            (explicit).
        fixed: Dirichlet set: node indices (k,) int64 (all axes), a mask (num_vertices,) or one per
            axis (num_vertices, 3) bool; None: free.
        muscles: Muscles and tendons, each driven by one activation.
        chambers: Pneumatic chambers, each driven by one pressure.
        gravity: (3,) [m/s^2].
        rayleigh_alpha: Mass-proportional damping, scalar [1/s].
        rayleigh_beta: Stiffness-proportional damping, scalar or (num_elements,) [s]; see
            csrc/kernels/soft/damping.h for its objective form. A number 0 switches it off.
        attached_mass: Point masses on nodes, (num_vertices,) [kg]; they weigh and are inert.
        added_mass: Inertia without weight, of surrounding water say, (num_vertices,) [kg]; see
            :func:`~diffsim.soft.added_mass`.
        node_mass: Nodal masses instead of ``density`` times nodal volume, (num_vertices,) [kg].
        contact_nodes: Nodes that touch obstacles, (k,) int64; None: all surface nodes without
            Dirichlet conditions.
        max_depenetration_speed: Nodes that start inside an obstacle are pushed out no faster
            [m/s].
        volume_weight: Of ``pd``: ``small_strain`` (E, nu in = E, nu out) or ``thesis``, see
            :func:`~diffsim.soft.materials.pd_weights`.
        solver: :class:`~diffsim.soft.SolverOptions`.

    Raises:
        TypeError, ValueError: an argument of wrong type, shape or range; the message names it.
    """

    x_rest: Tensor
    fixed: Tensor
    contact_nodes: Tensor
    nodal_volume: Tensor

    def __init__(
        self,
        mesh: HexMesh | TetMesh,
        *,
        dt: float,
        youngs_modulus: Value,
        poissons_ratio: Value,
        material: str = "pd",
        density: Value = 1000.0,
        integrator: str = "implicit_euler",
        fixed: Tensor | None = None,
        muscles: Sequence[Muscle] = (),
        chambers: Sequence[PressureChamber] = (),
        gravity: Value = (0.0, 0.0, -9.81),
        rayleigh_alpha: Value = 0.0,
        rayleigh_beta: Value = 0.0,
        attached_mass: Tensor | None = None,
        added_mass: Tensor | None = None,
        node_mass: Tensor | None = None,
        contact_nodes: Tensor | None = None,
        max_depenetration_speed: float = math.inf,
        volume_weight: str = "small_strain",
        solver: SolverOptions | None = None,
    ):
        super().__init__()
        if not isinstance(mesh, (HexMesh, TetMesh)):
            raise TypeError(f"mesh must be a HexMesh or TetMesh, got {type(mesh).__name__}")
        self.mesh = mesh
        self.dt = require_number("dt", dt, above=0.0, hint="unit is s")
        self.integrator = require_choice("integrator", integrator, INTEGRATORS)
        self.material = require_choice("material", material, MATERIALS)
        self.volume_weight = require_choice("volume_weight", volume_weight, VOLUME_WEIGHTS)
        if solver is not None and not isinstance(solver, SolverOptions):
            raise TypeError(f"solver must be a SolverOptions, got {type(solver).__name__}")
        self.solver = solver or SolverOptions()
        self.muscles = MuscleSet(muscles, mesh.num_elements)
        self.chambers = ChamberSet(chambers, mesh)
        # Not in the state_dict: loading one would change them behind the prepared solver's back.
        self.register_buffer("x_rest", mesh.x_rest, persistent=False)
        self.register_buffer("fixed", _dirichlet_mask(fixed, mesh.num_vertices), persistent=False)
        self.register_buffer(
            "contact_nodes", _contact_nodes(contact_nodes, mesh, self.fixed), persistent=False
        )
        self.max_depenetration_speed = _depenetration_speed(max_depenetration_speed)
        self.register_buffer("nodal_volume", nodal_volume(mesh), persistent=False)
        given = {
            "youngs_modulus": youngs_modulus,
            "poissons_ratio": poissons_ratio,
            "density": density,
            "gravity": gravity,
            "rayleigh_alpha": rayleigh_alpha,
            # A plain zero means "no damping", which needs no damping terms at all.
            "rayleigh_beta": None if _is_zero(rayleigh_beta) else rayleigh_beta,
            "attached_mass": attached_mass,
            "added_mass": added_mass,
            "node_mass": node_mass,
            "fibre_stiffness": self.muscles.stiffness,
        }
        for name, value in given.items():
            hold(self, name, value)
        self.physics()  # refuse bad parameters now, not at the first step
        self._context = self._make_context()

    def _make_context(self) -> SoftContext:
        shape = shape_gradients(self.mesh)
        return SoftContext(
            is_hex=self.mesh.kind == "hex",
            material=self.material,
            elements=self.mesh.elements,
            grad=shape.grad,
            weight=shape.weight,
            class_idx=shape.class_idx,
            x_rest=self.mesh.x_rest,
            fibre_elements=self.muscles.elements,
            fibre_directions=self.muscles.directions,
            fibre_pull_only=self.muscles.pull_only,
            chambers=self.chambers,
            fixed=self.fixed,
        )

    def __getstate__(self) -> dict:
        return {k: v for k, v in self.__dict__.items() if k != "_context"}

    def __setstate__(self, state: dict) -> None:
        super().__setstate__(state)
        self._context = self._make_context()  # compiled objects are made anew in this process

    @property
    def handle(self) -> int:
        """Handle of the prepared solver, as the ops take it."""
        return self._context.handle

    def physics(self, **overrides: Value) -> Physics:
        """The body's parameters, some replaced; give the result to :meth:`forward` or ``rollout``.

        Args:
            **overrides: Any of youngs_modulus, poissons_ratio, density, gravity, rayleigh_alpha,
                rayleigh_beta, attached_mass, added_mass, node_mass, fibre_stiffness, as in the
                constructor (fibre_stiffness: (num_muscles,) [Pa], see :class:`Muscle`).

        Returns:
            :class:`~diffsim.soft.Physics`. Gradients: all overrides.
        """
        values = {name: getattr(self, name) for name in _PARAMETERS}
        for name, value in overrides.items():
            require_choice("physics override", name, _PARAMETERS)
            values[name] = None if value is None else as_tensor(name, value)
        return make_physics(
            num_elements=self.mesh.num_elements,
            num_muscles=self.muscles.num_muscles,
            nodal_volume=self.nodal_volume,
            material=self.material,
            volume_weight=self.volume_weight,
            **values,
        )

    def rest_state(self, batch: int | None = None) -> State:
        """The rest shape without motion; ``batch`` adds a leading axis."""
        x = self.x_rest.clone()
        if batch is not None:
            x = x.expand(batch, -1, -1).contiguous()
        return State(x, torch.zeros_like(x))

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

    def static_equilibrium(self, **inputs) -> State:
        """Rest under load; see :func:`diffsim.soft.static_equilibrium`."""
        return static_equilibrium(self, **inputs)

    def elastic_force(self, x: Tensor, **inputs) -> Tensor:
        """-d(E - p V)/dx; see :func:`diffsim.soft.elastic_force`."""
        return elastic_force(self, x, **inputs)

    def elastic_energy(self, x: Tensor, **inputs) -> Tensor:
        """E(x) - p V(x); see :func:`diffsim.soft.elastic_energy`."""
        return elastic_energy(self, x, **inputs)

    def extra_repr(self) -> str:
        """What ``print(body)`` shows."""
        return (
            f"{self.mesh.kind} mesh, {self.mesh.num_elements} elements, "
            f"{3 * self.mesh.num_vertices} DoF ({int(self.fixed.sum())} fixed), "
            f"material {self.material}, "
            f"{self.muscles.num_muscles} muscles, {self.chambers.num_chambers} chambers, "
            f"{self.integrator}, dt = {self.dt:g} s, "
            f"solver {self.solver.method}"
        )


def _is_zero(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and value == 0


def _dirichlet_mask(fixed: Tensor | None, num_vertices: int) -> Tensor:
    """(num_vertices, 3) bool from the accepted forms of ``fixed``."""
    mask = torch.zeros(num_vertices, 3, dtype=torch.bool)
    if fixed is None:
        return mask
    if not isinstance(fixed, Tensor):
        raise TypeError(f"fixed must be a torch.Tensor, got {type(fixed).__name__}")
    if fixed.dtype == torch.bool:
        if fixed.ndim == 1:
            return mask | require("fixed", fixed, (num_vertices,), torch.bool)[:, None]
        return mask | require("fixed", fixed, (num_vertices, 3), torch.bool)
    nodes = require("fixed", fixed, ("k",), torch.int64)
    mask[require_indices("fixed", nodes, num_vertices, "vertices")] = True
    return mask


def _contact_nodes(given: Tensor | None, mesh: HexMesh | TetMesh, fixed: Tensor) -> Tensor:
    """(k,) int64; nodes with Dirichlet conditions follow these, not obstacles."""
    held = fixed.any(1)
    if given is None:
        surface = surface_vertices(mesh)
        return surface[~held[surface]]
    nodes = require("contact_nodes", given, ("k",), torch.int64)
    require_indices("contact_nodes", nodes, mesh.num_vertices, "vertices")
    if len(nodes.unique()) < len(nodes):
        raise ValueError("contact_nodes must not name a node twice; use contact_nodes.unique()")
    if bool(held[nodes].any()):
        raise ValueError(
            f"contact_nodes must have no Dirichlet condition, got {int(held[nodes].sum())} fixed "
            f"ones, first node {int(nodes[held[nodes]][0])}; leave them out"
        )
    return nodes


def _depenetration_speed(value: float) -> float:
    if value == math.inf:
        return value
    return require_number("max_depenetration_speed", value, above=0.0, hint="unit is m/s")
