"""How slippery must a slide be so that a rubber duck flies off it onto a target?

The duck of thesis fig. 4-7 starts at rest, high on a curved slide made of three pieces, each with a
friction coefficient of its own. Gauss-Newton (scipy's ``least_squares``) moves the three
coefficients, through the derivatives of one second of motion, until the duck's center is at the
target when the second is over.

Contact is the penalty form of Macklin et al. 2020, as in the thesis: the duck slides all the way,
where this form is good (it creeps instead of sticking, which does not matter here), and a
simulation costs about a third of one with complementarity (``--complementarity`` to compare).

Expected: the duck ends 1.8 cm from the target instead of 42 cm, after 12 simulations (52 CPU
seconds at 1,728 DoF). There it stalls: between nearby coefficients the error jitters by half a
centimeter (why, is not known yet). At full size (``--full``) a simulation takes about 31 and each
of its two gradients 16 CPU seconds (from 20 steps of 200).

    python examples/contact/duck_slide.py --out runs/duck_slide.png
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
import math
from collections.abc import Sequence

import torch
from contact_scenes import (
    INK,
    RED,
    THESIS_DUCK,
    YELLOW,
    add_body,
    add_patch,
    center,
    cpu_seconds,
    duck,
    save,
    tilted,
)
from scipy.optimize import least_squares
from torch import Tensor

from diffsim import contact, mesh, soft
from diffsim.core import show_progress

RADIUS = 0.8  # of the slide [m]
HIGH, LIP = math.radians(60.0), math.radians(20.0)  # ends of its arc, before and after the bottom
PIECES, DT, DURATION = 3, 0.005, 1.0
START = (0.14, 0.14, 0.14)  # first guess of the coefficients
TARGET = (0.81, 0.0, -1.11)  # of the duck's center after DURATION; the slide's axis is y [m]
PIECE_COLORS = ("#b8c7d1", "#a3b5c1", "#8ea3b1")


def make_slide(friction: Sequence[float] | Tensor) -> list[contact.Obstacle]:
    """Consecutive arcs of a circle about the y axis, the highest first."""
    arc = (HIGH + LIP) / PIECES
    pieces = []
    for k in range(PIECES):
        at = k * arc - HIGH  # angle from straight down, towards +x
        start = (math.sin(at), 0.0, -math.cos(at))
        shape = contact.Trough(RADIUS, arc, axis=(0.0, -1.0, 0.0), start=start)
        pieces.append(contact.Obstacle(shape, friction=friction[k]))
    return pieces


def place_duck(spacing: float) -> mesh.TetMesh:
    """The duck near the slide's upper end, tail and front of its sole on the slide."""
    angle = HIGH - 0.2
    foot = (-RADIUS * math.sin(angle), 0.0, -RADIUS * math.cos(angle))
    m = tilted(duck(spacing), angle, foot)
    depth = min(float(p.distance_normal(m.x_rest)[0].min()) for p in make_slide(START))
    up = torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)
    for _ in range(3):  # the slide is curved: lift, and lift the rest
        m = mesh.TetMesh(m.x_rest - depth * up, m.tets)
        depth = min(float(p.distance_normal(m.x_rest)[0].min()) for p in make_slide(START))
    return m


def make_duck(spacing: float) -> soft.SoftBody:
    """A duck of 0.5 MPa."""
    return soft.SoftBody(
        place_duck(spacing),
        dt=DT,
        youngs_modulus=5e5,
        poissons_ratio=0.4,
        solver=soft.SolverOptions(rtol=1e-6),
    )


def fly(
    body: soft.SoftBody, friction: Tensor, complementarity: bool = False, duration: float = DURATION
) -> Tensor:
    """Positions at every step, (num_steps + 1, num_nodes, 3) [m]."""
    pieces, steps = make_slide(friction), round(duration / DT)
    if complementarity:
        return soft.rollout(body, body.rest_state(), steps, obstacles=pieces).x
    # The duck as a whole must not overshoot in a step, with a tenth of its skin on the slide.
    share = 0.1 * len(body.contact_nodes)
    per_node = float(body.physics().mass.sum()) / share

    def force(k: int, s: soft.State) -> Tensor:
        return contact.penalty_force(
            pieces,
            s.x,
            s.v,
            stiffness=0.25 * per_node / DT**2,
            viscous_cap=0.5 * per_node / DT,
            nodes=body.contact_nodes,
        )

    return soft.rollout(body, body.rest_state(), steps, external_force=force).x


