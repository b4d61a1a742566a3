"""A video of balls on a table as a camera would film them, to test what reads videos.

Balls hide what lies behind them; their outlines are those of spheres in perspective, whose middle
is not quite the image of the ball's center, and they are lit from one side. OpenCV writes the file
(extra ``video``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim.core.check import require_number
from diffsim.core.optional import optional
from diffsim.systems.rigid_body.camera import HEIGHT_PX, WIDTH_PX, eye, projected

if TYPE_CHECKING:
    from labs.balls.soft import SoftBallModel

Array = NDArray[np.float64]
FELT = (70, 225, 205)  # blue, green, red: optic yellow
CLOTH, FLOOR = (120, 105, 95), (70, 70, 75)
_BITS = 6  # fractional bits of OpenCV's drawing
_OUTLINE = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole camera that films the balls."""

    project: Callable[[Array], Array]  # places (n, 3) [m] to (n, 2), u to the right and v down [px]
    eye: Array  # place of the camera, (3,) [m]
    # width_px, height_px: width and height of the picture [px]
    width_px: int = 1280
    height_px: int = 720


def view_of(model: SoftBallModel, x: Array) -> View:
    """The camera of a model at standardized coordinates x (n,)."""
    values = model.values_at(x)
    return View(
        lambda places: projected(values, model.rotation, torch.from_numpy(places)).numpy(),
        eye(values, model.rotation).numpy(),
        round(WIDTH_PX + 2.0 * float(model.plain["center_u"])),
        round(HEIGHT_PX + 2.0 * float(model.plain["center_v"])),
    )


def film_balls(
    path: str | Path,
    view: View,
    centers: Array,
    radius: float,
    *,
    table: Array,
    rate: float = 60.0,
    noise: float = 3.0,
    seed: int = 0,
    hidden: Sequence[tuple[int, int]] = (),
) -> Path:
    """Write a video (Motion JPEG in AVI).

    Args:
        path: File to be written; its name ends with ".avi".
        view: Camera that films.
        centers: Centers of the balls over time, (num_frames, num_balls, 3) [m].
        radius: Radius of every ball [m].
        table: (n, 3) outline of a flat table [m].
        rate: Frames per second [1/s].
        noise: Standard deviation of every color value, which runs to 255.
        seed: Seed of the noise.
        hidden: Pairs (frame, ball) where a ball is left out, as if something passed before it.

    Raises:
        OSError: OpenCV cannot write there.
    """
    cv2 = optional("cv2", purpose="writing a video")
    require_number("radius", radius, above=0.0, hint="unit is m")
    require_number("rate", rate, above=0.0, hint="unit is 1/s")
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    size = (view.width_px, view.height_px)
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), rate, size)
    if not video.isOpened():
        raise OSError(f"OpenCV cannot write {path}; give a name that ends with .avi")
    rng = np.random.default_rng(seed)
    ground = np.full((view.height_px, view.width_px, 3), FLOOR, np.uint8)
    cv2.fillPoly(ground, _round_to_fixed_point(view.project(table)), CLOTH, cv2.LINE_AA, _BITS)
    try:
        for frame, places in enumerate(centers):
            picture = ground.copy()
            far_first = np.argsort(-np.linalg.norm(places - view.eye, axis=1))
            for ball in far_first:
                if (frame, int(ball)) not in hidden:
                    _draw_ball(cv2, picture, view, places[ball], radius)
            noisy = picture + rng.normal(0.0, noise, picture.shape)
            video.write(np.clip(noisy, 0, 255).astype(np.uint8))
    finally:
        video.release()
    return path


def outline(view: View, center: Array, radius: float) -> Array:
    """The edge of a sphere as seen, (n, 2) [px]: the circle where rays from the eye touch it."""
    away = center - view.eye
    distance = float(np.linalg.norm(away))
    normal = away / distance
    across = np.cross(normal, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    up = np.cross(across, normal)
    share = radius / distance
    wide = radius * np.sqrt(1.0 - share**2)
    circle = np.cos(_OUTLINE)[:, None] * across + np.sin(_OUTLINE)[:, None] * up
    return view.project(center - share * radius * normal + wide * circle)


def _draw_ball(
    cv2: Any, picture: NDArray[np.uint8], view: View, center: Array, radius: float
) -> None:
    """Darker at the edge, brightest off the middle, as under a lamp at the upper left."""
    edge = outline(view, center, radius)
    middle = edge.mean(0)
    light = middle - 0.15 * np.ptp(edge, axis=0)
    for share in np.linspace(0.0, 1.0, 8):
        color = tuple(float(c * (0.75 + 0.25 * share)) for c in FELT)
        ring = middle + share * (light - middle) + (1.0 - 0.85 * share) * (edge - middle)
        cv2.fillPoly(picture, _round_to_fixed_point(ring), color, cv2.LINE_AA, _BITS)


def _round_to_fixed_point(points: Array) -> list[NDArray[np.int32]]:
    return [np.rint(points * 2**_BITS).astype(np.int32)]
