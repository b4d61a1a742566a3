"""Volumes, sizes and quality of elements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.core.torch_names import on_constants
from diffsim.mesh.congruence import congruence_classes
from diffsim.mesh.core import HexMesh, TetMesh
from diffsim.mesh.reference import HEX_CORNERS, HEX_EDGES, TET_EDGES, TET_FACES, det3, hex_jacobians
from diffsim.mesh.shape import shape_gradients


@checked
def element_volumes(mesh: HexMesh | TetMesh) -> Tensor:
    """Volume of each element, (num_elements,) [m^3]; exact for trilinear and linear geometry."""
    shape = shape_gradients(mesh)
    return shape.weight.sum(dim=1)[shape.class_idx]


@checked
def total_volume(mesh: HexMesh | TetMesh) -> float:
    """Volume of the mesh [m^3]."""
    return float(element_volumes(mesh).sum())


@checked
def element_size(mesh: HexMesh | TetMesh) -> Tensor:
    """Mean edge length of each element, (num_elements,) [m]."""
    return torch.from_numpy(_edge_lengths(mesh).mean(axis=1))


@dataclass(frozen=True)
class Range:
    """Minimum, mean, maximum and histogram of one measure over the elements."""

    minimum: float
    mean: float
    maximum: float
    counts: tuple[int, ...]
    bin_edges: tuple[float, ...]

    @staticmethod
    def of(values: Array, bins: int = 10) -> Range:
        """Summarize values, any shape."""
        low, high = float(values.min()), float(values.max())
        if high - low <= 1e-9 * max(abs(low), abs(high)):  # equal up to rounding: one bin
            counts, edges = np.array([values.size]), np.array([low, high])
        else:
            counts, edges = np.histogram(values, bins)
        return Range(low, float(values.mean()), high, tuple(counts.tolist()), tuple(edges.tolist()))


@checked(kinds_only=True)
@dataclass(frozen=True)
class Quality:
    """Quality of a mesh; ``str()`` prints a table.

    Attributes:
        kind: Kind of the elements, "hex" or "tet".
        num_nodes: Number of nodes.
        num_elements: Number of elements.
        total_volume: Volume of the mesh [m^3].
        volume_ratio: Largest element volume over the smallest [-].
        volume: Element volumes [m^3].
        scaled_jacobian: Least over an element's corners of det J / (product of the three edge
            lengths there) [-]; 1 for a brick. Tetrahedra: times sqrt(2), 1 for the regular one.
        aspect_ratio: Longest over shortest edge of an element [-].
        dihedral_angle: Angles between the faces of an element [deg]; 90 in a brick, 70.5 in the
            regular tetrahedron.
    """

    kind: str
    num_nodes: int
    num_elements: int
    total_volume: float
    volume_ratio: float
    volume: Range
    scaled_jacobian: Range
    aspect_ratio: Range
    dihedral_angle: Range

    def __str__(self) -> str:
        lines = [
            f"{self.num_elements} {self.kind} elements, {self.num_nodes} nodes, volume "
            f"{self.total_volume:.6g} m^3, largest/smallest element {self.volume_ratio:.3g}",
            f"{'':22}{'min':>11}{'mean':>11}{'max':>11}   histogram from min to max",
        ]
        rows = {
            "element volume [m^3]": self.volume,
            "scaled Jacobian [-]": self.scaled_jacobian,
            "aspect ratio [-]": self.aspect_ratio,
            "dihedral angle [deg]": self.dihedral_angle,
        }
        for name, r in rows.items():
            counts = " ".join(str(c) for c in r.counts)
            lines.append(f"{name:22}{r.minimum:11.4g}{r.mean:11.4g}{r.maximum:11.4g}   {counts}")
        return "\n".join(lines)


@checked
@on_constants()
def quality(mesh: HexMesh | TetMesh) -> Quality:
    """Volumes, scaled Jacobians, aspect ratios and dihedral angles of a mesh."""
    volume = element_volumes(mesh).numpy()
    lengths = _edge_lengths(mesh)
    corners = mesh.x_rest.numpy()[mesh.elements.numpy()]
    if isinstance(mesh, HexMesh):
        representative, class_idx = congruence_classes(mesh.x_rest.numpy(), mesh.hexes.numpy())
        scaled, angles = _hex_corner_measures(corners[representative])
        scaled, angles = scaled[class_idx], angles[class_idx]
    else:
        scaled, angles = _tet_scaled_jacobian(corners, lengths), _tet_dihedral_angles(corners)
    return Quality(
        kind=mesh.kind,
        num_nodes=mesh.num_nodes,
        num_elements=mesh.num_elements,
        total_volume=float(volume.sum()),
        volume_ratio=float(volume.max() / volume.min()),
        volume=Range.of(volume),
        scaled_jacobian=Range.of(scaled),
        aspect_ratio=Range.of(lengths.max(axis=1) / lengths.min(axis=1)),
        dihedral_angle=Range.of(np.degrees(angles)),
    )


def _edge_lengths(mesh: HexMesh | TetMesh) -> Array:
    local = HEX_EDGES if mesh.kind == "hex" else TET_EDGES
    ends = mesh.x_rest.numpy()[mesh.elements.numpy()[:, local]]
    return np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2)


def _hex_corner_measures(corners: Array) -> tuple[Array, Array]:
    """Scaled Jacobian (E,) and the 24 dihedral angles at corners (E, 24) [rad]."""
    jacobians = hex_jacobians(corners, HEX_CORNERS.astype(np.float64))
    edges = np.swapaxes(jacobians, 2, 3)  # (E, 8, 3 edges, 3)
    edges = edges / np.linalg.norm(edges, axis=3, keepdims=True)
    scaled = det3(edges).min(axis=1)
    sign = 1.0 - 2.0 * HEX_CORNERS  # edge vectors that leave the corner
    away = edges * sign[None, :, :, None]
    angles = []
    for c in range(3):  # between the faces that share edge c, seen along it
        a, b = away[:, :, (c + 1) % 3], away[:, :, (c + 2) % 3]
        angles.append(_angle_about(away[:, :, c], a, b))
    return scaled, np.concatenate(angles, axis=1)


def _tet_scaled_jacobian(corners: Array, lengths: Array) -> Array:
    """sqrt(2) 6 V / (greatest product of the three edge lengths at a corner), (E,)."""
    at_corner = [[n for n, e in enumerate(TET_EDGES.tolist()) if a in e] for a in range(4)]
    products = np.stack([lengths[:, e].prod(axis=1) for e in at_corner], axis=1)
    return np.sqrt(2.0) * det3(corners[:, 1:] - corners[:, :1]) / products.max(axis=1)


def _tet_dihedral_angles(corners: Array) -> Array:
    """Angles between outward face normals, subtracted from pi, (E, 6) [rad]."""
    p = corners[:, TET_FACES]
    normals = np.cross(p[:, :, 1] - p[:, :, 0], p[:, :, 2] - p[:, :, 0])
    a, b = normals[:, TET_EDGES[:, 0]], normals[:, TET_EDGES[:, 1]]
    sine = np.linalg.norm(np.cross(a, b), axis=2)
    return np.pi - np.arctan2(sine, (a * b).sum(axis=2))


def _angle_about(axis: Array, a: Array, b: Array) -> Array:
    """Angle between a and b projected on the plane normal to the unit vector ``axis`` [rad]."""
    a = a - (a * axis).sum(axis=-1, keepdims=True) * axis
    b = b - (b * axis).sum(axis=-1, keepdims=True) * axis
    sine = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.arctan2(sine, (a * b).sum(axis=-1))
