"""How does a step's cost grow with the share of nodes in contact?

A one-layer sheet of hexahedra falls onto a ball and drapes over it (thesis fig. 4-8, table 4.1).
The larger the ball, the more of the sheet's nodes touch it: from about 6 % to 50 %, which is every
node of the lower side. Contact is a complementarity problem; touching nodes stick (infinite
friction), as in the thesis. Times are CPU seconds of one thread, averaged over the steps in
contact.

Expected: of 25 x 25 cells 5, 24, 41 and 50 % of the nodes touch, at 0.03, 0.04, 0.16 and 0.014
CPU seconds a step; of 50 x 50 cells 5, 19, 41 and 50 %, at 0.14, 0.25, 0.53 and 0.06 s. The
steps get dear where contacts change much (ball of 0.3 m, 14 to 21 iterations) rather than where
they are many. Running time: 55 CPU seconds.

    python examples/contact/napkin.py --out runs/napkin.png
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
import math
import time
from dataclasses import dataclass

import torch
from contact_scenes import BLUE, GREY, ORANGE, RED, TEAL, add_body, add_patch, save, tidy
from torch import Tensor

from diffsim import contact, mesh, soft
from diffsim.core import show_progress

SIDE, THICK, GAP, DT = 0.3, 0.006, 0.002, 0.01  # [m], [m], [m], [s]
RADII = (0.065, 0.165, 0.30, 2.0)  # of the ball [m]
THESIS = {  # table 4.1, PD: wall-clock seconds a step at 6, 24, 38 and 50 %, 8 threads
    25: (0.1, 0.6, 1.2, 1.4),
    50: (1.2, 6.0, 11.3, 10.5),
    75: (7.1, 29.0, 42.8, 48.1),
    100: (32.0, 169.8, 158.7, 163.4),
}


@dataclass(frozen=True)
class Run:
    """One sheet on one ball; the averages are over the steps in contact.

    Attributes:
        share: Nodes in contact over all nodes at the end [-].
        seconds: CPU time of a step [s].
        iterations, solves, factorizations: Of a step.
    """

    cells: int
    radius: float
    dofs: int
    share: float
    seconds: float
    iterations: float
    solves: float
    factorizations: float
    m: mesh.HexMesh
    x: Tensor


def drape(cells: int, radius: float, num_steps: int) -> Run:
    """Let a sheet of ``cells`` x ``cells`` x 1 fall onto a ball whose top is the origin."""
    m = mesh.hex_box((cells, cells, 1), (SIDE, SIDE, THICK), (-SIDE / 2, -SIDE / 2, GAP))
    body = soft.SoftBody(
        m,
        dt=DT,
        element="standard",
        youngs_modulus=2e4,
        poissons_ratio=0.3,
        density=500.0,
        damping=soft.Damping(rayleigh_alpha=5.0),
        contact=soft.ContactOptions(contact_nodes=m.nodes_near_plane("z", GAP)),
        solver=soft.SolverOptions(rtol=1e-4),
    )
    ball = contact.sphere(radius, position=(0.0, 0.0, -radius), friction=math.inf)
    state, rows = body.rest_state(), []
    for _ in show_progress(range(num_steps), desc=f"{cells}^2, ball {radius:g} m", leave=False):
        with torch.no_grad(), soft.record_stats() as solves:
            start = time.process_time()
            state = body(state, obstacles=ball)
            seconds = time.process_time() - start
        s = solves[0]
        counts = (s.num_contacts, s.num_iters, s.num_solves, s.num_factorizations)
        rows.append([seconds, *(float(c) for c in counts)])
    table = torch.tensor([row for row in rows if row[1] > 0])
    mean = table.mean(0).tolist()
    share = float(table[-1, 1]) / m.num_nodes
    return Run(cells, radius, m.num_dofs, share, mean[0], *mean[2:], m, state.x)


def main(
    sizes: tuple[int, ...] = (25, 50),
    num_steps: int = 40,
    out: str | None = None,
) -> dict[str, float]:
    """Drape every size over every ball; returns share and time per step of each."""
    torch.set_num_threads(1)
    runs = [drape(cells, radius, num_steps) for cells in sizes for radius in RADII]
    print("cells    DoF  ball [m]  in contact  CPU s/step  iterations  solves  factorizations")
    for r in runs:
        print(
            f"{r.cells:3d}^2 {r.dofs:7d} {r.radius:8g} {100 * r.share:9.1f} % {r.seconds:11.4f} "
            f"{r.iterations:11.1f} {r.solves:7.1f} {r.factorizations:15.1f}"
        )
    if out:
        draw(runs, out)
    numbers: dict[str, float] = {}
    for r in runs:
        numbers[f"{r.cells} {r.radius:g} share"] = r.share
        numbers[f"{r.cells} {r.radius:g} seconds"] = r.seconds
    return numbers


def draw(runs: list[Run], path: str) -> None:
    """The sheets on their balls, and time per step over the share of nodes in contact."""
    import matplotlib.pyplot as plt

    sizes = sorted({r.cells for r in runs})
    figure = plt.figure(figsize=(11, 7.4), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(1.15, 1.0))
    shown = [r for r in runs if r.cells in (sizes[0], sizes[-1])]
    rows = len(shown) // len(RADII)
    for k, r in enumerate(shown):
        axes = upper.add_subplot(rows, len(RADII), k + 1, projection="3d", computed_zorder=False)
        add_patch(axes, cap(r.radius), BLUE, edgecolors="#7fa8c0", linewidths=0.2)
        thin = {"linewidths": 5.0 / r.cells, "edgecolors": "#7a3a12"}
        add_body(axes, r.m, r.x, "#f0a95c", alpha=0.93, **thin)
        axes.set(xlim=(-0.15, 0.15), ylim=(-0.15, 0.15), zlim=(-0.14, 0.07))
        axes.set_box_aspect((0.3, 0.3, 0.21), zoom=1.45)
        axes.view_init(24, -60)
        axes.set_axis_off()
        title = f"{r.cells} x {r.cells}: {100 * r.share:.0f} % of nodes in contact"
        axes.set_title(title, fontsize=9.5, y=1.0)
    axes = lower.subplots()
    for cells, color in zip(sizes, (TEAL, ORANGE, RED, GREY), strict=False):
        own = sorted((r for r in runs if r.cells == cells), key=lambda r: r.share)
        label = f"{cells} x {cells}, {own[0].dofs:,} DoF"
        share = [100 * r.share for r in own]
        axes.plot(share, [r.seconds for r in own], "o-", color=color, label=label)
        if cells in THESIS:
            axes.plot((6, 24, 38, 50), THESIS[cells], "x:", color=color, lw=1.0)
    axes.plot([], [], "x:", color=GREY, lw=1.0, label="thesis, wall-clock, 8 threads")
    axes.set(xlabel="nodes in contact [%]", ylabel="time per step [s]", yscale="log")
    axes.set_title("diffsim: CPU seconds of one thread, mean over steps in contact", fontsize=10)
    axes.legend(frameon=False, fontsize=9, ncols=1, loc="center left", bbox_to_anchor=(1.0, 0.5))
    tidy(axes)
    figure.suptitle("One-layer sheets fall onto balls: what does a step cost?")
    save(figure, path)


def cap(radius: float) -> Tensor:
    """Quads of the part of the ball that lies near the sheet, (num_quads, 4, 3) [m]."""
    lowest = min(math.pi, 0.16 / radius)
    theta = torch.linspace(0.0, lowest, 17)[:, None]
    phi = torch.linspace(0.0, 2.0 * math.pi, 37)[None]
    p = torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos() + 0 * phi], -1)
    p = radius * (p - torch.tensor([0.0, 0.0, 1.0]))
    return torch.stack([p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]], 2).reshape(-1, 4, 3)


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
        parser.add_argument("--all", action="store_true", help="75 and 100 cells a side, too")
        parser.add_argument("--small", action="store_true", help="10 cells a side, 20 steps")
        parser.add_argument("--out", metavar="PNG", help="write the picture here")
        args = parser.parse_args()
        chosen = (10,) if args.small else (25, 50, 75, 100) if args.all else (25, 50)
        main(chosen, 20 if args.small else 40, args.out)
