"""A rigid body that turns freely: about a fixed axis where its moments are equal, else by Euler."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.rotation import quaternion_from_rotation_vector, quaternion_product

STEPS = 24  # over a whole flight: about a tenth of a turn each, an error of 1e-6 rad at 10 rad/s


def turned(rates: Tensor, span: Tensor, inertia: Tensor | None) -> tuple[Tensor, Tensor]:
    """Turn during ``span`` without a torque, as a quaternion, and the body rates at its end.

    Euler's equations I w' = I w x w by Runge and Kutta; the turn by Magnus' series of fourth order
    (Iserles and Norsett, 1999) for body rates.

    Args:
        rates: Body rates at first, (..., 3) [rad/s].
        span: Time, (...) [s].
        inertia: Moments of inertia about the body's axes, up to a common factor, (..., 3); None:
            all equal, in closed form.

    Returns:
        (..., 4) and (..., 3).
    """
    if inertia is None:
        return quaternion_from_rotation_vector(rates * span[..., None]), rates

    def slope(w: Tensor) -> Tensor:
        return torch.linalg.cross(inertia * w, w) / inertia

    h = span[..., None] / STEPS
    now = torch.broadcast_tensors(rates, h)[0]
    q = torch.cat([torch.ones_like(now[..., :1]), torch.zeros_like(now)], -1)
    for _ in range(STEPS):
        first = slope(now)
        second = slope(now + 0.5 * h * first)
        third = slope(now + 0.5 * h * second)
        fourth = slope(now + h * third)
        then = now + h / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
        middle = 0.5 * (now + then) + h / 8.0 * (first - slope(then))
        mean = h / 6.0 * (now + 4.0 * middle + then)
        step = mean + h**2 / 12.0 * torch.linalg.cross(now, then)
        q = quaternion_product(q, quaternion_from_rotation_vector(step))
        now = then
    return q, now
