"""Physical parameters of a body, expanded to what the kernels read, once per rollout."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffsim.core.check import require, require_range, require_shape
from diffsim.core.module import loadable
from diffsim.soft.elements import hourglass_weights
from diffsim.soft.materials import Material, small_strain_moduli


@loadable
@dataclass(frozen=True, kw_only=True)
class Physics:
    """Per-element and per-node parameters; every tensor may carry a gradient.

    Where a parameter was given for each member of a batch, all tensors lead with that batch axis.

    Attributes:
        material: Energy of the solid, see :mod:`diffsim.soft.materials`.
        weights: The material's element parameters, then those of hourglass strains where the
            element has some, (num_weights, num_elements) [Pa].
        mass: Nodal inertia, attached and added masses included, (num_nodes,) [kg].
        weighing_mass: What gravity acts on: ``mass`` without added mass, (num_nodes,) [kg].
        gravity: Acceleration of free fall, (3,) [m/s^2].
        rayleigh_alpha: Damping proportional to ``mass``, scalar [1/s].
        rayleigh_beta: Stiffness-proportional damping, scalar or (num_elements,) [s]; None: none.
        fiber_stiffness: Stiffness of each muscle, (num_muscles,) [Pa].
        x_rest: Rest shape in place of the mesh's, (num_nodes, 3) [m]; None: the mesh's.
        tables: What kernels know of it, see :mod:`diffsim.soft.rest_shape`; None: of the mesh.
        fiber_weights: Factors of the fibers' stiffness that it gives, (num_fibers,); None: those
            of the muscles.
    """

    material: str
    weights: Tensor
    mass: Tensor
    weighing_mass: Tensor
    gravity: Tensor
    rayleigh_alpha: Tensor
    rayleigh_beta: Tensor | None
    fiber_stiffness: Tensor
    x_rest: Tensor | None = None
    tables: Tensor | None = None
    fiber_weights: Tensor | None = None

    @property
    def batch(self) -> int | None:
        """Members of the batch that parameters were given for; None: one set for all."""
        return self.mass.shape[0] if self.mass.ndim == 2 else None

    def damping(self, kappa: float) -> DampingWeights | None:
        """Weights of damping beta K of a velocity kappa (x - x_velocity); None without damping.

        mu and lambda are those that the elastic energy has at small strain, so that damping is
        beta K whatever the material and the volume weight's convention.

        Args:
            kappa: Velocity per displacement [1/s].
        """
        if self.rayleigh_beta is None:
            return None
        rate = self.rayleigh_beta * kappa
        moduli = small_strain_moduli(self.material, self.weights)
        return DampingWeights(mu=rate * moduli.two_mu, lame_lambda=rate * moduli.lame_lambda)


_FITS = "_fits"
"""Attribute of a :class:`Physics` that is no field: which bodies its fields were checked for."""

_AXES = {
    "weights": ("num_weights", "num_elements"),
    "mass": ("num_nodes",),
    "weighing_mass": ("num_nodes",),
    "fiber_stiffness": ("num_muscles",),
}
_LIMITS = {
    "mass": {"above": 0.0},
    "weighing_mass": {"at_least": 0.0},
    "fiber_stiffness": {"above": 0.0},
    "rayleigh_alpha": {"at_least": 0.0},
    "rayleigh_beta": {"at_least": 0.0},
}


class DampingWeights(NamedTuple):
    """Damping of elements: beta kappa 2 mu and beta kappa lambda, (num_elements,) [Pa]."""

    mu: Tensor
    lame_lambda: Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class PhysicalValues:
    """Physical parameters of a body as they are given: numbers as tensors, not yet expanded.

    ``body.physics`` takes the same names; meaning, shape and unit as in
    :class:`~diffsim.soft.SoftBody` and its options; ``constants`` are those of its material besides
    E and nu.
    """

    youngs_modulus: Tensor
    poissons_ratio: Tensor
    density: Tensor
    gravity: Tensor
    rayleigh_alpha: Tensor
    rayleigh_beta: Tensor | None
    attached_mass: Tensor | None
    added_mass: Tensor | None
    node_mass: Tensor | None
    fiber_stiffness: Tensor
    constants: Mapping[str, Tensor]


PER_ELEMENT = ("youngs_modulus", "poissons_ratio", "density", "rayleigh_beta")
PARAMETERS = tuple(f.name for f in fields(PhysicalValues) if f.name != "constants")


@dataclass(frozen=True, kw_only=True, eq=False)
class LumpedVolume:
    """Volume of a mesh, lumped to its nodes."""

    elements: Tensor  # nodes of each element, (num_elements, 8 or 4) int64
    shares: Tensor  # volume of each element lumped to its nodes, (num_elements, 8 or 4) [m^3]
    nodal: Tensor  # volume of each node, (num_nodes,) [m^3]

    def mass(self, density: Tensor, batch: int | None = None) -> Tensor:
        """Lumped mass, (num_nodes,), or (batch, num_nodes) of a density per member [kg].

        Args:
            density: Scalar, (num_nodes,) or (num_elements,) [kg/m^3].
            batch: Members of a batch that the density may be given for, (batch,) or with a leading
                batch axis; None: it may not.
        """
        num_elements, num_nodes = len(self.elements), len(self.nodal)
        shape = tuple(density.shape) if isinstance(density, Tensor) else ()
        if batch is not None and shape not in ((), (num_nodes,), (num_elements,)):
            return self._mass_of_members(density, batch)
        if shape not in ((), (num_nodes,), (num_elements,)):
            raise ValueError(
                f"density must be a scalar or have shape (num_nodes,) = ({num_nodes},) or "
                f"(num_elements,) = ({num_elements},), got {shape}"
            )
        if shape and num_elements == num_nodes:
            raise ValueError(
                f"density of shape {shape} may be of elements or of vertices: the mesh has as many "
                "of both; pass a scalar, or node_mass instead"
            )
        if shape == (num_elements,):
            return self._mass_of_elements(density)
        density = _repeat_for_batch("density", density, num_nodes, "num_nodes")
        return _checked_density(density) * self.nodal

    def _mass_of_members(self, density: Tensor, batch: int) -> Tensor:
        """(batch, num_nodes) [kg]."""
        num_elements, num_nodes = len(self.elements), len(self.nodal)
        shape = tuple(density.shape)
        if shape in ((batch,), (batch, 1)):
            density = require("density", density, shape).reshape(batch, 1)
            return _checked_density(density) * self.nodal
        if shape == (batch, num_nodes) and num_nodes != num_elements:
            return _checked_density(require("density", density, shape)) * self.nodal
        if shape != (batch, num_elements) or num_nodes == num_elements:
            raise ValueError(
                f"density of members must have shape ({batch},), ({batch}, num_nodes) = "
                f"({batch}, {num_nodes}) or ({batch}, num_elements) = ({batch}, {num_elements}),"
                f" got {shape}; where a mesh has as many elements as vertices, pass node_mass"
            )
        return self._mass_of_elements(density)

    def _mass_of_elements(self, density: Tensor) -> Tensor:
        """(..., num_nodes) [kg] of densities (..., num_elements)."""
        density = _checked_density(require("density", density, tuple(density.shape)))
        masses = (density[..., None] * self.shares).flatten(-2)
        none = self.nodal.new_zeros(*density.shape[:-1], len(self.nodal))
        return none.index_add(-1, self.elements.flatten(), masses)


def make_physics(
    values: PhysicalValues,
    volume: LumpedVolume,
    material: Material,
    num_muscles: int,
    batch: int | None = None,
    *,
    element: str = "standard",
) -> Physics:
    """Check ranges and expand scalars to elements and nodes.

    Args:
        values: The parameters as given.
        volume: Lumped volume of the body's mesh.
        material: Energy of the solid.
        num_muscles: Number of muscles.
        batch: Members of a batch that parameters may be given for; None: they may not.
        element: One of :data:`~diffsim.soft.ELEMENTS`.

    Returns:
        :class:`Physics`, with a batch axis where there is a batch. Gradients: all values.
    """
    num_elements, num_nodes = len(volume.elements), len(volume.nodal)

    def per_element(name: str, value: Tensor) -> Tensor:
        return _repeat_for_batch(name, value, num_elements, "num_elements", batch)

    of_law = material.weights(
        per_element("youngs_modulus", values.youngs_modulus),
        per_element("poissons_ratio", values.poissons_ratio),
        **{name: per_element(name, value) for name, value in values.constants.items()},
    )
    weights = torch.stack([_expand_to_batch(w, batch) for w in of_law], dim=-2)
    if element == "assumed_strain":
        bending = hourglass_weights(small_strain_moduli(material.law, weights))
        weights = torch.cat([weights, torch.stack(bending, dim=-2)], dim=-2)
    if values.node_mass is None:
        mass = volume.mass(values.density, batch)
    else:
        mass = _nodal_mass("node_mass", values.node_mass, num_nodes, batch, above=0.0)
    if values.attached_mass is not None:
        mass = mass + _nodal_mass("attached_mass", values.attached_mass, num_nodes, batch)
    weighing_mass = mass
    if values.added_mass is not None:
        mass = mass + _nodal_mass("added_mass", values.added_mass, num_nodes, batch)
    gravity = _of_members("gravity", values.gravity, (3,), batch)
    rayleigh_alpha = _of_members("rayleigh_alpha", values.rayleigh_alpha, (), batch)
    _range("rayleigh_alpha", rayleigh_alpha, at_least=0.0, hint="unit is 1/s")
    rayleigh_beta = values.rayleigh_beta
    if rayleigh_beta is not None:
        rayleigh_beta = per_element("rayleigh_beta", rayleigh_beta)
        _range("rayleigh_beta", rayleigh_beta, at_least=0.0, hint="unit is s")
    fiber_stiffness = _of_members("fiber_stiffness", values.fiber_stiffness, (num_muscles,), batch)
    _range("fiber_stiffness", fiber_stiffness, above=0.0, hint="unit is Pa")
    return Physics(
        material=material.law,
        weights=weights,
        mass=_expand_to_batch(mass, batch),
        weighing_mass=_expand_to_batch(weighing_mass, batch),
        gravity=gravity,
        rayleigh_alpha=rayleigh_alpha,
        rayleigh_beta=rayleigh_beta,
        fiber_stiffness=_expand_to_batch(fiber_stiffness, batch),
    )


def require_distinct(name: str, value: object, batch: int, sizes: Mapping[str, int]) -> None:
    """Refuse a vector that may be of a batch's members as well as of elements or vertices."""
    for axis, size in sizes.items():
        if isinstance(value, Tensor) and tuple(value.shape) == (batch,) == (size,):
            raise ValueError(
                f"{name} of shape ({batch},) may be of members or of {axis[4:]}: there are as many "
                f"of both; for members pass shape ({batch}, 1), for {axis[4:]} ({batch}, {axis}), "
                "such as value.expand(batch, -1)"
            )


