"""Mass, center of mass and inertia from closed meshes: polynomials in the vertices."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Moments(NamedTuple):
    """Moments of mass about an origin; one row per part."""

    mass: Tensor  # mass of each part, (num_parts,) [kg]
    first: Tensor  # integral of r, (num_parts, 3) [kg m]
    second: Tensor  # integral of r r', (num_parts, 3, 3) [kg m^2]


def mesh_moments(
    vertices: Tensor, faces: Tensor, part_of_face: Tensor, densities: Tensor
) -> Moments:
    """Moments of uniform solids bounded by closed triangle meshes.

    Every triangle spans a signed tetrahedron with the origin; with D = det[a, b, c],
    int 1 = D / 6, int r = D (a + b + c) / 24 and int r r' = D (s s' + a a' + b b' + c c') / 120,
    s = a + b + c.

    Args:
        vertices: (num_vertices, 3) float64 [m], of all parts.
        faces: (num_faces, 3) int64, oriented outwards.
        part_of_face: (num_faces,) int64.
        densities: Density of each part, (num_parts,) [kg/m^3].

    Returns:
        Moments about the origin of the vertices' frame. Gradients: vertices, densities.
    """
    corners = vertices[faces]  # (F, 3 corners, 3)
    det = (corners[:, 0] * torch.linalg.cross(corners[:, 1], corners[:, 2])).sum(-1)
    total = corners.sum(1)
    outer = total[:, :, None] * total[:, None, :] + torch.einsum("fki,fkj->fij", corners, corners)
    num_parts = densities.shape[0]

    def per_part(values: Tensor) -> Tensor:
        zero = values.new_zeros((num_parts, *values.shape[1:]))
        return zero.index_add(0, part_of_face, values)

    return Moments(
        densities * per_part(det) / 6.0,
        densities[:, None] * per_part(det[:, None] * total) / 24.0,
        densities[:, None, None] * per_part(det[:, None, None] * outer) / 120.0,
    )


def placed_moments(moments: Moments, rotations: Tensor, translations: Tensor) -> Moments:
    """Moments in the design's frame of parts whose vertices are R v + t.

    Args:
        rotations: (num_parts, 3, 3).
        translations: Translation of each part, (num_parts, 3) [m].
    """
    mass = moments.mass
    turned = torch.einsum("pij,pj->pi", rotations, moments.first)
    second = rotations @ moments.second @ rotations.transpose(1, 2)
    mixed = turned[:, :, None] * translations[:, None, :]
    shift = mass[:, None, None] * translations[:, :, None] * translations[:, None, :]
    return Moments(
        mass,
        turned + mass[:, None] * translations,
        second + mixed + mixed.transpose(1, 2) + shift,
    )


def rigid_body(moments: Moments) -> tuple[Tensor, Tensor, Tensor]:
    """Mass () [kg], center of mass (3,) [m], inertia about it (3, 3) [kg m^2] of all parts."""
    mass = moments.mass.sum()
    com = moments.first.sum(0) / mass
    second = moments.second.sum(0) - mass * com[:, None] * com[None, :]
    second = 0.5 * (second + second.T)
    eye = torch.eye(3, dtype=second.dtype)
    return mass, com, torch.trace(second) * eye - second
