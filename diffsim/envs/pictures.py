"""Pictures of environments, drawn without a display."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from diffsim.core.arrays import Array

if TYPE_CHECKING:
    from diffsim.copter import FlightState, Multicopter

SIZE = (480, 360)  # width, height [px]
_DPI = 100


def copter_picture(
    vehicle: Multicopter, state: FlightState, goal: Tensor, path: Tensor
) -> NDArray[np.uint8]:
    """A multicopter as arms and rotor discs, its goal and the way ahead; up is up."""
    figure, axes = _scene()
    rotation, place = state.rotation[0].numpy(), state.position[0].numpy()
    turn = np.linspace(0.0, 2.0 * np.pi, 32)
    for hub, radius in zip(vehicle.positions.numpy(), vehicle.radii.numpy(), strict=True):
        ring = hub + radius * np.stack([np.cos(turn), np.sin(turn), np.zeros(32)], -1)
        _line(axes, np.stack([place, place + rotation @ hub]), color="#44525c", lw=2.5)
        _line(axes, place + ring @ rotation.T, color="#2f7fb5", lw=1.5)
    _line(axes, path.numpy(), color="#c9b458", lw=1.0)
    axes.scatter(goal[0], goal[1], -goal[2], color="#c0392b", s=18)
    reach = 1.2 * max(0.5, float(np.abs(place).max()), float(path.abs().max()))
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), zlim=(-0.75 * reach, 0.75 * reach))
    axes.set_box_aspect((1, 1, 0.75), zoom=1.25)
    return _pixels(figure)


def body_picture(
    x: Tensor,
    faces: Tensor,
    *,
    center: Tensor,
    reach: float,
    ground: float | None = None,
    goal: Tensor | None = None,
) -> NDArray[np.uint8]:
    """A soft body's surface.

    Args:
        x: Nodes, (num_nodes, 3) [m], z up.
        faces: (num_faces, 3 or 4).
        center: What the camera looks at, (3,) [m].
        reach: Half width of what is seen [m].
        ground: Height of the floor [m]; None: there is none. Its tiles do not move.
        goal: A point to be marked, (3,) [m].
    """
    from matplotlib.colors import LightSource
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    figure, axes = _scene()
    cx, cy, cz = (float(c) for c in center)
    if ground is not None:
        tiles, shades = _tiles(cx, cy, reach, ground)
        axes.add_collection3d(Poly3DCollection(tiles, facecolors=shades, edgecolors="none"))
    axes.add_collection3d(
        Poly3DCollection(
            x.numpy()[faces.numpy()],
            facecolors="#f0a95c",
            edgecolors="#7a431055",
            linewidths=0.3,
            shade=True,
            lightsource=LightSource(azdeg=240, altdeg=45),
        )
    )
    if goal is not None:
        axes.scatter(*goal.tolist(), color="#c0392b", s=30, zorder=5)
    axes.set(
        xlim=(cx - reach, cx + reach),
        ylim=(cy - reach, cy + reach),
        zlim=(cz - 0.75 * reach, cz + 0.75 * reach),
    )
    axes.set_box_aspect((1, 1, 0.75), zoom=1.35)
    return _pixels(figure)


def _tiles(cx: float, cy: float, reach: float, height: float) -> tuple[Array, list[str]]:
    """Squares (n, 4, 3) of a chessboard fixed in the world, those in reach; and colors."""
    size = 0.4 * reach
    first = np.ceil((np.array([cx, cy]) - reach) / size).astype(int)
    i, j = (g.ravel() for g in np.meshgrid(first[0] + np.arange(4), first[1] + np.arange(4)))
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    flat = size * (np.stack([i, j], -1)[:, None] + corners)
    tiles = np.concatenate([flat, np.full((*flat.shape[:2], 1), height)], -1)
    return tiles, [("#e9ecee", "#d5dade")[k] for k in (i + j) % 2]


def _scene() -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(SIZE[0] / _DPI, SIZE[1] / _DPI), dpi=_DPI)
    FigureCanvasAgg(figure)
    axes: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0), projection="3d", computed_zorder=False)
    axes.view_init(22, -62)
    axes.set_axis_off()
    return figure, axes


def _line(axes: Any, points: Array, **style: Any) -> None:
    """A line through points in NED, drawn with z up."""
    axes.plot(points[:, 0], points[:, 1], -points[:, 2], **style)


def _pixels(figure: Any) -> NDArray[np.uint8]:
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()
