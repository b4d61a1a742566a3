"""A simulator as a layer of somebody's own network, trained with Adam in twenty lines.

`python examples/learning/layer_in_your_module.py`; the cells below (`# %%`)
open as a notebook in most editors.

A bar of silicone is clamped at one end and has a muscle along its upper and its lower side. A
small network hears where the tip should be after a third of a second and answers with one command
for each muscle; nobody tells it the right commands. The loss is the distance of the simulated tip
from the wish, and Adam follows its gradient through every implicit step of the body.

Expected: the mean distance falls from 37 mm to 1 mm for wishes it has never seen.
"""

from __future__ import annotations

import argparse

# %% The body: 10 x 2 x 4 hexahedra, a muscle above and one below
import torch
from torch import Tensor, nn

from diffsim import mesh, soft

STEPS = 20


def make_arm() -> soft.SoftBody:
    """A bar of 20 cm, clamped at x = 0."""
    bar = mesh.hex_box(cells=(10, 2, 4), size=(0.2, 0.04, 0.04))
    height = bar.x_rest[bar.hexes].mean(1)[:, 2]
    layers = (torch.nonzero(height > 0.03)[:, 0], torch.nonzero(height < 0.01)[:, 0])
    return soft.SoftBody(
        bar,
        dt=1.0 / 60.0,
        youngs_modulus=3e5,
        poissons_ratio=0.45,
        density=1070.0,
        damping=soft.Damping(rayleigh_beta=5e-3),
        fixed=bar.nodes_near_plane("x", 0.0),
        muscles=[soft.Muscle(elements=e, direction=(1.0, 0.0, 0.0), stiffness=6e5) for e in layers],
        solver=soft.SolverOptions(rtol=1e-4),
    )


# %% Somebody's own module, with the simulator inside
class ReachingArm(nn.Module):
    """Wish for the tip's height (batch, 1) [m] -> height that the simulated arm reaches."""

    def __init__(self, body: soft.SoftBody):
        super().__init__()
        self.body = body
        self.tip = body.mesh.nodes_near_plane("x", 0.2)
        self.brain = nn.Sequential(
            nn.Linear(1, 32, dtype=torch.float64),
            nn.Tanh(),
            nn.Linear(32, 2, dtype=torch.float64),
            nn.Tanh(),
        )

    def forward(self, wish: Tensor) -> Tensor:
        activation = 1.0 + 0.2 * self.brain(wish / 0.03)
        batch = self.body.x_rest.expand(len(wish), -1, -1)
        start = soft.State(batch, torch.zeros_like(batch))
        motion = soft.rollout(self.body, start, STEPS, activation=activation)
        return motion.final.x[:, self.tip, 2].mean(1, keepdim=True) - 0.02


# %% Training: nothing but torch
def main(iterations: int = 60, batch: int = 4, seed: int = 0) -> dict[str, float]:
    """Train; returns mean distances [m] on wishes that were not trained on, before and after."""
    torch.manual_seed(seed)
    arm = ReachingArm(make_arm())
    unseen = torch.linspace(-0.035, 0.015, 6, dtype=torch.float64)[:, None]

    def distance(wish: Tensor) -> Tensor:
        return (arm(wish) - wish).abs().mean()

    with torch.no_grad():
        before = distance(unseen).item()
    optimizer = torch.optim.Adam(arm.parameters(), lr=1e-2)
    for k in range(iterations):
        wish = -0.04 + 0.06 * torch.rand(batch, 1, dtype=torch.float64)
        loss = (arm(wish) - wish).square().mean() / 0.01**2
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if k % 20 == 0:
            print(f"iteration {k:3d}: loss {loss.item():.4f}")
    with torch.no_grad():
        after = distance(unseen).item()
    return {"before_m": before, "after_m": after}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--iterations", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    for name, value in main(args.iterations, seed=args.seed).items():
        print(f"{name}: {1e3 * value:.2f} mm")
