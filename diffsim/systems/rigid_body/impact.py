"""The impact of one corner of a rigid body on a plane, as one impulse.

With K = 1/m - [r] I^-1 [r] (the corner's change of velocity per impulse, times m here), the impulse
p leaves the corner at the normal velocity -e v_n, and sticks if it may: p lies in the friction cone
|p_t| <= mu p_n. Else it lies on the cone, along the tangential impulse that sticking would take
(Newton's restitution with Coulomb's cone; that projection stands for the slip during the impact).
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.rotation import skew


def impulse(
    velocity: Tensor,
    arm: Tensor,
    inverse_inertia: Tensor,
    restitution: Tensor,
    friction: Tensor,
    rebound: Tensor,
) -> Tensor:
    """Impulse per mass on the corner, (..., 3) [m/s]; the plane's normal is z.

    Args:
        velocity: Velocity of the corner before the impact, (..., 3) [m/s].
        arm: Vector from the center of mass to the corner, (..., 3) [m].
        inverse_inertia: Inverse of the moment of inertia per mass, in the frame of the plane,
            (..., 3, 3) [1/m^2].
        restitution: Restitution coefficient e, (...) [-].
        friction: Friction coefficient mu, (...) [-].
        rebound: Tangential restitution of a sticking corner, (...): 0 stops it.
    """
    eye = torch.eye(3, dtype=arm.dtype)
    cross = skew(arm)
    compliance = eye - cross @ inverse_inertia @ cross
    rebound, restitution = torch.broadcast_tensors(rebound, restitution)
    wanted = -velocity * torch.stack([1.0 + rebound, 1.0 + rebound, 1.0 + restitution], -1)
    stick = torch.linalg.solve(compliance, wanted[..., None])[..., 0]
    tangential = stick[..., :2]
    length = (tangential * tangential).sum(-1).clamp(min=1e-18).sqrt()
    along = tangential / length[..., None]
    cone = torch.cat([friction[..., None] * along, torch.ones_like(along[..., :1])], -1)
    slide = wanted[..., 2] / (compliance[..., 2, :] * cone).sum(-1)
    sticks = length <= friction * stick[..., 2]
    return torch.where(sticks[..., None], stick, slide[..., None] * cone)
