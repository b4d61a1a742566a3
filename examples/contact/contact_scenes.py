"""What the contact stories share: a rubber duck, mean positions, drawing and saving."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from diffsim import mesh, soft
from diffsim.mesh.sdf import ellipsoid, smooth_union
from diffsim.viz.palette import save as save

Triple = tuple[float, float, float]
THESIS_DUCK = 0.0111
"""Spacing [m] that gives 16,926 DoF; the thesis's duck has 16,776."""
INK, TEAL, ORANGE, RED, GREY = "#1d2433", "#0b6e75", "#c2571a", "#b3362a", "#8a93a3"
YELLOW, BLUE = "#f4c430", "#9fc3d9"


def duck(spacing: float = THESIS_DUCK) -> mesh.TetMesh:
    """A rubber duck, 25 cm long, that looks along +x and stands on the plane z = 0.

    Ellipsoids with smooth seams, cut flat below; tetrahedra with their longest edges about
    ``spacing`` [m].
    """
    body = ellipsoid((0.100, 0.076, 0.064))
    body = smooth_union(body, ellipsoid((0.052, 0.050, 0.050), (0.056, 0.0, 0.104)), 0.032)  # head
    body = smooth_union(body, ellipsoid((0.040, 0.040, 0.024), (-0.094, 0.0, 0.040)), 0.040)  # tail
    body = smooth_union(body, ellipsoid((0.028, 0.026, 0.012), (0.114, 0.0, 0.094)), 0.012)  # beak
    for side in (-1.0, 1.0):
        wing = ellipsoid((0.050, 0.018, 0.028), (-0.012, side * 0.072, 0.012))
        body = smooth_union(body, wing, 0.016)
    whole = mesh.sdf.intersection(body, mesh.sdf.plane((0.0, 0.0, -1.0), 0.048))
    tets = mesh.tet_from_sdf(whole, ((-0.16, -0.12, -0.08), (0.16, 0.12, 0.18)), spacing)
    low = tets.x_rest[:, 2].min()
    return mesh.TetMesh(tets.x_rest - low * _vector((0.0, 0.0, 1.0)), tets.tets)


def tilted(m: mesh.TetMesh, angle: float, place: Triple) -> mesh.TetMesh:
    """The mesh with its nose turned down by an angle [rad] about y, then moved by ``place`` [m]."""
    c, s = torch.cos(torch.tensor(angle)).item(), torch.sin(torch.tensor(angle)).item()
    turn = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], dtype=torch.float64)
    return mesh.TetMesh(m.x_rest @ turn.T + _vector(place), m.tets)


def center(body: soft.SoftBody, x: Tensor) -> Tensor:
    """Center of mass of positions (..., num_nodes, 3) -> (..., 3) [m]."""
    mass = body.physics().mass
    return (mass[:, None] * x).sum(-2) / mass.sum()


@contextmanager
def cpu_seconds() -> Iterator[Callable[[], float]]:
    """CPU time of the ``with`` block [s], all threads; call the result after it."""
    start, end = time.process_time(), []
    yield lambda: end[0] - start
    end.append(time.process_time())


def add_body(axes, m: mesh.HexMesh | mesh.TetMesh, x: Tensor, color: str, **options) -> None:
    """Draw the surface of a body at positions (num_nodes, 3) [m] into 3D axes."""
    from matplotlib.colors import LightSource
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    is_hex = isinstance(m, mesh.HexMesh)
    faces = (mesh.surface_quads if is_hex else mesh.surface_triangles)(m).faces
    edges = {"linewidths": 0.2, "edgecolors": INK} if is_hex else {"linewidths": 0.0}
    surface = Poly3DCollection(
        x.detach()[faces].numpy(),
        facecolors=color,
        shade=True,
        lightsource=LightSource(azdeg=225, altdeg=50),
        **{**edges, **options},
    )
    axes.add_collection3d(surface)
    surface.set_clip_on(False)


def add_patch(axes, corners: Tensor, color, **options) -> None:
    """Draw one flat polygon (num_corners, 3) [m], or several (num, num_corners, 3)."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    patches = corners.detach().reshape(-1, *corners.shape[-2:]).numpy()
    surface = Poly3DCollection(patches, facecolors=color, **options)
    axes.add_collection3d(surface)
    surface.set_clip_on(False)


def tidy(*many) -> None:
    """Plots without the frame's upper and right line."""
    for axes in many:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(True, color="#d9dde4", lw=0.5)
        axes.set_axisbelow(True)


def _vector(values: Triple) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)
