"""How far does a soft ball roll, and how does that depend on its first spin?

The soft ball of thesis fig. 4-5 (E = 2 MPa, Poisson 0.4, 100 steps of 5 ms; 931 hexahedra and 3,312
DoF that follow the sphere, there 552 and 2,469 in voxels) is set on a floor, spinning with
10 rad/s, twice: rolling on a floor to which touching nodes stick (infinite friction, the thesis's
model), and spinning in place on one with friction 0.3, where it slides until it rolls. A rigid
ball would roll at omega R, and after sliding at 2/7 omega R. The gradient of the final position
in the first angular velocity goes backwards through all contacts and is held against a central
difference, both with the solver's tolerance at 1e-9.

Expected: rolling, 0.96 m and 1.86 m/s (rigid: 1.00 m, 2.00 m/s), derivative 0.0901 m s; sliding
first, 0.225 m and 0.556 m/s (rigid: 0.230 m, 0.571 m/s), derivative 0.0170 m s; each equal to its
central difference in four digits. With steps of 1e-3 rad/s instead of 1e-4 the rolling ball's
difference is 0.0742: a node then touches in one of the two runs only, and the travel jumps. One
simulation takes 3 CPU seconds, its backward pass 1; the whole story 40.

    python examples/contact/rolling_sphere.py --out runs/rolling_sphere.png
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
    TEAL,
    add_body,
    add_patch,
    center,
    cpu_seconds,
    save,
    tidy,
)
from torch import Tensor

from diffsim import contact, mesh, soft
from diffsim.core import show_progress

RADIUS, SPIN, DT = 0.2, 10.0, 0.005  # [m], [rad/s], [s]
FLOORS = {"sticking": math.inf, "friction 0.3": 0.3}
STARTS_ROLLING = {"sticking": True, "friction 0.3": False}


def make_ball(spacing: float, rtol: float) -> soft.SoftBody:
    """A ball at rest that touches the plane z = 0."""
    return soft.SoftBody(
        mesh.hex_sphere(RADIUS, spacing, center=(0.0, 0.0, RADIUS)),
        dt=DT,
        youngs_modulus=2e6,
        poissons_ratio=0.4,
        density=1000.0,
        solver=soft.SolverOptions(rtol=rtol),
    )


def first_state(body: soft.SoftBody, spin: Tensor, rolling: bool) -> soft.State:
    """The ball turning with ``spin`` (3,) [rad/s] about its center or its lowest point."""
    pole = torch.tensor([0.0, 0.0, 0.0 if rolling else RADIUS], dtype=torch.float64)
    x = body.x_rest
    return soft.State(x, torch.linalg.cross(spin.expand_as(x), x - pole))


def roll(
    body: soft.SoftBody, name: str, spin: Tensor, num_steps: int, progress: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Positions at every step, forces on the ball (num_steps, 3) [N], final center [m]."""
    ground = contact.floor(friction=FLOORS[name])
    state = first_state(body, spin, STARTS_ROLLING[name])
    xs, forces = [state.x.detach()], []
    for _ in show_progress(range(num_steps), desc=name, leave=False, disable=not progress):
        state = body(state, obstacles=ground)
        xs.append(state.x.detach())
        forces.append(state.contact_force.detach().sum(0))
    return torch.stack(xs), torch.stack(forces), center(body, state.x)


def main(
    spacing: float = 0.044, num_steps: int = 100, floors: tuple[str, ...] = tuple(FLOORS),
    out: str | None = None,
) -> dict[str, float]:  # fmt: skip
    """Roll, differentiate, check and draw; returns the numbers by floor."""
    torch.set_num_threads(1)
    body, sharp = make_ball(spacing, 1e-6), make_ball(spacing, 1e-9)
    print(f"ball: {body.mesh.num_elements} hexahedra, {body.mesh.num_dofs} DoF, {num_steps} steps")
    spin = torch.tensor([0.0, SPIN, 0.0], dtype=torch.float64, requires_grad=True)
    numbers: dict[str, float] = {"dofs": body.mesh.num_dofs}
    runs: dict[str, tuple[Tensor, Tensor]] = {}
    for name in floors:
        with soft.record_stats() as solves:
            with cpu_seconds() as forward:
                x, force, end = roll(body, name, spin, num_steps, progress=True)
            with cpu_seconds() as backward:
                (grad,) = torch.autograd.grad(end[0], spin)
        steps = [s for s in solves if s.kind == "step"]
        adjoints = [s for s in solves if s.kind == "adjoint"]
        touching = torch.tensor([float(s.num_contacts) for s in steps])
        (exact,) = torch.autograd.grad(roll(sharp, name, spin, num_steps)[2][0], spin)
        speed = (center(body, x[-1]) - center(body, x[-6]))[0] / (5 * DT)
        runs[name] = x, force
        numbers |= {
            f"{name}: forward CPU s": forward(),
            f"{name}: backward CPU s": backward(),
            f"{name}: iterations per step": sum(float(s.num_iters) for s in steps) / num_steps,
            f"{name}: solves per step": sum(float(s.num_solves) for s in steps) / num_steps,
            f"{name}: Krylov iterations per adjoint": sum(float(s.num_iters) for s in adjoints)
            / len(adjoints),
            f"{name}: mean nodes in contact": float(touching.mean()),
            f"{name}: most nodes in contact": float(touching.max()),
            f"{name}: travel [m]": float(end[0].detach()),
            f"{name}: speed at the end [m/s]": float(speed),
            f"{name}: d travel / d spin [m s]": float(grad[1]),
            f"{name}: the same, tolerance 1e-9": float(exact[1]),
            f"{name}: central difference": difference(sharp, name, num_steps, 1e-4),
        }
    if out:
        draw(body, runs, out)
    return numbers


