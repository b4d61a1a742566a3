"""Bodies as simulated and as their recordings show them: a tossed box, balls."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffsim.core.rotation import matrix_from_quaternion, matrix_from_rpy
from diffsim.identify.shape import MovingShape
from diffsim.systems.rigid_body.ball_scene import BallScene
from diffsim.systems.rigid_body.layout import PoseLayout
from diffsim.systems.rigid_body.windows import CORNERS

_SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4],
                   [1, 5, 7, 3]])  # fmt: skip


def figure_of(layout: PoseLayout, edges: Tensor, channels: Tensor) -> MovingShape | None:
    """The box at the poses that channels show.

    Args:
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
    nodes = (0.5 * CORNERS * edges.numpy()) @ turn.transpose(0, 2, 1) + at[:, None]
    triangles = _SIDES[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    return MovingShape(triangles=triangles, nodes_m=nodes)


def _pick_group(layout: PoseLayout, channels: Tensor, kind: str, width: int) -> Tensor | None:
    """Columns of one kind, (num_samples, width); None where one is missing."""
    rows = list(layout.rows)
    wanted = [(kind, k) for k in range(width)]
    if not all(row in rows for row in wanted):
        return None
    return torch.stack([channels[:, rows.index(row)] for row in wanted], -1)


def balls_simulated(scene: BallScene) -> MovingShape | None:
    """Balls on their paths, without what cameras and clocks do to them; None without balls."""
    if not scene.stage.bodies:
        return None
    with torch.no_grad():
        places = torch.stack([p[0] for p in scene.wide().paths(scene.grid.times[None]).places], 1)
    return MovingShape.of_balls(places.numpy(), _list_radii(scene))


def balls_measured(scene: BallScene, channels: Tensor) -> MovingShape | None:
    """Balls where channels say.

    Args:
        scene: The run's scene: its layout and the balls' sizes.
        channels: Measured or predicted, (num_samples, num_channels).

    Returns:
        None where positions are not among the channels, or not of all balls.
    """
    rows = list(scene.stage.rows)
    wanted = [[("position", b, k) for k in range(3)] for b in range(len(scene.stage.bodies))]
    if not wanted or not all(row in rows for of_ball in wanted for row in of_ball):
        return None
    columns = [[rows.index(row) for row in of_ball] for of_ball in wanted]
    places = channels[:, columns] @ scene.stage.frame
    return MovingShape.of_balls(places.numpy(), _list_radii(scene))


def _list_radii(scene: BallScene) -> np.ndarray:
    return np.array([0.5 * float(scene.numbers[b.diameter]) for b in scene.stage.bodies])
