"""Balls as they are simulated, and as positions show them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffsim.identify.shape import MovingShape
from diffsim.systems.rigid_body.ball_scene import BallScene


def simulated(scene: BallScene) -> MovingShape | None:
    """Balls on their paths, without what cameras and clocks do to them; None without balls."""
    if not scene.stage.bodies:
        return None
    with torch.no_grad():
        places = torch.stack([p[0] for p in scene.wide().paths(scene.grid.times[None]).places], 1)
    return MovingShape.of_balls(places.numpy(), _list_radii(scene))


def measured(scene: BallScene, channels: Tensor) -> MovingShape | None:
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


__all__ = ["measured", "simulated"]