def main(
    spacing: float = 0.026,
    max_simulations: int = 12,
    complementarity: bool = False,
    out: str | None = None,
) -> dict[str, float]:
    """Optimize the three coefficients and draw; returns the numbers of the story."""
    torch.set_num_threads(1)
    body = make_duck(spacing)
    print(f"duck: {body.mesh.num_dofs} DoF, {body.mesh.num_elements} tetrahedra")
    target = torch.tensor(TARGET, dtype=torch.float64)
    seen: list[tuple[float, list[float], Tensor]] = []
    slopes: dict[tuple[float, ...], list] = {}
    show = show_progress(desc="simulations with gradient", leave=False)

    def miss(values: Sequence[float]) -> list[float]:
        """How far beyond and above the target the center ends, and the derivatives, kept aside."""
        friction = torch.tensor(values, dtype=torch.float64, requires_grad=True)
        x = fly(body, friction, complementarity)
        error = (center(body, x[-1]) - target)[[0, 2]]
        rows = [torch.autograd.grad(e, friction, retain_graph=True)[0] for e in error]
        seen.append((float(error.detach().norm()), friction.tolist(), x.detach()))
        slopes[tuple(values)] = torch.stack(rows).tolist()
        show.update()
        show.set_postfix(error_mm=1e3 * seen[-1][0])
        return error.tolist()

    with cpu_seconds() as seconds:
        least_squares(
            miss,
            START,
            jac=lambda values: slopes[tuple(values)],
            bounds=(0.0, 0.6),
            x_scale=0.05,
            ftol=1e-4,
            max_nfev=max_simulations,
        )
    show.close()
    before, after = seen[0], min(seen, key=lambda run: run[0])
    if out:
        draw(body.mesh, {"before": before, "after": after}, out)
    return {
        "dofs": body.mesh.num_dofs,
        "error_before_m": before[0],
        "error_after_m": after[0],
        **{f"friction_{k}": mu for k, mu in enumerate(after[1])},
        "simulations": len(seen),
        "cpu_s_per_simulation_with_gradient": seconds() / len(seen),
        "cpu_s": seconds(),
    }


def draw(m: mesh.TetMesh, runs: dict[str, tuple[float, list[float], Tensor]], path: str) -> None:
    """The duck at 0, 0.25, 0.5, 0.75 and 1 s, before and after, with the target."""
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(11, 4.6), layout="constrained")
    for k, (name, (error, friction, x)) in enumerate(runs.items()):
        axes = figure.add_subplot(1, 2, k + 1, projection="3d", computed_zorder=False)
        arc = torch.linspace(-HIGH, LIP, 3 * 12 + 1)
        rim = RADIUS * torch.stack([arc.sin(), torch.zeros_like(arc), -arc.cos()], 1)
        wide = torch.tensor([0.0, 0.16, 0.0])
        strips = torch.stack([rim[:-1] - wide, rim[1:] - wide, rim[1:] + wide, rim[:-1] + wide], 1)
        for piece in range(PIECES):
            own = strips[12 * piece : 12 * piece + 12]
            add_patch(axes, own, PIECE_COLORS[piece], linewidths=0.0)
            place = own[6].mean(0) * 1.13
            label = f"{friction[piece]:.3f}"
            axes.text(*place.tolist(), label, ha="center", va="top", fontsize=9, color=INK)
        around = torch.linspace(0.0, 2.0 * math.pi, 49)
        circle = 0.12 * torch.stack([around.cos(), around.sin(), torch.zeros_like(around)], 1)
        disc = torch.tensor(TARGET) + circle
        add_patch(axes, disc, "#ffffff", edgecolors=RED, linewidths=1.6)
        frames = [round(f * (len(x) - 1)) for f in (0.0, 0.25, 0.5, 0.75, 1.0)]
        for i, step in enumerate(frames):
            add_body(axes, m, x[step], YELLOW, alpha=1.0 if i == 4 else 0.3 + 0.1 * i)
        path_of_center = x.mean(1)
        axes.plot(*path_of_center.T.numpy(), color=INK, lw=0.8, ls=":")
        axes.set(xlim=(-0.8, 1.05), ylim=(-0.3, 0.3), zlim=(-1.3, -0.3))
        axes.set_box_aspect((1.85, 0.6, 1.0), zoom=1.45)
        axes.view_init(16, -76)
        axes.set_axis_off()
        axes.set_title(f"{name}: {100 * error:.2g} cm from the target", y=1.0, fontsize=10.5)
    figure.suptitle(
        "A rubber duck on a slide of three frictions (numbers), at 0, 0.25, 0.5, 0.75 and 1 s; "
        "target in red"
    )
    save(figure, path)


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
        parser.add_argument("--small", action="store_true", help="a coarse duck, two simulations")
        parser.add_argument("--full", action="store_true", help="the thesis's size, 16,926 DoF")
        parser.add_argument(
            "--complementarity", action="store_true", help="instead of penalty contact"
        )
        parser.add_argument("--simulations", type=int, default=12)
        parser.add_argument("--out", metavar="PNG", help="write the picture here")
        args = parser.parse_args()
        size = 0.04 if args.small else THESIS_DUCK if args.full else 0.026
        rounds = 2 if args.small else args.simulations
        for name, value in main(size, rounds, args.complementarity, args.out).items():
            print(f"{name:36s} {value:.4g}")
