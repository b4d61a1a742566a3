"""Motion strips and recordings of applications."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim import mesh
from diffsim.viz.palette import save
from diffsim.viz.scene import MovingPoints, MovingSurface, Scene, write
from examples.applications.application import Application

INK, FLOOR, TARGET = "#1d2433", "#e4e8ee", "#b3362a"
COLORS = ("#c2571a", "#0b6e75", "#8a93a3")  # before, after, target motion
RECORDING_FRAMES = 120


def motion_strip(
    application: Application,
    motions: Mapping[str, Tensor],
    path: Path,
    *,
    frames: int = 5,
    view: tuple[float, float] = (14.0, -65.0),
) -> Path:
    """Draw frames of several motions: a row each, times from left to right, one scale for all.

    Motions along a floor have a column each, times from top to bottom.

    Args:
        application: Whose body and targets are drawn.
        motions: Positions of the nodes over time by caption, (num_steps + 1, num_nodes, 3) [m].
        path: PNG file to be written.
        frames: Number of times that each row shows.
        view: Elevation and azimuth [degrees].
    """
    import matplotlib.pyplot as plt

    faces = _faces(application)
    whole = torch.cat([x[_steps(x, frames)].reshape(-1, 3) for x in motions.values()])
    points = torch.tensor([list(p) for p in application.targets.values()], dtype=whole.dtype)
    whole = torch.cat([whole, points.reshape(-1, 3)])
    low, high = whole.min(0).values.numpy(), whole.max(0).values.numpy()
    size = np.maximum(high - low, 0.05 * (high - low).max())
    # a way along the floor is long and flat: times from top to bottom, and wide frames
    wide = bool(application.obstacles) and size.max() > 1.5 * size[2]
    rows, columns = (frames, len(motions)) if wide else (len(motions), frames)
    side = 5.0 if wide else 2.6
    height = max(1.2, 0.84 * side * size[2] / size.max() + 0.4) if wide else side + 0.3
    figure = plt.figure(figsize=(side * columns, height * rows))
    for m, (caption, x) in enumerate(motions.items()):
        for f, step in enumerate(_steps(x, frames)):
            r, c = (f, m) if wide else (m, f)
            # axes in 3D are square: those of a flat row overlap their neighbors', unseen
            bottom = 1.0 - ((r + 0.5) * height + 0.5 * side) / (height * rows)
            place = (c / columns, bottom, 1.0 / columns, side / (height * rows))
            axes: Any = figure.add_axes(place, projection="3d", computed_zorder=False)
            axes.patch.set_visible(False)
            axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
            axes.set_box_aspect(tuple(size), zoom=0.84 if wide else 1.1)
            axes.view_init(*view)
            axes.set_axis_off()
            if application.obstacles:
                _floor(axes, low, high)
            _surface(axes, x[step].numpy()[faces], COLORS[m % len(COLORS)])
            if application.follow is not None:
                trail = application.follow(x[: step + 1]).numpy().T
                axes.plot(*trail, ".", color=INK, ms=2, zorder=20)
            for target in application.targets.values():
                axes.scatter(*target, color=TARGET, s=30, depthshade=False, zorder=30)
            title = f"{1e3 * step * application.body.dt:.0f} ms"
            figure.text(
                c / columns + 0.01,
                1.0 - (r + 0.03) / rows,
                f"{caption}, {title}" if f == 0 else title,
                fontsize=9,
                va="top",
            )
    return save(figure, path, dpi=90)


def recording(application: Application, motions: Mapping[str, Tensor], path: Path) -> Path:
    """Write the motions as an ``.rrd``, at most ``RECORDING_FRAMES`` frames each."""
    triangles = _triangles(application)
    surfaces, points = [], []
    for k, (caption, x) in enumerate(motions.items()):
        steps = _steps(x, min(RECORDING_FRAMES, len(x)))
        time_s = application.body.dt * np.asarray(steps, float)
        surfaces.append(
            MovingSurface(
                path=f"{application.name}/{caption.replace(' ', '_')}",
                time_s=time_s,
                nodes_m=x[steps].numpy().astype(np.float32),
                triangles=triangles,
                color=COLORS[k % len(COLORS)],
            )
        )
    size = float(
        (application.body.x_rest.max(0).values - application.body.x_rest.min(0).values).max()
    )
    for name, place in application.targets.items():
        points.append(
            MovingPoints(
                path=f"{application.name}/{name.replace(' ', '_')}",
                time_s=np.zeros(1),
                points_m=np.asarray(place, float)[None, None],
                color=TARGET,
                radius_m=0.02 * size,
            )
        )
    note = f"# {application.title}\n\n{application.source}"
    return write(Scene(title=application.name, note=note, surfaces=surfaces, points=points), path)


def _faces(application: Application) -> np.ndarray:
    m = application.body.mesh
    surface = mesh.surface_quads(m) if isinstance(m, mesh.HexMesh) else mesh.surface_triangles(m)
    return surface.faces.numpy()


def _triangles(application: Application) -> np.ndarray:
    faces = _faces(application)
    if faces.shape[1] == 3:
        return faces
    return np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])


def _steps(x: Tensor, frames: int) -> list[int]:
    return np.linspace(0, len(x) - 1, frames).round().astype(int).tolist()


def _surface(axes: Any, polygons: np.ndarray, color: str) -> None:
    from matplotlib.colors import LightSource
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    axes.add_collection3d(
        Poly3DCollection(
            polygons,
            facecolors=color,
            edgecolors=INK,
            linewidths=0.1,
            shade=True,
            lightsource=LightSource(azdeg=225, altdeg=50),
        )
    )


def _floor(axes: Any, low: np.ndarray, high: np.ndarray) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    z = min(0.0, float(low[2]))
    corners = [
        (low[0], low[1], z),
        (high[0], low[1], z),
        (high[0], high[1], z),
        (low[0], high[1], z),
    ]
    axes.add_collection3d(Poly3DCollection([corners], facecolors=FLOOR, zorder=-10))
