"""Ball against ball through their centers alone (thesis 4.1.6, the two tennis balls)."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.check import require, require_indices, require_range
from diffsim.core.values import Number, direction, dot, scalar


def ball_force(
    x: Tensor,
    v: Tensor,
    balls: Tensor,
    *,
    radius: Number,
    stiffness: Number,
    friction: Number = 0.0,
) -> Tensor:
    """Springs between the centers of balls that roll on a table, with friction across.

    c_i, v_i are means over a ball's nodes, l = |c_j - c_i|, n = (c_j - c_i) / l and
    pen = max(2 radius - l, 0). Then F_i = k_i pen (-n + mu_i s), F_j = k_j pen (n - mu_j s), with
    s = +-(-n_y, n_x, 0) against the slip of the centers: + where (v_i - v_j) x n points along z.

    The thesis's simple model: friction neither shrinks with slip nor sees spin (it jumps where the
    slip changes sign), and forces are reciprocal only where the balls' coefficients agree.
    :class:`BodyContact` has neither defect.

    Args:
        x: Positions, (num_nodes, 3) [m].
        v: Velocities, same shape [m/s].
        balls: Nodes of each ball, (num_balls, nodes_per_ball) int64.
        radius: Radius of all balls [m], > 0.
        stiffness: Stiffness of a ball's spring, a number or (num_balls,) [N/m], >= 0.
        friction: Friction coefficient of a ball, a number or (num_balls,) [-], >= 0.

    Returns:
        Forces, each ball's spread evenly over its nodes, shape of x [N]. Gradients: x, radius,
        stiffness, friction (in v they vanish almost everywhere); first order.
    """
    x = require("x", x, ("num_nodes", 3))
    v = require("v", v, tuple(x.shape))
    balls = require("balls", balls, ("num_balls", "nodes_per_ball"), torch.int64)
    require_indices("balls", balls, len(x), "nodes")
    if balls.shape[1] == 0:
        raise ValueError("balls must have at least one node each, got shape (num_balls, 0)")
    count = len(balls)
    k, mu = _each("stiffness", stiffness, count), _each("friction", friction, count)
    radius = scalar("radius", radius, above=0.0)
    i, j = torch.triu_indices(count, count, 1)
    center, velocity = x[balls].mean(1), v[balls].mean(1)
    length, n = direction(center[j] - center[i], torch.tensor([1.0, 0.0, 0.0], dtype=x.dtype))
    pen = (2.0 * radius - length).clamp(min=0.0)[:, None]
    across = torch.stack([-n[:, 1], n[:, 0], torch.zeros_like(length)], dim=1)
    slip = dot(velocity[i] - velocity[j], across).detach()[:, None]
    s = torch.where(slip < 0, across, -across)  # (v_i - v_j) x n along z is -slip
    on_i = k[i, None] * pen * (-n + mu[i, None] * s)
    on_j = k[j, None] * pen * (n - mu[j, None] * s)
    force = torch.zeros_like(center).index_add(0, i, on_i).index_add(0, j, on_j)
    share = (force / balls.shape[1])[:, None].expand(-1, balls.shape[1], -1)
    return torch.zeros_like(x).index_add(0, balls.reshape(-1), share.reshape(-1, 3))


def _each(name: str, value: Number, count: int) -> Tensor:
    if isinstance(value, Tensor) and value.ndim:
        return require_range(name, require(name, value, (count,)), at_least=0.0)
    return scalar(name, value, at_least=0.0).expand(count)