def _expand_to_batch(value: Tensor, batch: int | None) -> Tensor:
    """(size,) as (batch, size), where there is a batch."""
    return value if batch is None or value.ndim == 2 else value.expand(batch, -1)


def _of_members(name: str, value: Tensor, shape: tuple[int, ...], batch: int | None) -> Tensor:
    """A value of a shape, or one for each member."""
    if batch is not None and isinstance(value, Tensor) and value.ndim > len(shape):
        return require(name, value, (batch, *shape))
    return require(name, value, shape)


def require_physics(physics: Physics, sizes: Mapping[str, int], material: str) -> Physics:
    """Refuse what is no :class:`Physics`, one of another body, and spoiled fields of one.

    The fields are looked at once: for small bodies that takes a quarter of a step.

    Args:
        physics: What was given.
        sizes: Of the body's arrays by name, and "num_muscles".
        material: The body's material.
    """
    if not isinstance(physics, Physics):
        raise TypeError(f"physics must come from body.physics(...), got {type(physics).__name__}")
    fits, is_traced = (material, *sizes.values()), torch.compiler.is_compiling()
    if not is_traced and vars(physics).get(_FITS) == fits:
        return physics
    for name in ("mass", "weights"):
        require_shape(f"physics.{name}", getattr(physics, name), ("...", "size"))
    size = (physics.mass.shape[-1], physics.weights.shape[-1])
    own = (sizes["num_nodes"], sizes["num_elements"])
    if size != own:
        raise ValueError(
            f"physics must be made by this body's physics(...): it is for {size[0]} vertices and "
            f"{size[1]} elements, the body has {own[0]} and {own[1]}"
        )
    if physics.material != material:
        raise ValueError(
            f"physics must be made by this body's physics(...): it is for material "
            f"{physics.material!r}, the body has {material!r}"
        )
    _require_fields(physics, sizes)
    if not is_traced:
        object.__setattr__(physics, _FITS, fits)
    return physics


