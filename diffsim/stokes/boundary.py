"""Conditions on the faces of the box: inlets, walls, open faces."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from diffsim.core.check import require, require_choice
from diffsim.core.checked import checked
from diffsim.core.torch_names import on_constants
from diffsim.stokes.grid import Grid

WALLS = ("no_slip", "slip")
WALL_KINDS = ("no_slip", "no_separation")
"""Of the embedded wall."""


@checked
@dataclass(frozen=True)
class Wall:
    """A face at rest.

    Args:
        face: Name of the face: "x-", "x+", "y-", ...
        kind: Kind of wall: "no_slip" (no velocity) or "slip" (no normal velocity, no shear:
            symmetry).
    """

    face: str
    kind: str = "no_slip"

    def __post_init__(self) -> None:
        require_choice("kind", self.kind, WALLS)


@checked
@dataclass(frozen=True)
class Open:
    """A face that fluid leaves or enters freely: the stress on it is zero, or the given traction.

    Args:
        face: Name of the face: "x-", "x+", "y-", ...
    """

    face: str


@checked
@dataclass(frozen=True, eq=False)
class Inlet:
    """Nodes of a face with prescribed velocity (inwards, outwards or along the face).

    Where an inlet meets a wall or another face, the inlet's values hold.

    Args:
        face: Name of the face: "x-", "x+", "y-", ...
        name: Key of its velocities in ``StokesFlow.forward``; default the face's name.
        where: Nodes of the face that belong to it: a function of positions (n, dim) [m] that
            returns (n,) bool; default all. The rest of the face is a no-slip wall unless another
            condition says so.
    """

    face: str
    name: str = ""
    where: Callable[[Tensor], Tensor] | None = field(default=None)

    @property
    def key(self) -> str:
        return self.name or self.face


class Boundary:
    """Conditions of all faces of a grid's box; faces that are not mentioned are no-slip walls.

    Args:
        grid: The grid.
        conditions: ``Inlet``, ``Open`` and ``Wall`` objects, at most one of the last two per face.

    Attributes:
        fixed: Prescribed components, (num_nodes, dim) bool.
        inlets: Nodes of every inlet by name, int64.
        open_faces: Names of the open faces.
    """

    @checked
    @on_constants()
    def __init__(self, grid: Grid, conditions: Iterable[Inlet | Open | Wall] = ()):
        self.grid = grid
        self.fixed = torch.zeros(grid.num_nodes, grid.dim, dtype=torch.bool)
        self.inlets: dict[str, Tensor] = {}
        kinds: dict[str, str] = {}
        inlets: list[Inlet] = []
        for condition in conditions:
            if not isinstance(condition, (Inlet, Open, Wall)):
                raise TypeError(
                    f"boundary must hold Inlet, Open or Wall, got {type(condition).__name__}"
                )
            grid.face_axis(condition.face)  # refuses unknown faces
            if isinstance(condition, Inlet):
                inlets.append(condition)
                continue
            if condition.face in kinds:
                raise ValueError(
                    f"face {condition.face!r} has more than one wall or open condition"
                )
            kinds[condition.face] = condition.kind if isinstance(condition, Wall) else "open"
        whole = {inlet.face for inlet in inlets if inlet.where is None}
        for face in grid.faces:
            kind = kinds.get(face, "inlet" if face in whole else "no_slip")
            axis, _ = grid.face_axis(face)
            if kind == "no_slip":
                self.fixed[grid.face_nodes(face)] = True
            elif kind == "slip":
                self.fixed[grid.face_nodes(face), axis] = True
        for inlet in inlets:
            self._add_inlet(inlet)
        self.open_faces = tuple(face for face in grid.faces if kinds.get(face) == "open")

    def _add_inlet(self, inlet: Inlet) -> None:
        nodes = self.grid.face_nodes(inlet.face)
        if inlet.where is not None:
            inside = inlet.where(self.grid.nodes.reshape(-1, self.grid.dim)[nodes])
            if inside.shape != nodes.shape or inside.dtype != torch.bool:
                raise ValueError(
                    f"where of inlet {inlet.key!r} must return ({len(nodes)},) bool, "
                    f"got {tuple(inside.shape)} {inside.dtype}"
                )
            nodes = nodes[inside]
        if not len(nodes):
            raise ValueError(f"inlet {inlet.key!r} has no nodes; check where, or refine the grid")
        if inlet.key in self.inlets:
            raise ValueError(f"two inlets are called {inlet.key!r}; give each its own name")
        self.inlets[inlet.key] = nodes
        self.fixed[nodes] = True

    @checked
    def inlet_velocities(self, inlet: Tensor | Mapping[str, Tensor] | None) -> dict[str, Tensor]:
        """Velocities of all inlets, checked.

        Args:
            inlet: Velocities by inlet, or one tensor where there is one inlet: (dim,),
                (nodes, dim) or (cases, 1 or nodes, dim) [m/s].

        Returns:
            By inlet, (cases or 1, 1 or nodes, dim) [m/s]. Gradients: inlet.
        """
        names = list(self.inlets)
        if isinstance(inlet, Tensor):
            if len(names) != 1:
                raise ValueError(f"inlet must be a dict with the keys {names}, got one tensor")
            inlet = {names[0]: inlet}
        inlet = inlet or {}
        if set(inlet) != set(names):
            raise ValueError(f"inlet must have the keys {names}, got {list(inlet)}")
        values, dim = {}, self.grid.dim
        for name, value in inlet.items():
            count = len(self.inlets[name])
            value = require(f"inlet {name!r}", value, ("...", dim), torch.float64)
            shaped = value.reshape((1,) * max(0, 3 - value.ndim) + value.shape)
            if shaped.ndim != 3 or shaped.shape[1] not in (1, count):
                raise ValueError(
                    f"inlet {name!r} must have shape ({dim},), ({count}, {dim}) or "
                    f"(cases, 1 or {count}, {dim}), got {tuple(value.shape)}"
                )
            values[name] = shaped
        return values


MAX_NET_INFLOW = 0.05  # of the gross flux; cut faces close only to second order in the cell size


def refuse_net_inflow(share: float) -> None:
    """Raise if more flows into a closed part of the fluid than out; share of the gross flux."""
    if share > MAX_NET_INFLOW:
        raise ValueError(
            f"a part of the fluid has no open face, but {100 * share:.0f} % more flows in than "
            "out (or out than in) through its boundary; open a face, or balance the inlets"
        )
