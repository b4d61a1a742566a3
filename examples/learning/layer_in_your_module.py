"""A simulator as a layer of somebody's own network, trained with Adam in twenty lines.

A network answers a wanted height of a soft arm's tip with commands for its two muscles; nobody
tells it the right ones. Adam follows the gradient through every implicit step.
Expected: the mean distance falls from 37 mm to 1 mm for wishes it has never seen.
"""

from __future__ import annotations

from diffsim.core.script import interruptible

# %% The body: 10 x 2 x 4 hexahedra, a muscle above and one below
import torch
from torch import Tensor, nn

from diffsim import mesh, soft

STEPS, F64 = 20, torch.float64


def make_arm() -> soft.SoftBody:
    """A bar of 20 cm, clamped at x = 0."""
    bar = mesh.hex_box(cells=(10, 2, 4), size=(0.2, 0.04, 0.04))
    height = bar.x_rest[bar.hexes].mean(1)[:, 2]
    layers = (torch.nonzero(height > 0.03)[:, 0], torch.nonzero(height < 0.01)[:, 0])
    return soft.SoftBody(
        bar,
        dt=1.0 / 60.0,
        element="standard",
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
        first, last = nn.Linear(1, 32, dtype=F64), nn.Linear(32, 2, dtype=F64)
        self.brain = nn.Sequential(first, nn.Tanh(), last, nn.Tanh())

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
    unseen = torch.linspace(-0.035, 0.015, 6, dtype=F64)[:, None]

    @torch.no_grad()
    def distance() -> float:
        return (arm(unseen) - unseen).abs().mean().item()

    before = distance()
    optimizer = torch.optim.Adam(arm.parameters(), lr=1e-2)
    for _ in range(iterations):
        wish = -0.04 + 0.06 * torch.rand(batch, 1, dtype=F64)
        loss = (arm(wish) - wish).square().mean() / 0.01**2
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return {"before_m": before, "after_m": distance()}


if __name__ == "__main__":
    with interruptible():
        for name, value in main().items():
            print(f"{name}: {1e3 * value:.2f} mm")
