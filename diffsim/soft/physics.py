"""Physical parameters of a body, expanded to what the kernels read, once per rollout."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.core.check import require, require_range
from diffsim.soft._context import small_strain_lambda
from diffsim.soft.materials import material_weights


@dataclass(frozen=True)
class Physics:
    """Per-element and per-node parameters; every tensor may carry a gradient.

    Attributes:
        material: Energy of the solid, see :mod:`diffsim.soft.materials`.
        w_mu, w_vol: Its parameters 2 mu and lambda (pd: volume weight), (num_elements,) [Pa].
        mass: Nodal inertia, attached and added masses included, (num_vertices,) [kg].
        weighing_mass: What gravity acts on: ``mass`` without added mass, (num_vertices,) [kg].
        gravity: (3,) [m/s^2].
        rayleigh_alpha: Damping proportional to ``mass``, scalar [1/s].
        rayleigh_beta: Stiffness-proportional damping, scalar or (num_elements,) [s]; None: none.
        fibre_stiffness: Of each muscle, (num_muscles,) [Pa].
    """

    material: str
    w_mu: Tensor
    w_vol: Tensor
    mass: Tensor
    weighing_mass: Tensor
    gravity: Tensor
    rayleigh_alpha: Tensor
    rayleigh_beta: Tensor | None
    fibre_stiffness: Tensor

    def damping(self, kappa: float) -> tuple[Tensor, Tensor]:
        """Damping weights beta kappa 2 mu and beta kappa lambda, (num_elements,) [Pa], or empty.

        mu and lambda are those that the elastic energy has at small strain, so that damping is
        beta K whatever the material and the volume weight's convention.
        """
        if self.rayleigh_beta is None:
            empty = torch.zeros(0, dtype=torch.float64)
            return empty, empty
        rate = self.rayleigh_beta * kappa
        return rate * self.w_mu, rate * small_strain_lambda(self.material, self.w_vol)


def make_physics(
    *,
    num_elements: int,
    num_muscles: int,
    nodal_volume: Tensor,
    material: str,
    volume_weight: str,
    youngs_modulus: Tensor,
    poissons_ratio: Tensor,
    density: Tensor,
    gravity: Tensor,
    rayleigh_alpha: Tensor,
    rayleigh_beta: Tensor | None,
    attached_mass: Tensor | None,
    added_mass: Tensor | None,
    node_mass: Tensor | None,
    fibre_stiffness: Tensor,
) -> Physics:
    """Check ranges and expand scalars to elements and nodes (see :class:`Physics`)."""
    youngs_modulus = _per("youngs_modulus", youngs_modulus, num_elements, "num_elements")
    poissons_ratio = _per("poissons_ratio", poissons_ratio, num_elements, "num_elements")
    w_mu, w_vol = material_weights(material, youngs_modulus, poissons_ratio, volume_weight)
    num_vertices = nodal_volume.shape[0]
    if node_mass is None:
        density = _per("density", density, num_vertices, "num_vertices")
        _range("density", density, above=0.0, hint="unit is kg/m^3")
        mass = density * nodal_volume
    else:
        mass = require("node_mass", node_mass, (num_vertices,))
        _range("node_mass", mass, above=0.0, hint="unit is kg")
    if attached_mass is not None:
        attached_mass = require("attached_mass", attached_mass, (num_vertices,))
        _range("attached_mass", attached_mass, at_least=0.0, hint="unit is kg")
        mass = mass + attached_mass
    weighing_mass = mass
    if added_mass is not None:
        added_mass = require("added_mass", added_mass, (num_vertices,))
        _range("added_mass", added_mass, at_least=0.0, hint="unit is kg")
        mass = mass + added_mass
    gravity = require("gravity", gravity, (3,))
    rayleigh_alpha = require("rayleigh_alpha", rayleigh_alpha, ())
    _range("rayleigh_alpha", rayleigh_alpha, at_least=0.0, hint="unit is 1/s")
    if rayleigh_beta is not None:
        rayleigh_beta = _per("rayleigh_beta", rayleigh_beta, num_elements, "num_elements")
        _range("rayleigh_beta", rayleigh_beta, at_least=0.0, hint="unit is s")
    fibre_stiffness = require("fibre_stiffness", fibre_stiffness, (num_muscles,))
    _range("fibre_stiffness", fibre_stiffness, above=0.0, hint="unit is Pa")
    return Physics(
        material=material,
        w_mu=w_mu,
        w_vol=w_vol,
        mass=mass,
        weighing_mass=weighing_mass,
        gravity=gravity,
        rayleigh_alpha=rayleigh_alpha,
        rayleigh_beta=rayleigh_beta,
        fibre_stiffness=fibre_stiffness,
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
