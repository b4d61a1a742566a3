"""How far does a clamped bar sag, and what does that say about its stiffness?

A bar of silicone under its own weight. The sag is in inverse proportion to Young's modulus, so
d(sag)/dE times E / sag is -1 for small sags; the gradient goes through the static equilibrium.

Expected: sag 6.32 mm, relative slope -0.995: the bar is nearly linear. Running time: 1 s.

    python examples/softbody/cantilever.py
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import torch

from diffsim import mesh, soft


def main(cells: tuple[int, int, int] = (20, 4, 4), modulus: float = 2.6e5) -> dict[str, float]:
    """Sag of the tip [mm], and its slope over the modulus, relative."""
    bar = mesh.hex_box(cells=cells, size=(0.1, 0.03, 0.03))
    body = soft.SoftBody(
        bar,
        dt=0.01,
        element="standard",
        youngs_modulus=modulus,
        poissons_ratio=0.45,
        density=1070.0,
        fixed=bar.nodes_near_plane("x", 0.0),
    )
    stiffness = torch.tensor(modulus, dtype=torch.float64, requires_grad=True)  # [Pa]
    state = soft.static_equilibrium(body, physics=body.physics(youngs_modulus=stiffness))
    tip = bar.nodes_near_plane("x", 0.1)
    sag = (body.x_rest - state.x)[tip, 2].mean()
    sag.backward()
    return {
        "sag mm": 1e3 * sag.item(),
        "relative slope": stiffness.grad.item() * modulus / sag.item(),
    }


if __name__ == "__main__":
    with interruptible():
        for name, value in main().items():
            print(f"{name:20s} {value:.4f}")
