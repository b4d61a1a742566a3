"""Families of shapes of one mesh: positions of its nodes as linear functions of a few numbers.

Both are differentiable; ``SoftBody.physics(x_rest=...)`` takes what they give.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from diffsim.core.check import (
    require,
    require_constant,
    require_count,
    require_counts,
    require_number,
)
from diffsim.core.checked import checked
from diffsim.core.errors import MeshError
from diffsim.core.numbers import require_unmapped, values_of
from diffsim.core.record import warn
from diffsim.core.torch_names import on_constants
from diffsim.mesh.core import HexMesh, Mesh, TetMesh
from diffsim.mesh.validate import relative_tet_volume, smallest_hex_jacobian

_HALVINGS = 20


class Cage:
    """Free-form deformation: a box of control points around a mesh, and B-splines between them.

    Node v lies at ``x_v + sum_ijk B_i(u_v) B_j(v_v) B_k(w_v) offsets[i, j, k]``, with clamped
    uniform B-splines B over the mesh's bounding box (Sederberg, Parry 1986). Zero offsets leave the
    mesh as it is; equal ones move it. ::

        cage = mesh.Cage(bar, (6, 2, 2))
        offsets = torch.zeros(*cage.shape, dtype=torch.float64, requires_grad=True)
        body.physics(x_rest=cage(offsets))

    Args:
        mesh: The mesh.
        points: Control points along each axis, at least 2.
        degree: Of the splines; lower along an axis of fewer than ``degree + 1`` points.

    Attributes:
        shape: Of offsets, (*points, 3).
        rest: Places of the control points, (*points, 3) [m].
    """

    def __init__(self, mesh: HexMesh | TetMesh, points: Sequence[int], *, degree: int = 3):
        if not isinstance(mesh, Mesh):
            raise TypeError(f"mesh must be a HexMesh or TetMesh, got {type(mesh).__name__}")
        counts = require_counts("points", points, 3)
        for n in counts:
            require_count("points", n, at_least=2)
        degree = require_count("degree", degree, at_least=1)
        self._x_rest = mesh.x_rest
        with on_constants():
            low, high = mesh.bounds
            unit = ((mesh.x_rest - low) / (high - low)).clamp(0.0, 1.0).numpy()
            knots = [_knots(n, min(degree, n - 1)) for n in counts]
            self._bases = [_basis(unit[:, i], *knots[i]) for i in range(3)]
            places = [_greville(*known) for known in knots]
            grid = torch.stack(torch.meshgrid(*places, indexing="ij"), dim=-1)
            self.rest = low + (high - low) * grid
        self.shape = (*counts, 3)

    @checked
    def __call__(self, offsets: Tensor) -> Tensor:
        """Positions of the nodes, (num_nodes, 3) [m].

        Args:
            offsets: How control points move, (*points, 3) [m].

        Returns:
            Gradient: offsets.
        """
        offsets = require("offsets", offsets, self.shape)
        moved = torch.einsum("vk,ijkc->vijc", self._bases[2], offsets)
        moved = torch.einsum("vj,vijc->vic", self._bases[1], moved)
        return self._x_rest + torch.einsum("vi,vic->vc", self._bases[0], moved)


class Blend:
    """Mixtures of shapes: ``x_rest + sum_k weights[k] (shapes[k] - x_rest)``.

    Args:
        mesh: The mesh.
        shapes: Other positions of its nodes, (num_shapes, num_nodes, 3) [m].
    """

    def __init__(self, mesh: HexMesh | TetMesh, shapes: Tensor):
        if not isinstance(mesh, Mesh):
            raise TypeError(f"mesh must be a HexMesh or TetMesh, got {type(mesh).__name__}")
        require_constant("shapes", shapes, "weights carry the gradient of a blend")
        shapes = require("shapes", shapes, ("num_shapes", mesh.num_nodes, 3))
        self._x_rest = mesh.x_rest
        self._away = values_of(shapes) - mesh.x_rest

    @checked
    def __call__(self, weights: Tensor) -> Tensor:
        """Positions of the nodes, (num_nodes, 3) [m].

        Args:
            weights: Share of each shape, (num_shapes,) [-].

        Returns:
            Gradient: weights.
        """
        weights = require("weights", weights, (len(self._away),))
        return self._x_rest + torch.einsum("k,kvc->vc", weights, self._away)


@checked
def safe_share(mesh: HexMesh | TetMesh, x: Tensor, moved: Tensor, *, least: float = 0.2) -> float:
    """How much of a step from one shape of a mesh to another its elements bear: 1, 1/2, 1/4, ...

    Each keeps at least ``least`` of the smallest Jacobian (over the cube of its longest edge) that
    it has in the mesh. A shorter step than the whole is said by a warning.

    Args:
        mesh: The mesh.
        x: Positions of the nodes, (num_nodes, 3) [m].
        moved: Where they are to go, (num_nodes, 3) [m].
        least: Share of each element's quality to be kept, in (0, 1) [-].

    Returns:
        Largest of these shares of the step.

    Raises:
        MeshError: the elements are worse at x already.
    """
    require_number("least", least, above=0.0, below=1.0)
    x, moved = (require(n, t, (mesh.num_nodes, 3)) for n, t in (("x", x), ("moved", moved)))
    require_unmapped(x=x, moved=moved)
    with on_constants():
        start, step = values_of(x), values_of(moved) - values_of(x)
        bound = least * _quality(mesh, mesh.x_rest)
        worst = -1
        for k in range(_HALVINGS):
            bad = np.flatnonzero(_quality(mesh, start + 0.5**k * step) < bound)
            if not len(bad):
                if k:
                    warn(
                        f"the step of the shape is shortened to 1/{2**k}: element {worst} would "
                        f"keep less than {least:g} of its quality",
                        stacklevel=3,
                    )
                return 0.5**k
            worst = int(bad[0])
    raise MeshError(
        f"element {worst} has less than {least:g} of its quality before the step; go back to an "
        "earlier shape, or lower least"
    )


def _quality(mesh: HexMesh | TetMesh, x: Tensor) -> np.ndarray:
    """Smallest Jacobian of each element over the cube of its longest edge, (num_elements,)."""
    if isinstance(mesh, HexMesh):
        return smallest_hex_jacobian(x.numpy(), mesh.hexes.numpy())
    return relative_tet_volume(x.numpy(), mesh.tets.numpy())


def _knots(count: int, degree: int) -> tuple[np.ndarray, int]:
    """Clamped uniform knots on [0, 1] of so many control points, and the degree."""
    inner = np.linspace(0.0, 1.0, count - degree + 1)
    return np.concatenate([np.zeros(degree), inner, np.ones(degree)]), degree


def _basis(unit: np.ndarray, knots: np.ndarray, degree: int) -> Tensor:
    """Values of all B-splines at places in [0, 1], (num_nodes, count)."""
    from scipy.interpolate import BSpline  # dear to load

    return torch.from_numpy(BSpline.design_matrix(unit, knots, degree).toarray())


def _greville(knots: np.ndarray, degree: int) -> Tensor:
    """Places of the control points of the straight line, in [0, 1]."""
    windows = np.lib.stride_tricks.sliding_window_view(knots[1:-1], degree)
    return torch.from_numpy(windows.mean(axis=1))
