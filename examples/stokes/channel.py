"""What pressure does slow flow through a channel take, and how does it depend on the height?

Two plane walls, embedded in a grid that they cut anywhere. Poiseuille's law: the pressure falls by
12 eta Q L / h^3, so that its slope over the height, at a given flow rate Q, is -3 times it over h.

Expected: 1.006 and 0.997 times the closed form on 48 x 40 cells. Running time: 1 s.

    python examples/stokes/channel.py
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import torch

from diffsim import stokes

LENGTH, HEIGHT, RATE, VISCOSITY = 1.2, 0.63, 0.1, 2.0  # [m], [m], [m^2/s], [Pa s]


def main(cells: int = 40) -> dict[str, float]:
    """Pressure drop [Pa] and its slope over the height, relative to the closed form."""
    grid = stokes.Grid((round(cells * LENGTH), cells), spacing=1.0 / cells)
    flow = stokes.StokesFlow(
        grid, [stokes.Inlet("x-"), stokes.Open("x+")], viscosity=VISCOSITY, wall="no_slip"
    )
    height = torch.tensor(HEIGHT, dtype=torch.float64, requires_grad=True)
    y = grid.nodes[..., 1] - 0.5
    # parabolic inflow: mean velocity Q / h, zero at the walls
    inflow = 6.0 * RATE / height**3 * (height**2 / 4.0 - y[0] ** 2).clamp(min=0.0)
    inlet = torch.stack([inflow, torch.zeros_like(inflow)], dim=-1)
    field = flow(height / 2.0 - y.abs(), inlet=inlet)
    left, right, middle = round(0.3 * cells), round(0.9 * cells), cells // 2
    drop = field.pressure[0, left, middle] - field.pressure[0, right, middle]
    (slope,) = torch.autograd.grad(drop, height)
    exact = 12.0 * VISCOSITY * RATE * (right - left) / cells / HEIGHT**3
    return {
        "pressure drop Pa": drop.item(),
        "over closed form": drop.item() / exact,
        "slope over closed form": slope.item() / (-3.0 * exact / HEIGHT),
    }


if __name__ == "__main__":
    with interruptible():
        for name, value in main().items():
            print(f"{name:20s} {value:.4f}")
