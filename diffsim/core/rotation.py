"""Rotations in three dimensions, differentiable by PyTorch, with any leading batch axes.

Four forms: matrices (..., 3, 3), unit quaternions (w, x, y, z) (..., 4), rotation vectors
(axis times angle) (..., 3) [rad], and roll, pitch and yaw (rpy) (..., 3) [rad] with
R = Rz(yaw) Ry(pitch) Rx(roll). All take body vectors to the world.
"""

from __future__ import annotations

import torch
from torch import Tensor

_SERIES = 1e-2
"""Below this angle [rad] the series is used: its first neglected term is below 1e-17."""

# Entry k of the matrix of a quaternion, row by row, is identity_k + factor_k (q_a q_b + sign_k q_c
# q_d): one table in place of forty small operations, for a single quaternion is bound by their
# number. Written (a b, c d) with w, x, y, z for 0 to 3.
_PRODUCTS = (
    ("yy zz", "xy wz", "xz wy"),
    ("xy wz", "xx zz", "yz wx"),
    ("xz wy", "yz wx", "xx yy"),
)
_PAIRS = [pair.split() for row in _PRODUCTS for pair in row]
_LEFT, _RIGHT = (
    torch.tensor(["wxyz".index(pair[term][side]) for term in (0, 1) for pair in _PAIRS])
    for side in (0, 1)
)
_TERMS = torch.tensor(
    [
        [1.0, -1.0, 1.0, 1.0, 1.0, -1.0, -1.0, 1.0, 1.0],  # sign
        [-2.0, 2.0, 2.0, 2.0, -2.0, 2.0, 2.0, 2.0, -2.0],  # factor
        [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],  # identity
    ],
    dtype=torch.float64,
)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross products of vectors (..., 3) whose leading axes broadcast."""
    return torch.linalg.cross(*torch.broadcast_tensors(a, b))


def skew(v: Tensor) -> Tensor:
    """Matrix [v] of the cross product, [v] w = v x w.

    Args:
        v: Vectors, (..., 3) in any unit.

    Returns:
        (..., 3, 3).
    """
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return _matrix(rows)


# Rotation vectors.


def sinc_terms(angle_squared: Tensor) -> tuple[Tensor, Tensor]:
    """sin(a) / a and (1 - cos(a)) / a^2 as smooth functions of a^2.

    Args:
        angle_squared: Square of the rotation angle a, of any shape [rad^2].

    Returns:
        Both, same shape.
    """
    small = angle_squared.detach() < _SERIES**2
    a2 = torch.where(small, 1.0, angle_squared)
    a = a2.sqrt()
    s2 = torch.where(small, angle_squared, 0.0)
    first = torch.where(small, 1.0 - s2 / 6 * (1.0 - s2 / 20 * (1.0 - s2 / 42)), torch.sin(a) / a)
    second = torch.where(
        small,
        0.5 * (1.0 - s2 / 12 * (1.0 - s2 / 30 * (1.0 - s2 / 56))),
        2.0 * torch.sin(0.5 * a) ** 2 / a2,
    )
    return first, second


def rotation_offset(rotation_vector: Tensor, r: Tensor) -> Tensor:
    """Displacement of points by a rotation, (R - I) r, without cancellation for small angles.

    Args:
        rotation_vector: Rotation axis times angle, (3,) [rad].
        r: Points relative to a point on the axis, (..., 3).

    Returns:
        (..., 3), unit of ``r``.
    """
    first, second = sinc_terms(rotation_vector.square().sum())
    w = rotation_vector.expand_as(r)
    once = torch.linalg.cross(w, r)
    return first * once + second * torch.linalg.cross(w, once)


def matrix_from_rotation_vector(rotation_vector: Tensor) -> Tensor:
    """R = I + sin(a)/a K + (1 - cos a)/a^2 K K (Rodrigues), smooth through zero.

    Args:
        rotation_vector: Rotation axis times angle, (..., 3) [rad].

    Returns:
        (..., 3, 3).
    """
    square = rotation_vector.square().sum(-1)
    first, second = (term[..., None, None] for term in sinc_terms(square))
    unit = torch.eye(3, dtype=rotation_vector.dtype)
    # K K = v v' - v'v I: products of small matrices are dear
    twice = rotation_vector[..., :, None] * rotation_vector[..., None, :]
    return unit + first * skew(rotation_vector) + second * (twice - square[..., None, None] * unit)


# Quaternions.


def quaternion_from_rotation_vector(rotation_vector: Tensor) -> Tensor:
    """Unit quaternion of a rotation vector.

    Args:
        rotation_vector: Rotation axis times angle, (..., 3) [rad].

    Returns:
        (w, x, y, z), (..., 4).
    """
    half = 0.5 * rotation_vector.square().sum(-1, keepdim=True).clamp(min=1e-24).sqrt()
    return torch.cat([half.cos(), 0.5 * rotation_vector * torch.sinc(half / torch.pi)], -1)


def quaternion_from_rpy(rpy: Tensor) -> Tensor:
    """Unit quaternion of roll, pitch and yaw.

    Args:
        rpy: Roll, pitch and yaw, (..., 3) [rad].

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


