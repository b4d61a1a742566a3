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

from diffsim.core.arrays import Array
from diffsim.core.check import require_choice
from diffsim.core.torch_names import on_constants
from diffsim.mesh import HexMesh, TetMesh
from diffsim.mesh.reference import HEX_CORNERS, TET_EDGES
from diffsim.mesh.shape import different_elements, shape_tables, tet_gradients
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
    """What the kernels read of a mesh's elements."""

    kind: str  # by the kernels' name
    # nodes that an element's deformation gradient depends on, (num_elements, k) int64
    elements: Tensor
    class_idx: Tensor  # row of the others that an element uses, (num_elements,) int64
    grad: Tensor  # their shape gradients at the samples, (num_classes, num_samples, k, 3) [1/m]
    weight: Tensor  # volume of each sample, (num_classes, num_samples) [m^3]
    hourglass: Tensor  # (num_classes, 95) of kind ``mean_hex``, else (num_classes, 0)

    def by_element(self) -> Tensor:
        """The tables of each element as one row, as kernels take them, where none share theirs."""
        return torch.cat([self.grad.flatten(1), self.weight, self.hourglass], dim=1)

    def replaced_by(self, rows: Tensor) -> ElementTables:
        """The tables of other rows, see :meth:`by_element`."""
        count, samples = len(self.elements), self.weight.shape[1]
        sizes = (self.grad[0].numel(), samples, self.hourglass.shape[1])
        grad, weight, hourglass = (part.contiguous() for part in rows.split(sizes, dim=1))
        return replace(
            self,
            class_idx=torch.arange(count),
            grad=grad.reshape(count, *self.grad.shape[1:]),
            weight=weight,
            hourglass=hourglass,
        )


_KINDS = {"assumed_strain": "mean_hex", "quadratic": "eighth_tet"}


@on_constants()
def element_tables(mesh: HexMesh | TetMesh, element: str) -> ElementTables:
    """Tables of a mesh for one of ``ELEMENTS``; elements that are alike share theirs."""
    elements, class_idx = different_elements(mesh)
    return _tables(mesh, element, mesh.x_rest, elements, class_idx)


def moved_tables(mesh: HexMesh | TetMesh, element: str, x_rest: Tensor) -> ElementTables:
    """Tables of a mesh whose nodes lie at x_rest (num_nodes, 3) [m]. Gradient: x_rest."""
    return _tables(mesh, element, x_rest, None, torch.arange(mesh.num_elements))


def _tables(
    mesh: HexMesh | TetMesh, element: str, x: Tensor, which: Tensor | None, class_idx: Tensor
) -> ElementTables:
    grad, weight = shape_tables(mesh, x, which)
    hourglass, nodes = weight[:, :0], mesh.elements
    if element == "assumed_strain":
        corners = x[nodes if which is None else nodes[which]]
        volume = weight.sum(1)
        mean = torch.einsum("cq,cqai->cai", weight, grad) / volume[:, None, None]
        hourglass = torch.cat([_gammas(corners, mean), _rows(corners, volume)], dim=1)
        grad, weight = mean[:, None], volume[:, None]
    elif isinstance(mesh, TetMesh) and element == "quadratic":
        ten = torch.from_numpy(join_eighths(mesh))
        nodes, grad = ten.repeat_interleave(8, dim=0), _eighth_gradients(x[ten[:, :4]])
    return ElementTables(
        kind=_KINDS.get(element, mesh.kind),
        elements=nodes,
        class_idx=class_idx,
        grad=grad.contiguous(),
        weight=weight.contiguous(),
        hourglass=hourglass.contiguous(),
    )


def _eighth_gradients(corners: Tensor) -> Tensor:
    """Gradients of the ten shape functions at the eighths' samples, (8 T, 1, 10, 3) [1/m], of
    tetrahedra (T, 4, 3) [m].

    N_a = l_a (2 l_a - 1) at corners and 4 l_a l_b at midpoints, l the barycentric coordinates.
    The centers' own coordinates would integrate bending by five sixths; those of ``_SAMPLES`` have
    the same symmetry and are exact for products of linear strains.
    """
    slopes = tet_gradients(corners)[0]  # of l, (T, 4, 3)
    by_l = np.zeros((8, 10, 4))  # dN_a/dl_b
    by_l[:, range(4), range(4)] = 4.0 * _SAMPLES - 1.0
    for k, (a, b) in enumerate(TET_EDGES):
        by_l[:, 4 + k, a] = 4.0 * _SAMPLES[:, b]
        by_l[:, 4 + k, b] = 4.0 * _SAMPLES[:, a]
    return torch.einsum("kab,tbi->tkai", torch.from_numpy(by_l), slopes).flatten(0, 1)[:, None]


def hourglass_weights(moduli: SmallStrain) -> tuple[Tensor, Tensor]:
    """Moduli of plane stress, 2 mu and 2 mu lambda/(lambda + 2 mu), (..., num_elements) [Pa].

    Energy of an in-plane strain e: mu |e|^2 + 1/2 times the second times tr(e)^2.
    """
    two_mu, lame_lambda = moduli
    return two_mu, two_mu * lame_lambda / (lame_lambda + two_mu)


def _gammas(corners: Tensor, mean: Tensor) -> Tensor:
    """Vectors gamma of the modes, (C, 32): amplitude sum_a gamma_a x_a, zero for linear fields."""
    out = []
    for mode in _MODES:
        plain = torch.from_numpy(_SIGNS[:, mode].prod(axis=1) / 8.0)
        rest = torch.einsum("a,cai->ci", plain, corners)
        out.append(plain - torch.einsum("cai,ci->ca", mean, rest))
    return torch.cat(out, dim=1)


def _rows(corners: Tensor, volume: Tensor) -> Tensor:
    """Rows of the strains, (C, 63): s_k = sum over its rows of h . F row [m^(3/2)].

    Strains 11, 22 and sqrt(2) 12 in orthonormal axes of each mid-surface, two rows each, then
    the normal strains of mode 012, one row each.
    """
    signs = torch.from_numpy(_SIGNS / 8.0)
    base = torch.einsum("ar,cai->cri", signs, corners)  # A_r = dX/dxi_r at the center
    rows = []
    for d in range(3):
        surface = base[:, [r for r in range(3) if r != d]]
        inverse_metric = torch.linalg.inv(surface @ surface.transpose(1, 2))
        axes = torch.linalg.cholesky(inverse_metric)  # axis p is sum_r axes_rp A_r, orthonormal
        units = torch.einsum("crp,cri->cpi", axes, surface)
        for p, q, factor in ((0, 0, 1.0), (1, 1, 1.0), (0, 1, np.sqrt(2.0))):
            for t in range(2):  # of h_id, of h_jd
                rows.append(
                    (factor / 2.0)
                    * (axes[:, t, p, None] * units[:, q] + axes[:, t, q, None] * units[:, p])
                )
    flat = torch.stack(rows, dim=1) * torch.sqrt(volume / 3.0)[:, None, None]
    squares = torch.einsum("cri,cri->cr", base, base)
    normal = base / squares[..., None] * torch.sqrt(volume / 9.0)[:, None, None]
    return torch.cat([flat, normal], dim=1).flatten(1)