def _require_fields(physics: Physics, sizes: Mapping[str, int]) -> None:
    """Refuse fields whose kind, shape or numbers no body has; a user may have replaced some."""
    batch = physics.batch
    members = () if batch is None else (batch,)
    for name, axes in _AXES.items():
        shape = tuple(sizes[axis] for axis in axes)
        require(f"physics.{name}", getattr(physics, name), (*members, *shape))
    _of_members("physics.gravity", physics.gravity, (3,), batch)
    _of_members("physics.rayleigh_alpha", physics.rayleigh_alpha, (), batch)
    beta = physics.rayleigh_beta
    if beta is not None:
        by_element = not isinstance(beta, Tensor) or beta.ndim > 0
        _of_members(
            "physics.rayleigh_beta", beta, (sizes["num_elements"],) if by_element else (), batch
        )
    for name, limits in _LIMITS.items():
        if (value := getattr(physics, name)) is not None:
            _range(f"physics.{name}", value, **limits)
    two_mu, lame_lambda = small_strain_moduli(physics.material, physics.weights)
    for modulus, which in ((two_mu, "shear"), (two_mu / 3.0 + lame_lambda, "bulk")):
        _range("physics.weights", modulus, at_least=0.0, hint=f"else the {which} modulus is < 0")
    of_shape = {
        "x_rest": (sizes["num_nodes"], 3),
        "tables": (sizes["num_tables"],),
        "fiber_weights": (sizes["num_fibers"],),
    }
    for name, shape in of_shape.items():
        value = getattr(physics, name)
        empty = name == "tables" and isinstance(value, Tensor) and not value.numel()
        if value is not None and not empty:
            require(f"physics.{name}", value, shape)