def difference(body: soft.SoftBody, name: str, num_steps: int, eps: float) -> float:
    """Central difference of the travel in the spin, steps of +-eps [rad/s]."""
    travel = []
    for sign in (1.0, -1.0):
        spin = torch.tensor([0.0, SPIN + sign * eps, 0.0], dtype=torch.float64)
        with torch.no_grad():
            travel.append(float(roll(body, name, spin, num_steps)[2][0]))
    return (travel[0] - travel[1]) / (2.0 * eps)


def draw(body: soft.SoftBody, runs: dict[str, tuple[Tensor, Tensor]], path: str) -> None:
    """Frames of both motions; force of the floor on the ball over time, against its weight."""
    import matplotlib.pyplot as plt

    num_steps = len(next(iter(runs.values()))[1])
    figure = plt.figure(figsize=(11, 5.8), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(0.62, 1.0))
    reach = max(float(x[-1, :, 0].max()) for x, _ in runs.values())
    weight = 9.81 * float(body.physics().mass.sum())
    below = lower.subplots(1, len(runs), sharey=True, squeeze=False)[0]
    for k, (name, (x, force)) in enumerate(runs.items()):
        axes = upper.add_subplot(1, len(runs), k + 1, projection="3d", computed_zorder=False)
        edge = torch.tensor([[-0.25, -0.3], [reach, -0.3], [reach, 0.3], [-0.25, 0.3]])
        add_patch(axes, torch.cat([edge, torch.zeros(4, 1)], 1), "#e4e8ee")
        frames = [round(f * num_steps) for f in (0.0, 0.25, 0.5, 0.75, 1.0)]
        for step in frames[:-1]:
            add_body(axes, body.mesh, x[step], TEAL, alpha=0.1, linewidths=0.1)
        add_body(axes, body.mesh, x[-1], TEAL)
        axes.set(xlim=(-0.25, reach), ylim=(-0.3, 0.3), zlim=(0.0, 0.42))
        axes.set_box_aspect((reach + 0.25, 0.6, 0.42), zoom=1.75)
        axes.view_init(12, -80)
        axes.set_axis_off()
        travel = float(center(body, x[-1])[0])
        axes.set_title(f"{name}: {travel:.2f} m in {num_steps * DT:g} s", fontsize=10.5, y=0.97)
        t = DT * torch.arange(1, num_steps + 1)
        below[k].plot(t, force[:, 2], color=TEAL, lw=1.6, label="normal")
        below[k].plot(t, force[:, 0], color=ORANGE, lw=1.6, label="along the floor")
        below[k].axhline(weight, color=INK, lw=1.0, ls="--", label="weight")
        below[k].axhline(0.0, color=GREY, lw=0.8)
        below[k].set(xlabel="time [s]", xlim=(0.0, num_steps * DT))
        tidy(below[k])
    below[0].set_ylabel("force of the floor on the ball [N]")
    below[0].legend(frameon=False, fontsize=9, ncols=3, loc="upper right")
    figure.suptitle(f"A soft ball with {SPIN:g} rad/s: rolling from the start, and sliding first")
    save(figure, path)


if __name__ == "__main__":
    with interruptible():
        parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
        parser.add_argument("--small", action="store_true", help="a coarse ball, 20 steps: 2 s")
        parser.add_argument("--out", metavar="PNG", help="write the picture here")
        args = parser.parse_args()
        size = (0.06, 20) if args.small else (0.044, 100)
        for name, value in main(*size, out=args.out).items():
            print(f"{name:44s} {value:.6g}")
