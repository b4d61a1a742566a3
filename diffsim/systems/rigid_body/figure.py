"""A tossed box as its recording shows it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffsim.core.rotation import matrix_from_quaternion, matrix_from_rpy
from diffsim.identify.shape import MovingShape
from diffsim.systems.rigid_body.layout import Layout

_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2.0
_SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4],
                   [1, 5, 7, 3]])  # fmt: skip


def figure_of(layout: Layout, edges: Tensor, channels: Tensor) -> MovingShape | None:
    """The box at the poses that channels show.

    Args:
        layout: What each channel shows.
        edges: Lengths of the box, (3,) [m].
        channels: Measured or predicted, (num_samples, num_channels).

    Returns:
        None where place or turn are not among the channels.
    """
    place = _pick_group(layout, channels, "position", 3)
    turns, angles = (
        _pick_group(layout, channels, *kind) for kind in (("quaternion", 4), ("angles", 3))
    )
    if place is None or (turns is None and angles is None):
        return None
    if turns is not None:
        rotation = matrix_from_quaternion(turns / turns.norm(dim=-1, keepdim=True))
    else:
        assert angles is not None
        rotation = matrix_from_rpy(angles)
    up = matrix_from_quaternion(layout.up)
    turn, at = (up @ rotation).numpy(), (place @ up.mT).numpy()
    nodes = (_CORNERS * edges.numpy()) @ turn.transpose(0, 2, 1) + at[:, None]
    triangles = _SIDES[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    return MovingShape(triangles=triangles, nodes_m=nodes)


def _pick_group(layout: Layout, channels: Tensor, kind: str, width: int) -> Tensor | None:
    """Columns of one kind, (num_samples, width); None where one is missing."""
    rows = list(layout.rows)
    wanted = [(kind, k) for k in range(width)]
    if not all(row in rows for row in wanted):
        return None
    return torch.stack([channels[:, rows.index(row)] for row in wanted], -1)


__all__ = ["figure_of"]