def _checked_density(density: Tensor) -> Tensor:
    _range("density", density, above=0.0, hint="unit is kg/m^3")
    return density


def _nodal_mass(
    name: str, value: Tensor, num_nodes: int, batch: int | None, **limits: float
) -> Tensor:
    mass = _of_members(name, value, (num_nodes,), batch)
    _range(name, mass, hint="unit is kg", **(limits or {"at_least": 0.0}))
    return mass


def _repeat_for_batch(
    name: str, value: Tensor, size: int, axis: str, batch: int | None = None
) -> Tensor:
    """(size,), or (batch, size) where it is given for the members of a batch."""
    if not isinstance(value, Tensor) or value.ndim == 0:
        return require(name, value, ()).expand(size).contiguous()
    shape = tuple(value.shape)
    if shape == (size,):
        return require(name, value, (size,))
    if batch is None:
        raise ValueError(f"{name} must be a scalar or have shape ({axis},) = ({size},), got "
                         f"{shape}")  # fmt: skip
    if shape in ((batch,), (batch, 1)):
        return require(name, value, shape).reshape(batch, 1).expand(batch, size).contiguous()
    if shape != (batch, size):
        raise ValueError(
            f"{name} must be a scalar or have shape ({axis},) = ({size},), or for a batch of "
            f"{batch} members ({batch},) or ({batch}, {axis}) = ({batch}, {size}), got {shape}"
        )
    return require(name, value, shape)


def _range(name: str, value: Tensor, **limits: Any) -> None:
    if not torch.compiler.is_compiling():
        require_range(name, value, **limits)
