"""Attitudes: quaternions (w, x, y, z), rotation matrices, roll-pitch-yaw, the state of 12.

Rotations take body to world, NED; R = Rz(yaw) Ry(pitch) Rx(roll).
"""

from __future__ import annotations

import torch
from torch import Tensor


def quaternion_from_rpy(rpy: Tensor) -> Tensor:
    """Unit quaternion.

    Args:
        rpy: Roll, pitch, yaw, (..., 3) [rad].

    Returns:
        (w, x, y, z), (..., 4).
    """
    (cr, cp, cy), (sr, sp, sy) = torch.cos(rpy / 2).unbind(-1), torch.sin(rpy / 2).unbind(-1)
    return torch.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        dim=-1,
    )


def rotation_from_quaternion(quaternion: Tensor) -> Tensor:
    """World from body.

    Args:
        quaternion: Unit, (w, x, y, z), (..., 4).

    Returns:
        (..., 3, 3).
    """
    w, x, y, z = quaternion.unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def rpy_from_rotation(rotation: Tensor) -> Tensor:
    """Roll, pitch, yaw; pitch in [-pi/2, pi/2], where its ends leave roll and yaw undefined.

    Args:
        rotation: World from body, (..., 3, 3).

    Returns:
        (..., 3) [rad].
    """
    level = torch.hypot(rotation[..., 2, 1], rotation[..., 2, 2])
    return torch.stack(
        [
            torch.atan2(rotation[..., 2, 1], rotation[..., 2, 2]),
            torch.atan2(-rotation[..., 2, 0], level),
            torch.atan2(rotation[..., 1, 0], rotation[..., 0, 0]),
        ],
        dim=-1,
    )


def body_rates_from_rpy_rates(rpy: Tensor, rpy_rates: Tensor) -> Tensor:
    """Angular velocity in the body frame.

    Args:
        rpy: (..., 3) [rad].
        rpy_rates: (..., 3) [rad/s].

    Returns:
        (..., 3) [rad/s].
    """
    roll, pitch, _ = rpy.unbind(-1)
    d_roll, d_pitch, d_yaw = rpy_rates.unbind(-1)
    lean = torch.cos(pitch) * d_yaw
    return torch.stack(
        [
            d_roll - torch.sin(pitch) * d_yaw,
            torch.cos(roll) * d_pitch + torch.sin(roll) * lean,
            torch.cos(roll) * lean - torch.sin(roll) * d_pitch,
        ],
        dim=-1,
    )


def rpy_rates_from_body_rates(rpy: Tensor, body_rates: Tensor) -> Tensor:
    """Rates of roll, pitch and yaw; infinite at pitch +-pi/2.

    Args:
        rpy: (..., 3) [rad].
        body_rates: (..., 3) [rad/s].

    Returns:
        (..., 3) [rad/s].
    """
    roll, pitch, _ = rpy.unbind(-1)
    p, q, r = body_rates.unbind(-1)
    turn = torch.sin(roll) * q + torch.cos(roll) * r
    return torch.stack(
        [
            p + torch.tan(pitch) * turn,
            torch.cos(roll) * q - torch.sin(roll) * r,
            turn / torch.cos(pitch),
        ],
        dim=-1,
    )
