"""The two volume meshes: immutable, checked once, shared by everything that simulates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from diffsim.core.arrays import IntArray
from diffsim.core.check import require, require_constant
from diffsim.core.checked import checked
from diffsim.core.errors import MeshError
from diffsim.core.module import loadable
from diffsim.core.numbers import values_of
from diffsim.core.torch_names import on_constants
from diffsim.core.values import as_array
from diffsim.mesh import validate
from diffsim.mesh.reference import HEX_EDGES, TET_EDGES

Kind = Literal["hex", "tet"]


class Mesh:
    """What `HexMesh` and `TetMesh` share; make one of those.

    A mesh copies the tensors it is given and is never changed afterwards: solvers that were
    prepared for it use the object itself as their key. It carries no gradient; functions that are
    differentiable in positions take positions.
    """

    kind: ClassVar[Kind]
    nodes_per_element: ClassVar[int]
    _elements: ClassVar[str]  # the field that has them
    _local_edges: ClassVar[IntArray]
    x_rest: Tensor

    @property
    def elements(self) -> Tensor:
        """Node indices of the elements, (num_elements, nodes_per_element) int64."""
        elements: Tensor = getattr(self, self._elements)
        return elements

    @property
    def nodes(self) -> Tensor:
        """Node positions at rest, (num_nodes, 3) [m]: another name of ``x_rest``."""
        return self.x_rest

    @property
    def num_nodes(self) -> int:
        """Number of nodes."""
        return self.x_rest.shape[0]

    @property
    def num_vertices(self) -> int:
        """Number of nodes, by the word that surfaces have."""
        return self.x_rest.shape[0]

    @property
    def num_elements(self) -> int:
        """Number of elements."""
        return self.elements.shape[0]

    @property
    def num_dofs(self) -> int:
        """Three displacements per node."""
        return 3 * self.num_nodes

    @property
    def bounds(self) -> Tensor:
        """Lower and upper corner of the bounding box, (2, 3) [m]."""
        return torch.stack([self.x_rest.min(dim=0).values, self.x_rest.max(dim=0).values])

    def edges(self) -> Tensor:
        """Edges of the elements, each once with the lower index first, (num_edges, 2) int64."""
        local = torch.from_numpy(self._local_edges)
        pairs = self.elements[:, local].reshape(-1, 2).sort(dim=1).values
        keys = torch.unique(pairs[:, 0] * self.num_nodes + pairs[:, 1])
        return torch.stack([keys // self.num_nodes, keys % self.num_nodes], dim=1)

    @checked
    def nodes_where(self, predicate: Callable[[Tensor], Tensor]) -> Tensor:
        """Indices of the nodes at which ``predicate(x_rest)`` holds.

        Args:
            predicate: Takes (num_nodes, 3) positions [m], returns (num_nodes,) bool, a tensor
                or an array.

        Returns:
            Node indices, ascending, (num_selected,) int64.

        Raises:
            TypeError, ValueError: the predicate does not return one bool per node.
            MeshError: no node is selected.
        """
        chosen = as_array("predicate(x_rest)", predicate(self.x_rest.clone()), torch.bool)
        chosen = require("predicate(x_rest)", chosen, (self.num_nodes,), torch.bool)
        nodes = torch.nonzero(chosen).flatten()
        if nodes.numel() == 0:
            raise MeshError(f"no node satisfies the predicate; the mesh spans {self._span()}")
        return nodes

    @checked
    def nodes_near_plane(self, axis: int | str, value: float, tol: float | None = None) -> Tensor:
        """Indices of the nodes with ``|x[axis] - value| <= tol``.

        Args:
            axis: Axis normal to the plane: 0, 1, 2 or "x", "y", "z".
            value: Position of the plane on that axis [m].
            tol: Half thickness [m]; 1e-6 of the diagonal of the bounding box when not given.

        Returns:
            Node indices, ascending, (num_selected,) int64.
        """
        axis_idx = _axis(axis)
        if tol is None:
            low, high = self.bounds
            tol = 1e-6 * float((high - low).norm())
        away = (self.x_rest[:, axis_idx] - value).abs()
        nodes = torch.nonzero(away <= tol).flatten()
        if nodes.numel() == 0:
            raise MeshError(
                f"no node lies within {tol:.3g} m of the plane {'xyz'[axis_idx]} = {value:g} m, "
                f"the nearest is {float(away.min()):.3g} m away; the mesh spans {self._span()}"
            )
        return nodes

    def _span(self) -> str:
        low, high = self.bounds.tolist()
        parts = zip("xyz", low, high, strict=True)
        return ", ".join(f"{name} in [{a:g}, {b:g}]" for name, a, b in parts) + " m"

    def __post_init__(self) -> None:
        """Check the fields, then replace them by copies that nobody else can change."""
        field = self._elements
        for name, value in (("x_rest", self.x_rest), (field, self.elements)):
            require_constant(name, value, "parameters of a shape move its mesh")
        x = require("x_rest", as_array("x_rest", self.x_rest), ("num_nodes", 3), torch.float64)
        elements = require(
            field,
            as_array(field, self.elements, torch.int64),
            ("num_elements", self.nodes_per_element),
            torch.int64,
        )
        with on_constants():
            object.__setattr__(self, "x_rest", values_of(x).clone())
            object.__setattr__(self, field, values_of(elements).clone())
            nodes, indices = self.x_rest.numpy(), self.elements.numpy()
            validate.check_indices(indices, self.num_nodes, field)
            validate.check_size(nodes)
            validate.check_nodes(nodes, indices, field)
            check = validate.check_hexes if self.kind == "hex" else validate.check_tets
            check(nodes, indices)

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.num_nodes} nodes, {self.num_elements} elements, "
            f"{self._span()})"
        )


@loadable
@dataclass(frozen=True, eq=False, repr=False)
class HexMesh(Mesh):
    """Trilinear hexahedra.

    Attributes:
        x_rest: Node positions at rest, (num_nodes, 3) float64 [m]; also called ``nodes``. A
            tensor, NumPy array or list.
        hexes: Node indices, (num_elements, 8) int64, local order (di, dj, dk) = 000, 001, 010,
            011, 100, 101, 110, 111. For VTK's order use ``vtk[:, HEX_FROM_VTK]``.

    Raises:
        MeshError: no elements, indices out of range or repeated, unused or coincident nodes,
            det J <= 0 at a corner or a 2x2x2 Gauss point.
    """

    x_rest: Tensor
    hexes: Tensor

    kind = "hex"
    nodes_per_element = 8
    _elements = "hexes"
    _local_edges = HEX_EDGES


@loadable
@dataclass(frozen=True, eq=False, repr=False)
class TetMesh(Mesh):
    """Linear tetrahedra.

    Attributes:
        x_rest: Node positions at rest, (num_nodes, 3) float64 [m]; also called ``nodes``. A
            tensor, NumPy array or list.
        tets: Node indices, (num_elements, 4) int64, right-handed: det[x1-x0, x2-x0, x3-x0] > 0.

    Raises:
        MeshError: no elements, indices out of range or repeated, unused or coincident nodes,
            elements without positive volume.
    """

    x_rest: Tensor
    tets: Tensor

    kind = "tet"
    nodes_per_element = 4
    _elements = "tets"
    _local_edges = TET_EDGES


def _axis(axis: int | str) -> int:
    names = {"x": 0, "y": 1, "z": 2, 0: 0, 1: 1, 2: 2}
    if axis not in names:
        raise ValueError(f"axis must be 0, 1, 2 or 'x', 'y', 'z', got {axis!r}")
    return names[axis]
