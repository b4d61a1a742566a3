"""Pneumatic chambers: pressure on surfaces of a body that enclose a volume."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from diffsim.core.check import (
    require,
    require_entries,
    require_indices,
    require_number,
    require_tensor,
)
from diffsim.core.checked import checked
from diffsim.core.numbers import anywhere, values_of
from diffsim.core.torch_names import on_constants
from diffsim.core.values import amounts
from diffsim.mesh import HexMesh, TetMesh, cavities, surface_quads, surface_triangles
from diffsim.mesh.surface import face_keys


@dataclass(frozen=True, eq=False)
class PressureChamber:
    """A volume V of fluid inside or on a body, driven by one pressure p: energy -p V(x).

    Positive gauge pressure pushes the chamber's walls apart. Faces are oriented as the body's
    boundary is: normals point out of the solid, into the chamber.

    A chamber may be a cavity (a closed surface, see :meth:`from_cavity`) or an open pocket of the
    boundary. A pocket is closed by a *lid* per rim, a weightless cone from the rim's nodes to their
    mean: what presses on the lid is carried by the rim, as by a plug that is glued in. So the force
    is always that of a potential and sums to zero. Not modeled: fluid that flows out of a rim, and
    a pressure that does not enclose a volume (a jet, the atmosphere on one side): for these compute
    nodal forces and pass ``external_force``.

    The energy is unbounded below: a pressure beyond what the material holds inflates a body without
    limit, as it does a balloon, and steps then end in a ``ConvergenceError`` or in huge positions.

    Attributes:
        faces: Node indices, (num_faces, 3) int64, boundary triangles of the mesh. A hexahedron's
            quad is two triangles along either diagonal; the volume of a warped quad depends on it.

    Raises:
        ValueError: faces that repeat a node, are not oriented alike, or whose rim crosses itself.
    """

    faces: Tensor
    lids: tuple[Tensor, ...] = field(init=False, repr=False)
    """Nodes of each rim, in the order in which its lid's triangles run through them."""

    def __post_init__(self) -> None:
        self._own(values_of(require("faces", self.faces, ("num_faces", 3), torch.int64)))

    @on_constants()
    def _own(self, faces: Tensor) -> None:
        """Check the faces, and keep a copy and its lids."""
        if faces.numel() == 0:
            raise ValueError("faces must name at least one triangle, got none")
        if int(faces.min()) < 0:
            raise ValueError(f"faces must hold node indices >= 0, got {int(faces.min())}")
        a, b, c = faces.T
        repeated = torch.nonzero((a == b) | (b == c) | (c == a)).flatten()
        if repeated.numel():
            k = int(repeated[0])
            raise ValueError(f"faces must have three different nodes, got {_name(faces, k)}")
        object.__setattr__(self, "faces", faces.clone())
        object.__setattr__(self, "lids", _lids(faces))

    @classmethod
    @checked
    def from_cavity(cls, mesh: HexMesh | TetMesh, index: int = 0) -> PressureChamber:
        """The chamber that fills an inner void of a mesh.

        Args:
            mesh: The body's mesh.
            index: Which void, 0 the largest (see :func:`diffsim.mesh.cavities`).
        """
        found = cavities(mesh)
        if not 0 <= index < len(found):
            raise ValueError(
                f"index must name one of the mesh's {len(found)} cavities, got {index}; an open "
                "pocket is PressureChamber(faces) with faces of mesh.surface_triangles"
            )
        return cls(found[index])

    @property
    def is_closed(self) -> bool:
        """Whether the faces enclose the chamber without lids."""
        return not self.lids

    @checked(x=("...", 3))
    def volume(self, x: Tensor) -> Tensor:
        """Volume of the chamber, lids included.

        V = -1/6 sum over triangles of x_a . (x_b x x_c)

        Args:
            x: Positions of the body's nodes, (..., num_nodes, 3) [m].

        Returns:
            (...) [m^3]. Gradient: x.
        """
        x = require("x", x, ("...", "num_nodes", 3))
        require_indices("faces", self.faces, x.shape[-2], "nodes")
        # Relative to one node, a constant: the volume does not change and nothing cancels.
        x = x - x[..., self.faces[0, :1], :].detach()
        total = _triple(*(x[..., corner, :] for corner in self.faces.T)).sum(-1)
        for lid in self.lids:
            rim = x[..., lid, :]
            center = rim.mean(-2, keepdim=True).expand_as(rim)
            total = total + _triple(rim, rim.roll(-1, -2), center).sum(-1)
        return -total / 6.0


class ChamberSet:
    """All chambers of a body, as the flat arrays that kernels read."""

    @on_constants()
    def __init__(self, chambers: Sequence[PressureChamber], mesh: HexMesh | TetMesh):
        require_entries("chambers", chambers, PressureChamber)
        for k, chamber in enumerate(chambers):
            require_indices(f"chambers[{k}].faces", chamber.faces, mesh.num_nodes, "nodes")
        self.chambers = tuple(chambers)
        self.num_chambers = len(chambers)
        if chambers:
            _require_boundary(self.chambers, mesh)
        lids = [(k, lid) for k, chamber in enumerate(chambers) for lid in chamber.lids]
        self.num_lids = len(lids)
        self.start = _offsets([chamber.faces.shape[0] for chamber in chambers])
        empty = torch.zeros(0, dtype=torch.int64)
        self.faces = torch.cat([empty.reshape(0, 3), *(chamber.faces for chamber in chambers)])
        self.lid_chamber = torch.tensor([k for k, _ in lids], dtype=torch.int64)
        self.lid_start = _offsets([lid.numel() for _, lid in lids])
        self.lid_nodes = torch.cat([empty, *(lid for _, lid in lids)])

    def volumes(self, x: Tensor) -> Tensor:
        """Volumes of all chambers at positions x (..., num_nodes, 3), (..., num_chambers) [m^3].

        Gradient: x.
        """
        if not self.chambers:
            return x.new_zeros(*x.shape[:-2], 0)
        return torch.stack([chamber.volume(x) for chamber in self.chambers], dim=-1)


