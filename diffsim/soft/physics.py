"""Physical parameters of a body, expanded to what the kernels read, once per rollout."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.core.check import require, require_range
from diffsim.soft._context import small_strain_lambda
from diffsim.soft.materials import Material


@dataclass(frozen=True, kw_only=True)
class Physics:
    """Per-element and per-node parameters; every tensor may carry a gradient.

    Attributes:
        material: Energy of the solid, see :mod:`diffsim.soft.materials`.
        w_mu, w_vol: The material's parameters 2 mu and lambda (pd: volume weight),
            (num_elements,) [Pa].
        mass: Nodal inertia, attached and added masses included, (num_vertices,) [kg].
        weighing_mass: What gravity acts on: ``mass`` without added mass, (num_vertices,) [kg].
        gravity: Acceleration of free fall, (3,) [m/s^2].
        rayleigh_alpha: Damping proportional to ``mass``, scalar [1/s].
        rayleigh_beta: Stiffness-proportional damping, scalar or (num_elements,) [s]; None: none.
        fiber_stiffness: Stiffness of each muscle, (num_muscles,) [Pa].
    """

    material: str
    w_mu: Tensor
    w_vol: Tensor
    mass: Tensor
    weighing_mass: Tensor
    gravity: Tensor
    rayleigh_alpha: Tensor
    rayleigh_beta: Tensor | None
    fiber_stiffness: Tensor

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
        small_strain = small_strain_lambda(self.material, self.w_vol)
        return DampingWeights(mu=rate * self.w_mu, lame_lambda=rate * small_strain)


class DampingWeights(NamedTuple):
    """Damping of elements: beta kappa 2 mu and beta kappa lambda, (num_elements,) [Pa]."""

    mu: Tensor
    lame_lambda: Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class PhysicalValues:
    """Physical parameters of a body as they are given: numbers as tensors, not yet expanded.

    ``body.physics`` takes the same names; meaning, shape and unit as in
    :class:`~diffsim.soft.SoftBody` and its options.
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


PARAMETERS = tuple(f.name for f in fields(PhysicalValues))


@dataclass(frozen=True, kw_only=True, eq=False)
class LumpedVolume:
    """Volume of a mesh, lumped to its nodes.

    Attributes:
        elements: Nodes of each element, (num_elements, 8 or 4) int64.
        shares: Volume of each element lumped to its nodes, (num_elements, 8 or 4) [m^3].
        nodal: Volume of each node, (num_vertices,) [m^3].
    """

    elements: Tensor
    shares: Tensor
    nodal: Tensor

    def mass(self, density: Tensor) -> Tensor:
        """Lumped mass, (num_vertices,) [kg].

        Args:
            density: Scalar, (num_vertices,) or (num_elements,) [kg/m^3].
        """
        num_elements, num_vertices = len(self.elements), len(self.nodal)
        shape = tuple(density.shape) if isinstance(density, Tensor) else ()
        if shape not in ((), (num_vertices,), (num_elements,)):
            raise ValueError(
                f"density must be a scalar or have shape (num_vertices,) = ({num_vertices},) or "
                f"(num_elements,) = ({num_elements},), got {shape}"
            )
        if shape and num_elements == num_vertices:
            raise ValueError(
                f"density of shape {shape} may be of elements or of vertices: the mesh has as many "
                "of both; pass a scalar, or node_mass instead"
            )
        if shape == (num_elements,):
            density = _checked_density(require("density", density, shape))
            masses = density[:, None] * self.shares
            none = torch.zeros_like(self.nodal)
            return none.index_add(0, self.elements.flatten(), masses.flatten())
        return _checked_density(_per("density", density, num_vertices, "num_vertices")) * self.nodal


def make_physics(
    values: PhysicalValues, volume: LumpedVolume, material: Material, num_muscles: int
) -> Physics:
    """Check ranges and expand scalars to elements and nodes.

    Args:
        values: The parameters as given.
        volume: Lumped volume of the body's mesh.
        material: Energy of the solid.
        num_muscles: Number of muscles.

    Returns:
        :class:`Physics`. Gradients: all values.
    """
    num_elements, num_vertices = len(volume.elements), len(volume.nodal)
    weights = material.weights(
        _per("youngs_modulus", values.youngs_modulus, num_elements, "num_elements"),
        _per("poissons_ratio", values.poissons_ratio, num_elements, "num_elements"),
    )
    if values.node_mass is None:
        mass = volume.mass(values.density)
    else:
        mass = require("node_mass", values.node_mass, (num_vertices,))
        _range("node_mass", mass, above=0.0, hint="unit is kg")
    if values.attached_mass is not None:
        mass = mass + _nodal_mass("attached_mass", values.attached_mass, num_vertices)
    weighing_mass = mass
    if values.added_mass is not None:
        mass = mass + _nodal_mass("added_mass", values.added_mass, num_vertices)
    gravity = require("gravity", values.gravity, (3,))
    rayleigh_alpha = require("rayleigh_alpha", values.rayleigh_alpha, ())
    _range("rayleigh_alpha", rayleigh_alpha, at_least=0.0, hint="unit is 1/s")
    rayleigh_beta = values.rayleigh_beta
    if rayleigh_beta is not None:
        rayleigh_beta = _per("rayleigh_beta", rayleigh_beta, num_elements, "num_elements")
        _range("rayleigh_beta", rayleigh_beta, at_least=0.0, hint="unit is s")
    fiber_stiffness = require("fiber_stiffness", values.fiber_stiffness, (num_muscles,))
    _range("fiber_stiffness", fiber_stiffness, above=0.0, hint="unit is Pa")
    return Physics(
        material=material.law,
        w_mu=weights.w_mu,
        w_vol=weights.w_vol,
        mass=mass,
        weighing_mass=weighing_mass,
        gravity=gravity,
        rayleigh_alpha=rayleigh_alpha,
        rayleigh_beta=rayleigh_beta,
        fiber_stiffness=fiber_stiffness,
    )


def require_physics(
    physics: Physics, num_vertices: int, num_elements: int, material: str
) -> Physics:
    """Refuse what is no :class:`Physics`, or one of another body."""
    if not isinstance(physics, Physics):
        raise TypeError(f"physics must come from body.physics(...), got {type(physics).__name__}")
    size = (physics.mass.shape[0], physics.w_mu.shape[0])
    if size != (num_vertices, num_elements):
        raise ValueError(
            f"physics must be made by this body's physics(...): it is for {size[0]} vertices and "
            f"{size[1]} elements, the body has {num_vertices} and {num_elements}"
        )
    if physics.material != material:
        raise ValueError(
            f"physics must be made by this body's physics(...): it is for material "
            f"{physics.material!r}, the body has {material!r}"
        )
    return physics


def _checked_density(density: Tensor) -> Tensor:
    _range("density", density, above=0.0, hint="unit is kg/m^3")
    return density


def _nodal_mass(name: str, value: Tensor, num_vertices: int) -> Tensor:
    mass = require(name, value, (num_vertices,))
    _range(name, mass, at_least=0.0, hint="unit is kg")
    return mass


def _per(name: str, value: Tensor, size: int, axis: str) -> Tensor:
    if not isinstance(value, Tensor) or value.ndim == 0:
        return require(name, value, ()).expand(size).contiguous()
    if value.shape != (size,):
        raise ValueError(f"{name} must be a scalar or have shape ({axis},) = ({size},), got "
                         f"{tuple(value.shape)}")  # fmt: skip
    return require(name, value, (size,))


def _range(name: str, value: Tensor, **limits) -> None:
    if not torch.compiler.is_compiling():
        require_range(name, value, **limits)
