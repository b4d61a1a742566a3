"""How far does a squishy rubber duck slide down a slope, by two models of friction?

The duck of thesis fig. 4-6 (``--full``: 16,926 DoF and 27,129 tetrahedra, there 16,776 and 24,875;
by default a coarse one of 1,308 DoF) starts
at rest on four slopes of 10 degrees, with friction coefficients from 0.20 (it must stick:
tan 10 degrees = 0.176) down to 0.12. Two models slide for two seconds side by side:

- complementarity with Coulomb's cone: no penetration, true sticking; step 10 ms;
- the penalty form of Macklin et al. 2020 that the thesis used: explicit springs and friction
  -min(cap, mu fn / |u|) u. Stability limits the cap by mass / step, and below the cap friction is
  viscous: the duck that must stick creeps, the others slide too far; step 5 ms.

A rigid block slides 1/2 g (sin a - mu cos a) t^2.

Expected: with complementarity the duck sticks at 0.20 (2.4 mm of shear) and slides 0.357, 0.731 and
1.107 m at 0.16, 0.14 and 0.12, a block 0.315, 0.702 and 1.088 m: a soft duck is ahead as it shears
while it starts, a ten times stiffer one by a sixth of that. With the penalty form it creeps 0.110 m
at 0.20 and slides 0.471, 0.828 and 1.185 m. Running time: 20 CPU seconds. At full size, the first
two slopes gave 2.9 mm and 0.362 m with complementarity, 0.126 m and 0.479 m with the penalty form.

    python examples/contact/slope.py --out runs/slope.png
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
import math

import torch
from contact_scenes import (
    GREY,
    INK,
    ORANGE,
    RED,
    TEAL,
    THESIS_DUCK,
    YELLOW,
    add_body,
    add_patch,
    center,
    cpu_seconds,
    duck,
    save,
    tidy,
    tilted,
)
from torch import Tensor

from diffsim import contact, mesh, soft
from diffsim.core import show_progress

ANGLE = math.radians(10.0)
DOWN = torch.tensor([math.cos(ANGLE), 0.0, -math.sin(ANGLE)], dtype=torch.float64)
NORMAL = torch.tensor([math.sin(ANGLE), 0.0, math.cos(ANGLE)], dtype=torch.float64)
MODELS = {"complementarity": 0.010, "penalty": 0.005}  # step [s]
COLORS = (GREY, TEAL, ORANGE, RED)


def rigid_distance(friction: float, t: float | Tensor) -> float | Tensor:
    """Sliding distance of a block from rest [m]."""
    return 0.5 * 9.81 * max(math.sin(ANGLE) - friction * math.cos(ANGLE), 0.0) * t**2


def slide(m: mesh.TetMesh, friction: float, model: str, duration: float) -> tuple[Tensor, Tensor]:
    """Distance along the slope at every step, (num_steps + 1,) [m], and the last positions."""
    dt = MODELS[model]
    low = m.x_rest @ NORMAL
    sole = torch.nonzero(low < 1e-6).flatten()  # the nodes that stand on the slope
    surface = mesh.surface_vertices(m)
    nodes = surface[low[surface] < 0.04]
    body = soft.SoftBody(
        m,
        dt=dt,
        element="standard",
        youngs_modulus=2e5,
        poissons_ratio=0.4,
        contact=soft.ContactOptions(contact_nodes=nodes),
        solver=soft.SolverOptions(rtol=1e-5),
    )
    ground = contact.plane(NORMAL, friction=friction)
    per_node = float(body.physics().mass.sum()) / len(sole)
    inputs: dict = {}
    if model == "complementarity":
        inputs["obstacles"] = ground
    else:  # as stiff as an explicit force can be: the duck as a whole must not overshoot

        def force(k: int, s: soft.State) -> Tensor:
            return contact.penalty_force(
                [ground],
                s.x,
                s.v,
                stiffness=0.25 * per_node / dt**2,
                viscous_cap=0.25 * per_node / dt,
                nodes=nodes,
            )

        inputs["external_force"] = force
    steps = round(duration / dt)
    show = show_progress(total=steps, desc=f"{model}, friction {friction:g}", leave=False)

    def place(state: soft.State) -> Tensor:
        show.update()
        return center(body, state.x)

    with torch.no_grad():
        motion = soft.rollout(body, body.rest_state(), steps, keep=place, **inputs)
    show.close()
    return (motion.x - motion.x[0]) @ DOWN, motion.final.x


def main(
    spacing: float = 0.03,
    frictions: tuple[float, ...] = (0.20, 0.16, 0.14, 0.12),
    duration: float = 2.0,
    out: str | None = None,
) -> dict[str, float]:
    """Slide, compare and draw; returns distances [m] by model and friction, and CPU times."""
    torch.set_num_threads(1)
    m = tilted(duck(spacing), ANGLE, (0.0, 0.0, 0.0))
    print(f"duck: {m.num_dofs} DoF, {m.num_elements} tetrahedra; {duration:g} s on 10 degrees")
    numbers: dict[str, float] = {"dofs": m.num_dofs}
    runs: dict[tuple[str, float], tuple[Tensor, Tensor]] = {}
    for mu in frictions:
        numbers[f"rigid {mu:.2f}"] = float(rigid_distance(mu, duration))
        for model in MODELS:
            with cpu_seconds() as seconds:
                runs[model, mu] = slide(m, mu, model, duration)
            numbers[f"{model} {mu:.2f}"] = float(runs[model, mu][0][-1])
            steps = len(runs[model, mu][0]) - 1
            numbers[f"{model} {mu:.2f} ms per step"] = 1e3 * seconds() / steps
    if out:
        draw(m, runs, frictions, duration, out)
    return numbers


def draw(
    m: mesh.TetMesh,
    runs: dict[tuple[str, float], tuple[Tensor, Tensor]],
    frictions: tuple[float, ...],
    duration: float,
    path: str,
) -> None:
    """The four slopes before and after, by both models; distance over time against a block."""
    import matplotlib.pyplot as plt
    import numpy as np

    figure = plt.figure(figsize=(11, 6.6), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(0.95, 1.0))
    reach = max(float(distance[-1]) for distance, _ in runs.values()) + 0.25
    lane = torch.tensor([0.0, 0.26, 0.0], dtype=torch.float64)
    for k, model in enumerate(MODELS):
        axes = upper.add_subplot(1, 2, k + 1, projection="3d", computed_zorder=False)
        for i in range(len(frictions)):
            sides = [(-0.2, -0.45), (-0.2, 0.45), (reach, 0.45), (reach, -0.45)]
            corner = torch.stack([s * DOWN + (i + side) * lane for s, side in sides])
            grey = 0.80 + 0.04 * i  # rougher is darker
            add_patch(axes, corner, (grey, grey, grey))
        for i, mu in reversed(list(enumerate(frictions))):
            add_body(axes, m, m.x_rest + i * lane, YELLOW, alpha=0.25)
            add_body(axes, m, runs[model, mu][1] + i * lane, YELLOW)
            at = (-0.24 * DOWN + i * lane).tolist()
            axes.text(*at, f"{mu:.2f}", ha="right", va="center", fontsize=9, color=INK)
        axes.set(xlim=(-0.2, reach), ylim=(-0.2, 0.98), zlim=(-0.25, 0.2))
        axes.set_box_aspect((reach + 0.2, 1.18, 0.45), zoom=1.7)
        axes.view_init(24, -80)
        axes.set_axis_off()
        axes.set_title(f"{model}: start (faint) and after {duration:g} s", fontsize=10.5)
    for k, (axes, model) in enumerate(zip(lower.subplots(1, 2, sharey=True), MODELS, strict=True)):
        for mu, color in zip(frictions, COLORS, strict=False):
            distance = runs[model, mu][0].numpy()
            t = np.linspace(0.0, duration, len(distance))
            axes.plot(t, distance, color=color, lw=1.8, label=f"friction {mu:.2f}")
            axes.plot(t, rigid_distance(mu, t), color=color, lw=1.0, ls="--")
        axes.set(xlabel="time [s]", xlim=(0.0, duration))
        axes.set_title("soft duck (solid), rigid block (dashed)", fontsize=10)
        tidy(axes)
        if k == 0:
            axes.set_ylabel("sliding distance [m]")
            axes.legend(frameon=False, fontsize=9)
    figure.suptitle("A squishy duck on slopes of 10 degrees, friction coefficient per lane")
    save(figure, path)


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
        parser.add_argument(
            "--small", action="store_true", help="a coarser duck, two slopes, 0.5 s"
        )
        parser.add_argument(
            "--full", action="store_true", help="the thesis's size: about 8 CPU minutes"
        )
        parser.add_argument("--out", metavar="PNG", help="write the picture here")
        args = parser.parse_args()
        if args.small:
            numbers = main(0.05, (0.20, 0.10), 0.5, args.out)
        else:
            numbers = main(THESIS_DUCK if args.full else 0.03, out=args.out)
        for name, value in numbers.items():
            print(f"{name:36s} {value:.4g}")
