"""What forward mode costs: a rollout with K tangents, in CPU time of rollouts without.

python -m benchmarks.soft_tangents
"""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

from diffsim import mesh, soft
from diffsim.core import interruptible

STEPS, DIRECTIONS = 60, (1, 10, 50, 200)


def bar(cells: tuple[int, int, int]) -> soft.SoftBody:
    """A clamped silicone bar with damping, as the diagnosis of the real one simulates it."""
    box = mesh.hex_box(cells, (0.1, 0.03, 0.03))
    return soft.SoftBody(
        box,
        dt=4e-3,
        youngs_modulus=2.6e5,
        poissons_ratio=0.45,
        density=1070.0,
        integrator="bdf2",
        damping=soft.Damping(rayleigh_beta=2e-3),
        fixed=box.nodes_near_plane("x", 0.0),
        solver=soft.SolverOptions(rtol=1e-8),
    )


def cpu_time(call: Callable[[], object], repeats: int = 3) -> float:
    """Least of some, in seconds; a first call warms up."""
    call()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return min(times)


def main() -> None:
    """Prints a table."""
    torch.set_num_threads(1)
    print("| cells | rollout, ms a step |", *(f"K = {k} |" for k in DIRECTIONS))
    for cells in ((10, 2, 2), (20, 4, 4)):
        body = bar(cells)
        start, physics = body.rest_state(), body.physics()
        with torch.no_grad():
            alone = cpu_time(
                lambda b=body, s=start, p=physics: soft.rollout(b, s, STEPS, physics=p)
            )
        row = []
        for k in DIRECTIONS:
            moving = soft.Directions(v=torch.ones(k, body.mesh.num_nodes, 3).double())
            both = cpu_time(
                lambda b=body, s=start, p=physics, k=k, d=moving: soft.rollout_tangents(
                    b, s, STEPS, k, d, physics=p, keep=lambda s, t: (s.x[-1], t.x[:, -1])
                )
            )
            row.append(f"{both / alone:.1f} |")
        print(f"| {cells} | {1e3 * alone / STEPS:.2f} |", *row)


if __name__ == "__main__":
    with interruptible():
        main()