@checked
def sealed_pressure(
    volume: Tensor,
    filled_volume: Tensor | float,
    *,
    filled_pressure: Tensor | float = 0.0,
    ambient_pressure: float = 101325.0,
) -> Tensor:
    """Gauge pressure of a fixed amount of gas at constant temperature.

    (p + ambient_pressure) V = (filled_pressure + ambient_pressure) filled_volume

    As ``pressure=lambda k, state: sealed_pressure(body.chambers.volumes(state.x), v0)`` in a
    rollout it is explicit in time: the gas does not stiffen the step it is used in. Steps must
    resolve the oscillation of the walls on the gas, whose stiffness is about (p + ambient) / V.

    Args:
        volume: Present volume V, any shape [m^3], > 0.
        filled_volume: Volume when the chamber was sealed, broadcastable [m^3], > 0.
        filled_pressure: Gauge pressure then, broadcastable [Pa], > -ambient_pressure.
        ambient_pressure: Absolute pressure around the body [Pa].

    Returns:
        Gauge pressure, shape of ``volume`` [Pa]. Gradients: all tensors.
    """
    require_number("ambient_pressure", ambient_pressure, at_least=0.0, hint="unit is Pa")
    require_tensor("volume", volume)
    if not torch.compiler.is_compiling() and anywhere(~(volume > 0.0)):
        worst = float(values_of(volume).min())
        raise ValueError(f"volume must be positive, got {worst:g}; the chamber has turned over")
    filled_volume = amounts("filled_volume", filled_volume, above=0.0, hint="unit is m^3")
    filled_pressure = amounts("filled_pressure", filled_pressure)
    amount = (filled_pressure + ambient_pressure) * filled_volume
    return amount / volume - ambient_pressure


def _triple(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    return (a * torch.linalg.cross(b, c)).sum(-1)


def _offsets(sizes: list[int]) -> Tensor:
    return torch.tensor([0, *sizes], dtype=torch.int64).cumsum(0)


def _name(faces: Tensor, k: int) -> str:
    return f"faces[{k}] = {tuple(faces[k].tolist())}"


def _lids(faces: Tensor) -> tuple[Tensor, ...]:
    """Rims of an oriented surface, each in the direction that closes it."""
    directed = [edge for a, b, c in faces.tolist() for edge in ((a, b), (b, c), (c, a))]
    edges = set(directed)
    if len(edges) != len(directed):
        (a, b), _ = Counter(directed).most_common(1)[0]
        raise ValueError(
            f"faces must be oriented alike and meet in pairs, but two of them run along the edge "
            f"({a}, {b}) in the same direction"
        )
    following: dict[int, int] = {}
    for a, b in directed:
        if (b, a) in edges:
            continue
        if b in following:
            raise ValueError(f"the rim of faces must not cross itself, but it does at vertex {b}")
        following[b] = a
    lids = []
    while following:
        first, node = next(iter(following.items()))
        lid = [first]
        while node != first:
            lid.append(node)
            node = following[node]
        for node in lid:
            del following[node]
        lids.append(torch.tensor(lid, dtype=torch.int64))
    return tuple(lids)


def _require_boundary(chambers: Sequence[PressureChamber], mesh: HexMesh | TetMesh) -> None:
    """Refuse faces that are not on the mesh's boundary, or are turned into the solid."""
    if isinstance(mesh, HexMesh):
        quads = surface_quads(mesh).faces
        triples = quads[:, [0, 1, 2, 0, 2, 3, 0, 1, 3, 1, 2, 3]].reshape(-1, 3).numpy()
    else:
        triples = surface_triangles(mesh).faces.numpy()
    every = np.concatenate([triples, *(chamber.faces.numpy() for chamber in chambers)])
    keys, parity = face_keys(every), _parity(every)
    order = np.argsort(keys[: len(triples)], kind="stable")
    known, known_parity = keys[: len(triples)][order], parity[: len(triples)][order]
    first = len(triples)
    for k, chamber in enumerate(chambers):
        own = slice(first, first := first + chamber.faces.shape[0])
        place = np.minimum(np.searchsorted(known, keys[own]), len(known) - 1)
        for bad, problem in (
            (known[place] != keys[own], "is not a triangle of the mesh's boundary"),
            (
                known_parity[place] != parity[own],
                "is turned into the solid: normals must point out of it, as those of "
                "mesh.surface_triangles do; swap two of its vertices",
            ),
        ):
            if bad.any():
                name = _name(chamber.faces, int(np.flatnonzero(bad)[0]))
                raise ValueError(f"chambers[{k}].{name} {problem}")


def _parity(faces: np.ndarray) -> np.ndarray:
    """1 where sorting the nodes of a face keeps its orientation, else -1."""
    a, b, c = faces.T
    return np.sign(b - a) * np.sign(c - b) * np.sign(c - a)