def quaternion_product(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product a b: the rotation b followed by a.

    Args:
        a, b: (w, x, y, z), (..., 4), with batch axes that broadcast.

    Returns:
        (..., 4).
    """
    s, u, t, v = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    u, v = torch.broadcast_tensors(u, v)
    vector = s * v + t * u + torch.linalg.cross(u, v)
    x, y, z = (u * v).split(1, -1)  # a sum along so short an axis is slow
    return torch.cat([s * t - (x + y + z), vector], -1)


def quaternion_conjugate(quaternion: Tensor) -> Tensor:
    """The inverse rotation of a unit quaternion, (..., 4)."""
    return torch.cat([quaternion[..., :1], -quaternion[..., 1:]], -1)


def rotate_by_quaternion(quaternion: Tensor, r: Tensor) -> Tensor:
    """Body vectors in the world.

    Args:
        quaternion: Unit, (w, x, y, z), (..., 4).
        r: (..., 3), with batch axes that broadcast.

    Returns:
        (..., 3), unit of ``r``.
    """
    q, r = torch.broadcast_tensors(quaternion, torch.cat([torch.zeros_like(r[..., :1]), r], -1))
    return quaternion_product(quaternion_product(q, r), quaternion_conjugate(q))[..., 1:]


def matrix_from_quaternion(quaternion: Tensor) -> Tensor:
    """Rotation matrix of a unit quaternion.

    Args:
        quaternion: (w, x, y, z), (..., 4).

    Returns:
        (..., 3, 3).
    """
    # each in a row of its own: batches are long, vectors short
    entries = quaternion.movedim(-1, 0).contiguous()
    product = entries.index_select(0, _LEFT) * entries.index_select(0, _RIGHT)
    by_entry = (9,) + (1,) * (quaternion.dim() - 1)
    sign, factor, identity = _TERMS.to(quaternion.dtype).view(3, *by_entry)
    sums = torch.addcmul(product[:9], product[9:], sign)
    matrix = torch.addcmul(identity, sums, factor)
    return matrix.movedim(0, -1).unflatten(-1, (3, 3)).contiguous()


# Roll, pitch and yaw.


def matrix_from_rpy(rpy: Tensor) -> Tensor:
    """Rotation matrix of roll, pitch and yaw.

    Args:
        rpy: Roll, pitch and yaw, (..., 3) [rad].

    Returns:
        (..., 3, 3).
    """
    (sr, sp, sy), (cr, cp, cy) = rpy.sin().unbind(-1), rpy.cos().unbind(-1)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return _matrix(rows)


def rpy_from_matrix(rotation: Tensor) -> Tensor:
    """Roll, pitch, yaw; pitch in [-pi/2, pi/2], where its ends leave roll and yaw undefined.

    Args:
        rotation: Rotation matrices, (..., 3, 3).

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


def body_rates_matrix(rpy: Tensor) -> Tensor:
    """E of omega = E(rpy) rpy': angular velocity in the body frame of rates of roll, pitch, yaw.

    Args:
        rpy: Roll, pitch and yaw, (..., 3) [rad].

    Returns:
        (..., 3, 3).
    """
    roll, pitch, _ = rpy.unbind(-1)
    zero, one = torch.zeros_like(roll), torch.ones_like(roll)
    rows = [
        [one, zero, -pitch.sin()],
        [zero, roll.cos(), pitch.cos() * roll.sin()],
        [zero, -roll.sin(), pitch.cos() * roll.cos()],
    ]
    return _matrix(rows)


def body_rates_from_rpy_rates(rpy: Tensor, rpy_rates: Tensor) -> Tensor:
    """Angular velocity in the body frame, omega = E(rpy) rpy'.

    Args:
        rpy: Roll, pitch and yaw, (..., 3) [rad].
        rpy_rates: Rates of roll, pitch and yaw, (..., 3) [rad/s].

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
        rpy: Roll, pitch and yaw, (..., 3) [rad].
        body_rates: Angular velocity in the body frame, (..., 3) [rad/s].

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


def roll_pitch_of_thrust(thrust: Tensor) -> Tensor:
    """Roll and pitch at which a thrust points straight up, -z of a north-east-down world.

    Args:
        thrust: Thrust in the body frame, (..., 3) [N].

    Returns:
        (..., 2) [rad].
    """
    up = thrust / torch.linalg.vector_norm(thrust, dim=-1, keepdim=True).clamp_min(1e-300)
    x, y, z = up.unbind(-1)
    # -up is the third row of R: (-sin p, cos p sin r, cos p cos r)
    return torch.stack([torch.atan2(-y, -z), torch.atan2(x, torch.hypot(y, z))], -1)


def _matrix(rows: list[list[Tensor]]) -> Tensor:
    """(..., 3, 3) of nine entries (...)."""
    return torch.stack([torch.stack(row, -1) for row in rows], -2)
