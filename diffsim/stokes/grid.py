"""Cartesian grids of cells, in two or three dimensions."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from diffsim.core.check import require, require_counts, require_number, require_numbers
from diffsim.core.checked import checked

AXES = "xyz"


class Grid:
    """A box of equal cells; arrays over nodes or cells have one axis per direction.

    Args:
        shape: Cells per axis, two or three integers.
        spacing: Cell size [m]: one number, or one per axis.
        size: Size of the box [m], instead of ``spacing``.
        origin: Corner of the box with the lowest coordinates [m]; default zero.

    Example:
        >>> grid = Grid((64, 48), spacing=1.0 / 48)
        >>> phi = 0.3 - (grid.nodes - 0.5).norm(dim=-1)  # fluid in a disk
    """

    def __init__(
        self,
        shape: Sequence[int],
        spacing: float | Sequence[float] | None = None,
        *,
        size: float | Sequence[float] | None = None,
        origin: Sequence[float] | None = None,
    ):
        self.shape = require_counts("shape", shape, (2, 3))
        if (spacing is None) == (size is None):
            raise ValueError("give either spacing or size")
        given = self._per_axis(
            "spacing" if size is None else "size", spacing if size is None else size
        )
        cells = self.shape if size is not None else (1,) * self.dim
        self.spacing = tuple(s / n for s, n in zip(given, cells, strict=True))
        zero = (0.0,) * self.dim
        self.origin = zero if origin is None else require_numbers("origin", origin, self.dim)

    def _per_axis(self, name: str, value: float | Sequence[float] | None) -> tuple[float, ...]:
        if isinstance(value, (int, float, complex)) or getattr(value, "ndim", None) == 0:
            return (require_number(name, value, above=0.0),) * self.dim  # type: ignore[arg-type]
        return require_numbers(name, value, self.dim, above=0.0)  # type: ignore[arg-type]

    def __repr__(self) -> str:
        return f"Grid({self.shape}, spacing={self.spacing}, origin={self.origin})"

    @property
    def dim(self) -> int:
        """2 or 3."""
        return len(self.shape)

    @property
    def size(self) -> tuple[float, ...]:
        """Size of the box [m]."""
        return tuple(n * h for n, h in zip(self.shape, self.spacing, strict=True))

    @property
    def node_shape(self) -> tuple[int, ...]:
        """Nodes per axis."""
        return tuple(n + 1 for n in self.shape)

    @property
    def num_nodes(self) -> int:
        return math.prod(self.node_shape)

    @property
    def num_cells(self) -> int:
        return math.prod(self.shape)

    @property
    def cell_volume(self) -> float:
        """Volume of a cell [m^dim]."""
        return math.prod(self.spacing)

    @property
    def nodes(self) -> Tensor:
        """Positions of the nodes, (*node_shape, dim) [m]."""
        return self._positions(self.node_shape, 0.0)

    @property
    def centers(self) -> Tensor:
        """Positions of the cells' centers, (*shape, dim) [m]."""
        return self._positions(self.shape, 0.5)

    def _positions(self, counts: tuple[int, ...], shift: float) -> Tensor:
        axes = [
            o + h * (torch.arange(n, dtype=torch.float64) + shift)
            for n, h, o in zip(counts, self.spacing, self.origin, strict=True)
        ]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)

    @property
    def faces(self) -> tuple[str, ...]:
        """Names of the box's faces: "x-", "x+", "y-", ..."""
        return tuple(axis + side for axis in AXES[: self.dim] for side in "-+")

    @checked
    def face_nodes(self, face: str) -> Tensor:
        """Flat indices of the nodes on a face of the box, int64, ascending."""
        axis, side = self.face_axis(face)
        index = torch.arange(self.num_nodes).reshape(self.node_shape)
        return index.select(axis, 0 if side == 0 else self.shape[axis]).flatten()

    @checked
    def face_axis(self, face: str) -> tuple[int, int]:
        """Axis of a face, and 0 for its low or 1 for its high side."""
        if face not in self.faces:
            raise ValueError(f"face must be one of {list(self.faces)}, got {face!r}")
        return AXES.index(face[0]), "-+".index(face[1])

    @checked
    def nodal_vectors(self, name: str, value: Tensor) -> Tensor:
        """A vector field from one vector (dim,), a field (*node_shape, dim) or one per case.

        Args:
            name: Name of the tensor in messages.
            value: The vector or fields, any unit.

        Returns:
            (cases or 1, num_nodes, dim). Gradient: value.
        """
        field = (*self.node_shape, self.dim)
        if value.ndim == 1:
            value = require(name, value, (self.dim,), torch.float64).expand(1, *field)
        elif value.ndim == self.dim + 1:
            value = require(name, value, field, torch.float64)[None]
        else:
            value = require(name, value, ("cases", *field), torch.float64)
        return value.reshape(-1, self.num_nodes, self.dim)
