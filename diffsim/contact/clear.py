"""Refuse a start that node contact cannot resolve: an obstacle in the middle of a body."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from diffsim.contact.obstacle import Obstacle, require_obstacles
from diffsim.core.check import require, require_number
from diffsim.core.numbers import values_of
from diffsim.mesh import HexMesh, TetMesh, surface_vertices


@torch.no_grad()
def check_clear(
    obstacles: Sequence[Obstacle], mesh: HexMesh | TetMesh, x: Tensor, *, tolerance: float = 0.0
) -> None:
    """Check that no obstacle starts inside a body.

    Contact acts on surface nodes. It pushes out nodes that start a little inside an obstacle, but
    an obstacle within the body's interior would be pinned there. Checked are interior nodes and
    the centroids of elements, so an obstacle smaller than an element can pass unseen.

    Args:
        obstacles: Obstacles at their poses at the start.
        mesh: The body's mesh.
        x: Positions, (num_nodes, 3) [m].
        tolerance: Depth that is let pass [m].

    Raises:
        ValueError: names the obstacle, how many points and how deep.
    """
    many = require_obstacles(obstacles)
    if not isinstance(mesh, (HexMesh, TetMesh)):
        raise TypeError(f"mesh must be a HexMesh or TetMesh, got {type(mesh).__name__}")
    x = require("x", x, (mesh.num_nodes, 3))
    tolerance = require_number("tolerance", tolerance, at_least=0.0, hint="unit is m")
    interior = torch.ones(mesh.num_nodes, dtype=torch.bool)
    interior[surface_vertices(mesh)] = False
    points = torch.cat([x[interior], x[mesh.elements].mean(1)])
    for k, obstacle in enumerate(many):
        phi, _ = obstacle.distance_normal(points)
        inside = int(values_of(phi < -tolerance).sum())
        if inside:
            raise ValueError(
                f"obstacle {obstacle.label(k)} starts inside the body: {inside} of {len(points)} "
                "interior nodes and element centroids lie in it, the deepest "
                f"{-float(values_of(phi).min()):.3g} m; move one of them away before starting"
            )
