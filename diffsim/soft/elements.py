"""Elements of a solid: how its energy is integrated over hexahedra and tetrahedra.

* ``"standard"``: trilinear hexahedra at 2x2x2 Gauss points, linear tetrahedra. Thin bodies and
  nearly incompressible ones lock: they are too stiff until many cells span their thickness.
* ``"assumed_strain"``: hexahedra at their mean deformation gradient, with hourglass strains that
  bend like plates (csrc/kernels/soft/hourglass.h). One cell through the thickness bends, at any
  Poisson's ratio. A material is evaluated once for each element instead of eight times.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffsim.core.check import require_choice
from diffsim.core.layer import on_constants
from diffsim.mesh import HexMesh, ShapeGradients, TetMesh, shape_gradients
from diffsim.mesh.reference import HEX_CORNERS, Array
from diffsim.soft.materials import SmallStrain

ELEMENTS = ("standard", "assumed_strain")

_SIGNS: Array = 2.0 * HEX_CORNERS - 1.0
_MODES = ((0, 1), (0, 2), (1, 2), (0, 1, 2))
"""Coordinates whose product each hourglass mode is."""


def require_element(element: str | None, mesh: HexMesh | TetMesh) -> str:
    """The name of an element that a mesh can have; None: the standard one."""
    name = require_choice("element", "standard" if element is None else element, ELEMENTS)
    if name == "assumed_strain" and mesh.kind != "hex":
        raise ValueError(
            "element='assumed_strain' needs a HexMesh, got a TetMesh; mesh with hexahedra, or "
            "refine the tetrahedra and compare"
        )
    return name


@on_constants()
def element_shapes(mesh: HexMesh | TetMesh, element: str) -> tuple[str, ShapeGradients, Tensor]:
    """What the kernels read of a mesh's elements.

    Args:
        mesh: Rest shape.
        element: One of ``ELEMENTS``.

    Returns:
        Kind by the kernels' name, shape gradients, and hourglass tables
        (num_classes, 95) of kind ``mean_hex``, empty otherwise.
    """
    shape = shape_gradients(mesh)
    if element == "standard":
        return mesh.kind, shape, torch.zeros(0, dtype=torch.float64)
    grad, weight = shape.grad.numpy(), shape.weight.numpy()
    volume = weight.sum(axis=1)
    mean = np.einsum("cq,cqai->cai", weight, grad) / volume[:, None, None]
    first = np.unique(shape.class_idx.numpy(), return_index=True)[1]
    corners = mesh.x_rest.numpy()[mesh.elements.numpy()[first]]
    table = np.concatenate([_gammas(corners, mean), _rows(corners, volume)], axis=1)
    means = ShapeGradients(
        torch.from_numpy(mean[:, None].copy()),
        torch.from_numpy(volume[:, None].copy()),
        shape.class_idx,
    )
    return "mean_hex", means, torch.from_numpy(np.ascontiguousarray(table))


def hourglass_weights(moduli: SmallStrain) -> tuple[Tensor, Tensor]:
    """Moduli of plane stress, 2 mu and 2 mu lambda/(lambda + 2 mu), (..., num_elements) [Pa].

    Energy of an in-plane strain e: mu |e|^2 + 1/2 times the second times tr(e)^2.
    """
    two_mu, lame_lambda = moduli
    return two_mu, two_mu * lame_lambda / (lame_lambda + two_mu)


def _gammas(corners: Array, mean: Array) -> Array:
    """Vectors gamma of the modes, (C, 32): amplitude sum_a gamma_a x_a, zero for linear fields."""
    out = []
    for mode in _MODES:
        plain = _SIGNS[:, mode].prod(axis=1) / 8.0
        rest = np.einsum("a,cai->ci", plain, corners)
        out.append(plain - np.einsum("cai,ci->ca", mean, rest))
    return np.concatenate(out, axis=1)


def _rows(corners: Array, volume: Array) -> Array:
    """Rows of the strains, (C, 63): s_k = sum over its rows of h . F row [m^(3/2)].

    Strains 11, 22 and sqrt(2) 12 in orthonormal axes of each mid-surface, two rows each, then
    the normal strains of mode 012, one row each.
    """
    base = np.einsum("ar,cai->cri", _SIGNS / 8.0, corners)  # A_r = dX/dxi_r at the center
    rows = np.zeros((len(corners), 21, 3))
    for d in range(3):
        i, j = (r for r in range(3) if r != d)
        surface = base[:, [i, j]]
        inverse_metric = np.linalg.inv(surface @ surface.transpose(0, 2, 1))
        axes = np.linalg.cholesky(inverse_metric)  # axis p is sum_r axes_rp A_r, orthonormal
        units = np.einsum("crp,cri->cpi", axes, surface)
        for c, (p, q, factor) in enumerate(((0, 0, 1.0), (1, 1, 1.0), (0, 1, np.sqrt(2.0)))):
            for t in range(2):  # of h_id, of h_jd
                rows[:, 6 * d + 2 * c + t] = (factor / 2.0) * (
                    axes[:, t, p, None] * units[:, q] + axes[:, t, q, None] * units[:, p]
                )
    rows[:, :18] *= np.sqrt(volume / 3.0)[:, None, None]
    squares = np.einsum("cri,cri->cr", base, base)
    rows[:, 18:] = base / squares[..., None] * np.sqrt(volume / 9.0)[:, None, None]
    return rows.reshape(len(corners), -1)
