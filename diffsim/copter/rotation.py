"""Roll, pitch and yaw of multicopters: R = Rz(yaw) Ry(pitch) Rx(roll), world from body, NED."""

from __future__ import annotations

import torch
from torch import Tensor


def rotation_from_euler(euler: Tensor) -> Tensor:
    """R (..., 3, 3) of roll, pitch and yaw (..., 3) [rad]."""
    (sr, sp, sy), (cr, cp, cy) = euler.sin().unbind(-1), euler.cos().unbind(-1)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def body_rates_from_euler_rates(euler: Tensor) -> Tensor:
    """E (..., 3, 3) of omega = E(euler) euler': body rates from the rates of roll, pitch, yaw."""
    roll, pitch, _ = euler.unbind(-1)
    zero, one = torch.zeros_like(roll), torch.ones_like(roll)
    rows = [
        [one, zero, -pitch.sin()],
        [zero, roll.cos(), pitch.cos() * roll.sin()],
        [zero, -roll.sin(), pitch.cos() * roll.cos()],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def attitude_of_thrust(net: Tensor) -> Tensor:
    """Roll and pitch (..., 2) [rad] that point a net thrust (..., 3), body frame, straight up."""
    up = net / torch.linalg.vector_norm(net, dim=-1, keepdim=True).clamp_min(1e-300)
    x, y, z = up.unbind(-1)
    # -up is the third row of R: (-sin p, cos p sin r, cos p cos r)
    return torch.stack([torch.atan2(-y, -z), torch.atan2(x, torch.hypot(y, z))], -1)


def skew(v: Tensor) -> Tensor:
    """[v] (..., 3, 3) of [v] w = v x w, v (..., 3)."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)
