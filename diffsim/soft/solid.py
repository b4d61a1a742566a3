"""What a soft body is: mesh, material, actuators, boundary conditions and its prepared solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from diffsim.core.check import (
    require,
    require_choice,
    require_constant,
    require_count,
    require_indices,
    require_number,
)
from diffsim.core.module import Float64Module
from diffsim.core.torch_names import on_constants
from diffsim.core.values import as_array
from diffsim.mesh import (
    HexMesh,
    TetMesh,
    nodal_shares,
    nodal_volume,
    surface_vertices,
)
from diffsim.soft._context import SoftContext
from diffsim.soft.chambers import ChamberSet, PressureChamber
from diffsim.soft.elements import element_tables, require_element
from diffsim.soft.integrators import INTEGRATORS
from diffsim.soft.materials import Material
from diffsim.soft.muscles import Muscle, MuscleSet
from diffsim.soft.options import ContactOptions, Damping, Masses, SolverOptions
from diffsim.soft.parameters import Value, as_tensor, hold
from diffsim.soft.physics import (
    PARAMETERS,
    PER_ELEMENT,
    LumpedVolume,
    PhysicalValues,
    Physics,
    make_physics,
    require_distinct,
    require_physics,
)
from diffsim.soft.plausible import warn_of_locking, warn_of_units
from diffsim.soft.rest_shape import RestShape, moved_shape
from diffsim.soft.state import State


class Solid(Float64Module):
    """What a :class:`~diffsim.soft.SoftBody` is, without what can be done with it.

    Functions of bodies (``step``, ``static_equilibrium``, ...) take this. The arguments are those
    of :class:`~diffsim.soft.SoftBody`.
    """

    x_rest: Tensor
    fixed: Tensor
    contact_nodes: Tensor
    nodal_volume: Tensor
    nodal_shares: Tensor

    def __init__(
        self,
        mesh: HexMesh | TetMesh,
        *,
        dt: float,
        youngs_modulus: Value,
        poissons_ratio: Value,
        density: Value = 1000.0,
        material: str | Material = "pd",
        element: str | None = None,
        gravity: Value = (0.0, 0.0, -9.81),
        fixed: Tensor | None = None,
        muscles: Sequence[Muscle] = (),
        chambers: Sequence[PressureChamber] = (),
        damping: Damping | None = None,
        masses: Masses | None = None,
        contact: ContactOptions | None = None,
        integrator: str = "implicit_euler",
        solver: SolverOptions | None = None,
    ):
        super().__init__()
        if not isinstance(mesh, (HexMesh, TetMesh)):
            raise TypeError(f"mesh must be a HexMesh or TetMesh, got {type(mesh).__name__}")
        damping = _options("damping", damping, Damping)
        masses = _options("masses", masses, Masses)
        contact = _options("contact", contact, ContactOptions)
        require_constant("mesh.x_rest", mesh.x_rest, "parameters of a shape move its mesh")
        self.mesh = mesh
        self.dt = require_number("dt", dt, above=0.0, hint="unit is s")
        require_number("dt", self.dt, at_least=1e-15, at_most=1e9, hint="unit is s")
        self.integrator = require_choice("integrator", integrator, INTEGRATORS)
        self.material = material if isinstance(material, Material) else Material(material)
        self.element = require_element(element, mesh)
        self.solver = _options("solver", solver, SolverOptions)
        with on_constants():
            self.muscles = MuscleSet(muscles, mesh.num_elements)
            self.chambers = ChamberSet(chambers, mesh)
            # Not in the state_dict, which would change them behind the prepared solver's back.
            # A copy: a gradient asked of the body's must not mark the mesh's.
            self.register_buffer("x_rest", mesh.x_rest.clone(), persistent=False)
            self.register_buffer("fixed", _dirichlet_mask(fixed, mesh.num_nodes), persistent=False)
            nodes = _contact_nodes(contact.contact_nodes, mesh, self.fixed)
            self.register_buffer("contact_nodes", nodes, persistent=False)
            self.max_depenetration_speed = contact.max_depenetration_speed
            self.register_buffer("nodal_volume", nodal_volume(mesh), persistent=False)
            self.register_buffer("nodal_shares", nodal_shares(mesh), persistent=False)
        beta = damping.rayleigh_beta
        given = {
            "youngs_modulus": youngs_modulus,
            "poissons_ratio": poissons_ratio,
            "density": density,
            "gravity": gravity,
            "rayleigh_alpha": damping.rayleigh_alpha,
            # A plain zero means "no damping", which needs no damping terms at all.
            "rayleigh_beta": None if _is_zero(beta) else beta,
            "attached_mass": masses.attached_mass,
            "added_mass": masses.added_mass,
            "node_mass": masses.node_mass,
            "fiber_stiffness": self.muscles.stiffness,
        }
        given |= {name: getattr(self.material, name) for name in self.material.constants}
        for name, value in given.items():
            hold(self, name, value)
        self.physics()  # refuse bad parameters now, not at the first step
        modulus = as_tensor("youngs_modulus", youngs_modulus)
        warn_of_units(self.x_rest, modulus, as_tensor("density", density))
        if element is None:
            warn_of_locking(mesh, as_tensor("poissons_ratio", poissons_ratio))
        self._context = self._make_context()
        self.kept: Any = None  # see prepared.py

    def _make_context(self) -> SoftContext:
        with on_constants():
            return SoftContext(
                material=self.material.law,
                tables=element_tables(self.mesh, self.element),
                x_rest=self.mesh.x_rest,
                fiber_elements=self.muscles.elements,
                fiber_directions=self.muscles.directions,
                fiber_pull_only=self.muscles.pull_only,
                chambers=self.chambers,
                fixed=self.fixed,
            )

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k not in ("_context", "kept")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._context = self._make_context()  # compiled objects are made anew in this process
        self.kept = None

    @property
    def handle(self) -> int:
        """Handle of the prepared solver; the ops take this number."""
        return self._context.handle

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes of arrays by name, such as "num_nodes" and "num_muscles"."""
        return {**self._context.sizes, "num_muscles": self.muscles.num_muscles}

    def physics(
        self, *, batch: Value | None = None, x_rest: Tensor | None = None, **overrides: Value
    ) -> Physics:
        """The body's parameters, some replaced; give the result to :meth:`forward` or ``rollout``.

        Args:
            x_rest: Rest shape in place of the mesh's, (num_nodes, 3) [m]: masses, muscles'
                directions, tendons' lengths and the prescribed positions at rest follow it. One
                for a whole batch.
            batch: Number of members of a batch of states. Then each override may lead with a batch
                axis: one number per member is (batch,) or (batch, 1), a number per member and
                element (batch, num_elements). None: one set for all.
            **overrides: Any of youngs_modulus, poissons_ratio, density, gravity, rayleigh_alpha,
                rayleigh_beta, attached_mass, added_mass, node_mass, fiber_stiffness, as in the
                constructor (fiber_stiffness: (num_muscles,) [Pa], see :class:`Muscle`), and of the
                material's own constants.

        Returns:
            :class:`~diffsim.soft.Physics`. Gradients: all overrides.
        """
        members = None if batch is None else require_count("batch", batch, at_least=1)
        own = self.material.constants
        values = {name: getattr(self, name) for name in (*PARAMETERS, *own)}
        for name, value in overrides.items():
            require_choice("physics override", name, tuple(values))
            values[name] = None if value is None else as_tensor(name, value)
            if members is not None and name in (*PER_ELEMENT, *own):
                sizes = {"num_elements": self.mesh.num_elements}
                if name == "density":
                    sizes["num_nodes"] = self.mesh.num_nodes
                require_distinct(name, values[name], members, sizes)
        shares, nodal = self.nodal_shares, self.nodal_volume
        shape = None if x_rest is None else self._shape(x_rest, members)
        if shape is not None:
            shares, nodal = shape.shares, shape.nodal
        volume = LumpedVolume(elements=self.mesh.elements, shares=shares, nodal=nodal)
        constants = {name: values.pop(name) for name in own}
        given = PhysicalValues(**values, constants=constants)
        made = make_physics(
            given, volume, self.material, self.muscles.num_muscles, members, element=self.element
        )
        if shape is None:
            return made
        return replace(
            made, x_rest=shape.x_rest, tables=shape.tables, fiber_weights=shape.fiber_weights
        )

    def _shape(self, x_rest: Tensor, members: int | None) -> RestShape:
        """A rest shape in place of the mesh's."""
        if members is not None:
            raise ValueError(
                "x_rest cannot be given with batch: members share their shape; take torch.func.vmap"
                " over physics(x_rest=...), or call once for each shape"
            )
        return moved_shape(self.mesh, self.element, self.muscles, as_tensor("x_rest", x_rest))

    def own_values(self) -> dict[str, Tensor]:
        """The body's parameters by name, as they were given; what it does not have is missing."""
        names = (*PARAMETERS, *self.material.constants)
        return {n: v for n in names if (v := getattr(self, n)) is not None}

    def rest_state(self, batch: int | None = None, *, physics: Physics | None = None) -> State:
        """The rest shape without motion, that of ``physics`` where it has one; ``batch`` adds a
        leading axis. Gradient: ``x_rest`` of physics."""
        moved = None
        if physics is not None:
            require_physics(physics, self.sizes, self.material.law)
            moved = physics.x_rest
        x = (self.x_rest if moved is None else moved).clone()
        if batch is not None:
            x = x.expand(batch, -1, -1).contiguous()
        return State(x, torch.zeros_like(x))

    def extra_repr(self) -> str:
        """What ``print(body)`` shows."""
        return (
            f"{self.mesh.kind} mesh, {self.mesh.num_elements} elements, "
            f"{3 * self.mesh.num_nodes} DoF ({int(self.fixed.sum())} fixed), "
            f"material {self.material.law}, {self.element} elements, "
            f"{self.muscles.num_muscles} muscles, {self.chambers.num_chambers} chambers, "
            f"{self.integrator}, dt = {self.dt:g} s, "
            f"solver {self.solver.method}"
        )


