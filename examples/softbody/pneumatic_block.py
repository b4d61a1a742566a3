"""How far does a soft block with a closed chamber grow under pressure?

A cavity in a clamped block is found in the mesh, made a chamber, and inflated. The gradient of the
top's height over the pressure passes through the equilibrium, and predicts a small step.

Expected: the top rises 1.13 mm at 20 kPa; predicted over true change 1.0. Running time: 1 s.

    python examples/softbody/pneumatic_block.py
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import torch
from torch import Tensor

from diffsim import mesh, soft


def main(pressure: float = 2e4, step: float = 1.0) -> dict[str, float]:
    """Rise of the top [mm], and predicted over true change of it for a small step [Pa]."""
    hollow = mesh.sdf.difference(mesh.sdf.box((0.05, 0.05, 0.05)), mesh.sdf.box((0.03, 0.03, 0.03)))
    block = mesh.hex_from_sdf(hollow, ([-0.025] * 3, [0.025] * 3), 0.005)
    body = soft.SoftBody(
        block,
        dt=0.01,
        element="standard",
        youngs_modulus=3e5,
        poissons_ratio=0.45,
        density=1070.0,
        gravity=(0.0, 0.0, 0.0),
        fixed=block.nodes_near_plane("z", -0.025),
        chambers=[soft.PressureChamber(faces) for faces in mesh.cavities(block)],
    )
    top = block.nodes_near_plane("z", 0.025)

    def rise(value: Tensor) -> Tensor:
        state = soft.static_equilibrium(body, pressure=value)
        return (state.x - body.x_rest)[top, 2].mean()

    leaf = torch.tensor([pressure], dtype=torch.float64, requires_grad=True)  # one per chamber
    now = rise(leaf)
    (slope,) = torch.autograd.grad(now, leaf)
    true = (rise(leaf.detach() + step) - rise(leaf.detach() - step)).item() / 2.0
    return {"rise mm": 1e3 * now.item(), "predicted over true": slope.item() * step / true}


if __name__ == "__main__":
    with interruptible():
        for name, value in main().items():
            print(f"{name:20s} {value:.4f}")
