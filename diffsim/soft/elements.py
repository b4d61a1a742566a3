"""Elements of a solid: how its energy is integrated over hexahedra and tetrahedra.

* ``"standard"``: trilinear hexahedra at 2x2x2 Gauss points, linear tetrahedra. Thin bodies and
  nearly incompressible ones lock: they are too stiff until many cells span their thickness.
* ``"assumed_strain"``: hexahedra at their mean deformation gradient, with hourglass strains that
  bend like plates (csrc/kernels/soft/hourglass.h). One cell through the thickness bends, at any
  Poisson's ratio. A material is evaluated once for each element instead of eight times.
* ``"quadratic"``: ten-node tetrahedra. Their mesh is that of their eighths
  (:func:`~diffsim.mesh.split_tets`): surface, masses, muscles and parameters are of these, and a
  material is evaluated once for each, with the deformation gradient of the whole.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from diffsim.core.check import require_choice
from diffsim.core.torch_names import on_constants
from diffsim.mesh import HexMesh, ShapeGradients, TetMesh, shape_gradients
from diffsim.mesh.reference import HEX_CORNERS, TET_EDGES, Array, IntArray
from diffsim.mesh.shape import tet_gradients
from diffsim.mesh.split import join_eighths
from diffsim.soft.materials import SmallStrain

ELEMENTS = ("standard", "assumed_strain", "quadratic")

_SIGNS: Array = (2 * HEX_CORNERS - 1).astype(np.float64)
_MODES = ((0, 1), (0, 2), (1, 2), (0, 1, 2))
"""Coordinates whose product each hourglass mode is."""
_SAMPLES: Array = np.concatenate(
    [0.1 + 0.6 * np.eye(4), 0.3 - 0.2 * np.eye(4)[[3, 0, 1, 2]]], axis=0
)
"""Barycentric coordinates of the points that stand for the eighths of a tetrahedron, (8, 4); the
last four are next to the face that an inner eighth has, opposite to that corner."""


def require_element(element: str | None, mesh: HexMesh | TetMesh) -> str:
    """The name of an element that a mesh can have; None: the standard one."""
    name = require_choice("element", "standard" if element is None else element, ELEMENTS)
    if name == "assumed_strain" and mesh.kind != "hex":
        raise ValueError(
            "element='assumed_strain' needs a HexMesh, got a TetMesh; for tetrahedra there is "
            "element='quadratic', on mesh.split_tets(mesh)"
        )
    if name == "quadratic" and mesh.kind != "tet":
        raise ValueError(
            "element='quadratic' needs a TetMesh, got a HexMesh; for hexahedra there is "
            "element='assumed_strain'"
        )
    return name


@dataclass(frozen=True, kw_only=True, eq=False)
class ElementTables:
    """What the kernels read of a mesh's elements.

    Attributes:
        kind: By the kernels' name.
        elements: Nodes that an element's deformation gradient depends on, (num_elements, k) int64.
        shape: Their shape gradients at the samples.
        hourglass: (num_classes, 95) of kind ``mean_hex``, empty otherwise.
    """

    kind: str
    elements: Tensor
    shape: ShapeGradients
    hourglass: Tensor


@on_constants()
def element_tables(mesh: HexMesh | TetMesh, element: str) -> ElementTables:
    """Tables of a mesh for one of ``ELEMENTS``."""
    none = torch.zeros(0, dtype=torch.float64)
    shape = shape_gradients(mesh)
    if element == "standard":
        return ElementTables(kind=mesh.kind, elements=mesh.elements, shape=shape, hourglass=none)
    if isinstance(mesh, TetMesh):
        ten = join_eighths(mesh)
        return ElementTables(
            kind="eighth_tet",
            elements=torch.from_numpy(ten.repeat(8, axis=0)),
            shape=replace(shape, grad=torch.from_numpy(_eighth_gradients(mesh, ten))),
            hourglass=none,
        )
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
    return ElementTables(
        kind="mean_hex",
        elements=mesh.elements,
        shape=means,
        hourglass=torch.from_numpy(np.ascontiguousarray(table)),
    )


def _eighth_gradients(mesh: TetMesh, ten: IntArray) -> Array:
    """Gradients of the ten shape functions at the eighths' samples, (8 T, 1, 10, 3) [1/m].

    N_a = l_a (2 l_a - 1) at corners and 4 l_a l_b at midpoints, l the barycentric coordinates.
    The centers' own coordinates would integrate bending by five sixths; those of ``_SAMPLES`` have
    the same symmetry and are exact for products of linear strains.
    """
    slopes = tet_gradients(mesh.x_rest.numpy()[ten[:, :4]])[0]  # of l, (T, 4, 3)
    by_l = np.zeros((8, 10, 4))  # dN_a/dl_b
    by_l[:, range(4), range(4)] = 4.0 * _SAMPLES - 1.0
    for k, (a, b) in enumerate(TET_EDGES):
        by_l[:, 4 + k, a] = 4.0 * _SAMPLES[:, b]
        by_l[:, 4 + k, b] = 4.0 * _SAMPLES[:, a]
    return np.ascontiguousarray(np.einsum("kab,tbi->tkai", by_l, slopes).reshape(-1, 1, 10, 3))


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
