"""Shapes of every kind with points around them, and helpers for contact tests."""

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from diffsim import contact, mesh


def tensor(*rows) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def uniform(*shape: int, seed: int = 0, low: float = -1.0, high: float = 1.0) -> Tensor:
    """Uniform numbers that depend on nothing but their arguments."""
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)


def waves(nx: int = 21, ny: int = 17, spacing: float = 0.1) -> Tensor:
    """Heights of 0.1 sin(3 x) cos(2 y) [m] on a grid."""
    x = spacing * torch.arange(nx, dtype=torch.float64)[:, None]
    y = spacing * torch.arange(ny, dtype=torch.float64)
    return 0.1 * torch.sin(3.0 * x) * torch.cos(2.0 * y)


# name: (function of parameters that makes the shape, parameters); all about [-1, 1]^3
SHAPES = {
    "plane": (contact.Plane, (tensor(0.2, -0.3, 2.0), tensor(0.1)[0])),
    "sphere": (contact.Sphere, (tensor(0.7)[0],)),
    "capsule": (contact.Capsule, (tensor(-0.4, 0.1, 0.0), tensor(0.5, 0.2, 0.3), tensor(0.4)[0])),
    "box": (contact.Box, (tensor(0.9, 1.1, 1.3),)),
    "trough": (
        lambda r, a: contact.Trough(r, a, axis=(0.0, 2.0, 0.0), start=(-1.0, 0.0, -1.0)),
        (tensor(0.8)[0], tensor(2.0)[0]),
    ),
    "height field": (
        lambda h: contact.HeightField(h, 0.1, origin=(-1.0, -0.8, 0.0)),
        (waves(),),
    ),
    "mesh": (
        lambda: contact.MeshShape(mesh.to_trimesh(mesh.tet_box((2, 2, 2), (1.0, 1.2, 0.9)))),
        (),
    ),
    "custom": (lambda: contact.Custom(mesh.sdf.torus(0.6, 0.3)), ()),
}


def points(num: int = 12, seed: int = 3) -> Tensor:
    """Generic points, inside and outside, none on a kink."""
    x = uniform(num, 3, seed=seed)
    return x * tensor(0.9, 0.7, 0.9)


def unit(x: Tensor) -> Tensor:
    return x / x.norm(dim=-1, keepdim=True)


def rotated(axis, angle: float) -> Tensor:
    """Rotation matrix by scipy's quaternions: shares no code with the package."""
    turn = Rotation.from_rotvec((angle * unit(tensor(*axis))).numpy())
    return torch.from_numpy(turn.as_matrix())
