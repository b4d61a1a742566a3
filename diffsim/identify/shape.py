"""What moves in a run, as a surface: for pages that show it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffsim.core.arrays import Array, IntArray
from diffsim.core.checked import checked


@checked(kinds_only=True)
@dataclass(frozen=True, kw_only=True, eq=False)
class MovingShape:
    """Surface of a body or vehicle at the sample times of a run.

    Attributes:
        triangles: Node indices, (num_triangles, 3).
        nodes_m: Places over time, z up, (num_samples, num_nodes, 3) [m]; NaN where a sample says
            nothing of them.
        closed: Whether it has an inside, its triangles seen counter-clockwise from outside; then
            what faces away is not drawn.
    """

    triangles: IntArray
    nodes_m: Array
    closed: bool = False

    @classmethod
    @checked
    def of_balls(cls, places_m: Array, radii_m: Array) -> MovingShape:
        """Balls, which look the same however they are turned.

        Args:
            places_m: Their centers, z up, (num_samples, num_balls, 3) [m].
            radii_m: Radius of each ball, (num_balls,) [m].
        """
        import trimesh  # takes longer to load than all of this room

        ball = trimesh.creation.icosphere(subdivisions=2)  # 320 triangles
        points, faces = np.array(ball.vertices), np.array(ball.faces, dtype=np.int64)
        nodes = places_m[:, :, None] + radii_m[:, None, None] * points
        first = len(points) * np.arange(len(radii_m))[:, None, None]
        return cls(
            triangles=(first + faces).reshape(-1, 3),
            nodes_m=nodes.reshape(len(places_m), -1, 3),
            closed=True,
        )
