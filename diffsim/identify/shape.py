"""What moves in a run, as a surface: for pages that show it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


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

    triangles: NDArray[np.int64]
    nodes_m: NDArray[np.float64]
    closed: bool = False


__all__ = ["MovingShape"]