_Options = TypeVar("_Options")


def _options(name: str, given: _Options | None, kind: type[_Options]) -> _Options:
    """Options of a kind, or its defaults."""
    if given is None:
        return kind()
    if not isinstance(given, kind):
        raise TypeError(f"{name} must be a {kind.__name__}, got {type(given).__name__}")
    return given


def _is_zero(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and value == 0


def _dirichlet_mask(fixed: Tensor | None, num_nodes: int) -> Tensor:
    """(num_nodes, 3) bool from the accepted forms of ``fixed``."""
    mask = torch.zeros(num_nodes, 3, dtype=torch.bool)
    if fixed is None:
        return mask
    if not isinstance(fixed, Tensor):  # a list or an array: of indices, or of True and False
        fixed = as_array("fixed", fixed, torch.bool if _is_mask(fixed) else torch.int64)
    if fixed.dtype == torch.bool:
        if fixed.ndim == 1:
            return mask | require("fixed", fixed, (num_nodes,), torch.bool)[:, None]
        return mask | require("fixed", fixed, (num_nodes, 3), torch.bool)
    nodes = require("fixed", fixed, ("k",), torch.int64)
    mask[require_indices("fixed", nodes, num_nodes, "nodes")] = True
    return mask


def _is_mask(given: Any) -> bool:
    """Whether a list or an array holds True and False rather than indices."""
    try:
        return np.asarray(given).dtype.kind == "b"
    except ValueError:  # rows of different lengths: neither, which ``as_array`` says
        return False


def _contact_nodes(given: Tensor | None, mesh: HexMesh | TetMesh, fixed: Tensor) -> Tensor:
    """(k,) int64; nodes with Dirichlet conditions follow these, not obstacles."""
    held = fixed.any(1)
    if given is None:
        surface = surface_vertices(mesh)
        return surface[~held[surface]]
    given = as_array("contact_nodes", given, torch.int64)
    nodes = require("contact_nodes", given, ("k",), torch.int64)
    require_indices("contact_nodes", nodes, mesh.num_nodes, "nodes")
    if len(nodes.unique()) < len(nodes):
        raise ValueError("contact_nodes must not name a node twice; use contact_nodes.unique()")
    if bool(held[nodes].any()):
        raise ValueError(
            f"contact_nodes must have no Dirichlet condition, got {int(held[nodes].sum())} fixed "
            f"ones, first node {int(nodes[held[nodes]][0])}; leave them out"
        )
    return nodes
