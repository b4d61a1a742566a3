"""Large bodies in contact: CPU seconds a step, forward and backward, and peak memory.

From the repository's root:

python -m benchmarks.contact_large                    a rolling sphere of 172,000 DoF, five minutes
python -m benchmarks.contact_large --spacing 0.005    a coarser one
python -m benchmarks.contact_large --landing 76       a drilled ball that lands, 76 cells across
python -m benchmarks.contact_large --resting 38       a block that stands on all nodes of one side

The rolling sphere is the thesis's (benchmarks/contact_scenes.py). With a contrast its half x > 0 is
so many times stiffer. Every row is a process of its own; one thread. The first step is not counted,
for it prepares the body. The contrast is the largest that DiffPhD claims on a GPU (Lai et al.,
arXiv 2605.14526, 2026), whose scenes were not found.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from typing import Any

import torch

from benchmarks.contact_scenes import rolling_sphere, rolling_state
from benchmarks.harness import cores, timed
from benchmarks.processes import memory, reset_peak_memory, run_child
from diffsim import contact, mesh, soft
from diffsim.core import interruptible
from examples.applications.bouncing_ball import ABOVE, FRICTION, SPEED, holed_ball

RTOL = 1e-4
CONTRASTS, FRICTIONS = (1.0, 100.0), (math.inf, 0.3)
YOUNG = 2e6  # of the softer half [Pa]
ROLLING_STEPS = RESTING_STEPS = 6
BLOCK = 0.1  # edge of the block [m]
LANDING_TIME, LANDING_GAP = 0.024, 2e-3  # [s], half of it in contact; of the ball's box [m]
LIMIT = 1800.0  # of a row [s]


def rolling(settings: dict[str, Any]) -> dict[str, Any]:
    """Steps of the rolling sphere."""
    peak = reset_peak_memory()
    body = rolling_sphere(settings["spacing"], settings["contrast"])
    return measure(body, rolling_state(body), settings["friction"], ROLLING_STEPS, peak)


def rubber(shape: mesh.HexMesh, dt: float, contrast: float) -> soft.SoftBody:
    """A body whose half on the side of x > 0, seen from its middle, is so many times stiffer."""
    right = (shape.x_rest - shape.x_rest.mean(0))[shape.elements].mean(1)[:, 0] > 0.0
    return soft.SoftBody(
        shape,
        dt=dt,
        youngs_modulus=torch.where(right, contrast * YOUNG, YOUNG).double(),
        poissons_ratio=0.4,
        density=1000.0,
    )


def started(body: soft.SoftBody, velocity: Sequence[float]) -> tuple[torch.Tensor, torch.Tensor]:
    """The undeformed body in motion, with gradients."""
    v = torch.tensor(velocity, dtype=torch.float64).expand_as(body.x_rest).clone()
    return body.x_rest.clone().requires_grad_(), v.requires_grad_()


def landing(settings: dict[str, Any]) -> dict[str, Any]:
    """Steps of the drilled ball, the last of them in contact."""
    peak = reset_peak_memory()
    ball = holed_ball(settings["cells"])
    lowered = ball.x_rest - torch.tensor([0.0, 0.0, ABOVE - LANDING_GAP])
    body = rubber(type(ball)(lowered, ball.hexes), settings["dt"], settings["contrast"])
    num_steps = round(LANDING_TIME / settings["dt"])
    return measure(body, started(body, SPEED), settings["friction"], num_steps, peak)


def resting(settings: dict[str, Any]) -> dict[str, Any]:
    """Steps of a block on the ground, which settles under its weight."""
    peak = reset_peak_memory()
    block = mesh.hex_box(cells=(settings["cells"],) * 3, size=(BLOCK,) * 3)
    body = rubber(block, settings["dt"], settings["contrast"])
    return measure(body, started(body, (0.0, 0.0, 0.0)), settings["friction"], RESTING_STEPS, peak)


def measure(
    body: soft.SoftBody,
    start: tuple[torch.Tensor, torch.Tensor],
    friction: float,
    num_steps: int,
    resident: int,
) -> dict[str, Any]:
    """CPU seconds of every step but the first, of the adjoint of all, and the peak [byte]."""
    torch.set_num_threads(1)
    body.solver = soft.SolverOptions(rtol=RTOL)
    ground = contact.floor(friction=friction)
    state, seconds = soft.State(*start), []
    with cores(1), soft.record_stats() as solves:
        for _ in range(num_steps):
            state, spent = timed(lambda now=state: body(now, obstacles=ground))
            seconds.append(spent.cpu)
        steps = list(solves)
        loss = state.x.square().sum() + state.v.square().sum()
        _, backward = timed(loss.backward)
    return {
        "num_dof": state.x.numel(),
        "forward_s": seconds[1:],
        "backward_s": backward.cpu / num_steps,
        "num_contacts": [int(s.num_contacts.item()) for s in steps[1:]],
        "num_factorizations": sum(s.num_factorizations.item() for s in steps[1:]),
        "peak_B": memory("VmHWM") - resident,
    }


def row(name: str, found: dict[str, Any]) -> str:
    """A line of the table."""
    if "failed" in found:
        return f"| {name} | {found['failed']} |"
    forward = found["forward_s"]
    touching = [s for s, n in zip(forward, found["num_contacts"], strict=True) if n]
    return (
        f"| {name} | {found['num_dof']:,} | {max(found['num_contacts'])} "
        f"| {sum(touching) / max(len(touching), 1):.2f} "
        f"| {max(forward):.2f} | {found['backward_s']:.2f} | {found['num_factorizations']:.0f} "
        f"| {found['peak_B'] / 2**30:.2f} |"
    )


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--spacing", type=float, default=0.00271, help="of the sphere's cells [m]")
    parser.add_argument("--landing", type=int, help="the drilled ball instead, cells across")
    parser.add_argument("--resting", type=int, help="the block instead, cells along an edge")
    parser.add_argument("--dt", type=float, default=2e-3, help="of landing and resting [s]")
    parser.add_argument("--contrast", type=float, nargs="+", default=CONTRASTS)
    args = parser.parse_args(argv)
    print("| scene | DoF | nodes | a step in contact, CPU s | longest | backward | factors | GiB |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|")
    scene, frictions, size = rolling, FRICTIONS, {"spacing": args.spacing}
    for other, cells in ((landing, args.landing), (resting, args.resting)):
        if cells:
            scene, frictions, size = other, (FRICTION,), {"cells": cells, "dt": args.dt}
    for friction in frictions:
        for contrast in args.contrast:
            settings = {"contrast": contrast, "friction": friction, **size}
            name = f"{scene.__name__}, friction {friction:g}, contrast {contrast:g}"
            print(row(name, run_child(scene, settings, timeout=LIMIT)), flush=True)


if __name__ == "__main__":
    with interruptible():
        sys.exit(main())
