"""How far does a block slide, and how does that depend on friction?

A stiff block is pushed along the floor. Coulomb's law stops it after v^2 / (2 mu g), so that the
slope over mu is minus the distance over mu. The gradient passes through sticking and slipping.

Expected: 0.2007 m, slope -0.5101 m; the closed form has 0.2039 m and -0.5098 m.

    python examples/contact/sliding_block.py
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import torch

from diffsim import contact, mesh, soft

SPEED, FRICTION, GRAVITY = 1.265, 0.4, 9.81  # [m/s], [-], [m/s^2]


def main(dt: float = 0.005, steps: int = 80) -> dict[str, float]:
    """Distance [m] and its slope over the friction coefficient, beside the closed form."""
    block = mesh.hex_box(cells=(2, 2, 1), size=(0.1, 0.1, 0.05))
    body = soft.SoftBody(block, dt=dt, youngs_modulus=5e6, poissons_ratio=0.3, density=1000.0)
    friction = torch.tensor(FRICTION, dtype=torch.float64, requires_grad=True)
    velocity = torch.tensor([SPEED, 0.0, 0.0], dtype=torch.float64).expand_as(body.x_rest)
    motion = soft.rollout(
        body,
        soft.State(body.x_rest, velocity.contiguous()),
        steps,
        obstacles=[contact.floor(friction=friction)],
    )
    distance = (motion.x[-1] - body.x_rest)[:, 0].mean()
    distance.backward()
    exact = SPEED**2 / (2.0 * FRICTION * GRAVITY)
    return {
        "distance m": distance.item(),
        "closed form m": exact,
        "slope m": friction.grad.item(),
        "closed form slope m": -exact / FRICTION,
    }


if __name__ == "__main__":
    with interruptible():
        for name, value in main().items():
            print(f"{name:20s} {value:.4f}")
