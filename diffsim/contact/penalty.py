"""Contact and friction as explicit penalty forces (thesis 4.1.4; Macklin et al. 2020)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from diffsim.contact.detect import require_members
from diffsim.contact.obstacle import Obstacle, require_obstacles
from diffsim.core.check import require, require_indices, require_number
from diffsim.core.numbers import anywhere
from diffsim.core.values import Number, direction, dot, friction_coefficient, scalar

_EPS = 2.2e-16
"""[m/s]; keeps mu fn / |u| finite, as the published code has it."""


def penalty_force(
    obstacles: Sequence[Obstacle],
    x: Tensor,
    v: Tensor,
    *,
    stiffness: Number,
    exponent: float = 2.0,
    friction: Number | None = None,
    viscous_cap: Number = 0.0,
    damping: Number = 0.0,
    nodes: Tensor | None = None,
) -> Tensor:
    """Nodal forces that push nodes out of obstacles, with friction against their moving surfaces.

    d = phi(x), u = tangential part of v - v_obstacle, v_n its normal part:
    fn = stiffness max(0, -d)^(exponent - 1) max(0, 1 - damping v_n),
    f = fn n - min(viscous_cap, mu fn / |u|) u.

    Where the cap binds, friction is viscous: a node at rest on a slope creeps at load / cap.
    Forces of several obstacles add up. The force is explicit in x and v: a step is stable only
    while stiffness and cap are small against mass / dt^2 and mass / dt.

    Args:
        obstacles: Obstacles at their present poses.
        x: Positions, (..., num_nodes, 3) [m].
        v: Velocities, same shape [m/s].
        stiffness: Stiffness of the normal force, >= 0 [N/m^(exponent - 1)].
        exponent: Exponent of the energy in depth, > 1; 2: force proportional to depth.
        friction: Coulomb coefficient for all obstacles, >= 0 or inf; None: each obstacle's own.
        viscous_cap: Largest friction over slip, >= 0 [N s/m]; 0: no friction. It is a viscosity,
            not a force.
        damping: Damping of the normal force (Hunt, Crossley 1975), >= 0 [s/m].
        nodes: The nodes that can touch, (k,) int64; None: all.

    Returns:
        Forces, shape of x [N]. Gradients: x, v, stiffness, friction, viscous_cap, damping, the
        obstacles' poses, velocities, shapes and friction; first order. At first touch (d = 0) the
        gradient is that of no contact; at u = 0 it is that of the viscous branch.

    Reference: Macklin, Erleben, Mueller, Chentanez, Jeschke, Kim 2020, "Primal/Dual Descent
    Methods for Dynamics".
    """
    many = require_obstacles(obstacles)
    x = require("x", x, ("...", "num_nodes", 3))
    v = require("v", v, tuple(x.shape))
    kn = scalar("stiffness", stiffness, at_least=0.0)
    cap = scalar("viscous_cap", viscous_cap, at_least=0.0)
    damp = scalar("damping", damping, at_least=0.0)
    exponent = require_number("exponent", exponent, above=1.0, hint="2 is a linear spring")
    mu = None if friction is None else friction_coefficient(friction)
    if nodes is None:
        return _force(many, x, v, kn, exponent, mu, cap, damp)
    nodes = require("nodes", nodes, ("k",), torch.int64)
    nodes = require_indices("nodes", nodes, x.shape[-2], "nodes")
    force = _force(many, x[..., nodes, :], v[..., nodes, :], kn, exponent, mu, cap, damp)
    return torch.zeros_like(x).index_add(-2, nodes, force)


def _force(
    obstacles: list[Obstacle],
    x: Tensor,
    v: Tensor,
    kn: Tensor,
    exponent: float,
    friction: Tensor | None,
    cap: Tensor,
    damping: Tensor,
) -> Tensor:
    total = torch.zeros_like(x)
    for obstacle in obstacles:
        phi, normal = obstacle.distance_normal(x)
        relative = v - obstacle.point_velocity(x)
        v_n = dot(relative, normal)
        inside = phi.detach() < 0
        depth = torch.where(inside, -phi, 1.0)
        fn = torch.where(inside, kn * depth ** (exponent - 1.0), 0.0)
        fn = fn * (1.0 - damping * v_n).clamp(min=0.0)
        u = relative - v_n[..., None] * normal
        speed, _ = direction(u, torch.ones_like(u))
        mu = obstacle.friction if friction is None else friction
        require_members("friction", mu, fn.shape[:-1])
        mu = mu[..., None]
        drag = cap.expand_as(fn)
        slides = mu.isfinite()  # an infinite coefficient leaves the cap alone
        if anywhere(slides):
            most = torch.where(slides, mu, 0.0) * fn / (speed + _EPS)
            drag = torch.where(slides, torch.minimum(drag, most), drag)
        drag = torch.where(inside, drag, 0.0)
        total = total + fn[..., None] * normal - drag[..., None] * u
    return total
