"""What linearly implicit steps cost and lose, beside steps that are solved to a tolerance.

python -m benchmarks.soft_linear                         cantilever (8,019 DoF) and coarse starfish
python -m benchmarks.soft_linear --cells 16 4 4 --quick
python -m benchmarks.soft_linear --starfish --batch 1    the starfish alone, one of it

Methods take turns in one process; printed are medians of CPU time of one thread. The
cantilever's steps are compared with implicit Euler's solved to 1e-10: distance of the end positions
relative to how far the beam moved.
The starfish is the environment StarfishSwim, coarse, a batch of 16 under random commands.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from benchmarks.harness import cores, no_garbage_collection
from benchmarks.soft_scenes import Pass, cantilever, one_pass, twisted
from diffsim import soft
from diffsim.envs import make_task

METHODS = ("auto", "linearly_implicit")
DEGREES = (10.0, 30.0)  # twist at the start; from 90 degrees a coarse beam flies apart
BATCH = 16
LEAST = 60  # environment steps that are timed at once


def beam(cells: Sequence[int], method: str, rtol: float = 1e-4) -> soft.SoftBody:
    """The cantilever whose steps are solved by a method."""
    solver = soft.SolverOptions(method=method, rtol=rtol, on_failure="warn")
    return cantilever("hex", cells, solver=solver)


def end_of(body: soft.SoftBody, num_steps: int, degrees: float) -> Tensor:
    """Positions at the end of the rollout from the twisted beam at rest [m]."""
    start = twisted(body, degrees)
    with torch.no_grad():
        return soft.rollout(body, soft.State(start, torch.zeros_like(start)), num_steps).x[-1]


def error_of(cells: Sequence[int], method: str, degrees: float) -> float:
    """Distance of the end positions of ten steps from solved ones, relative to the motion."""
    body = beam(cells, method)
    solved = end_of(beam(cells, "auto", 1e-10), 10, degrees)
    moved = (solved - twisted(body, degrees)).norm()
    return float((end_of(body, 10, degrees) - solved).norm() / moved)


def cantilever_table(cells: Sequence[int], num_steps: int, repetitions: int) -> None:
    """CPU seconds of a rollout and its gradient, and how far it is off."""
    bodies = {method: beam(cells, method) for method in METHODS}
    for body in bodies.values():
        one_pass(body, 1, degrees=1.0)  # not counted: prepares the system
    found: dict[str, list[Pass]] = {method: [] for method in METHODS}
    for _ in range(repetitions):
        for method, body in bodies.items():
            found[method].append(one_pass(body, num_steps, degrees=DEGREES[-1]))
    coarse = tuple(max(2, n // 2) for n in cells)
    print("| method | forward [CPU s] | backward [CPU s] | iterations | off, 10 deg | 30 deg |")
    print("|---|---:|---:|---|---:|---:|")
    for method, runs in found.items():
        forward = statistics.median(run.forward.cpu for run in runs)
        backward = statistics.median(run.backward.cpu for run in runs)
        counts = runs[0].counts()
        errors = [error_of(coarse, method, degrees) for degrees in DEGREES]
        print(
            f"| {method} | {forward:.2f} | {backward:.2f} | "
            f"{counts['step_iters']:.1f}, adjoint {counts['adjoint_iters']:.1f} | "
            + " | ".join(f"{error:.1%}" for error in errors)
            + " |",
            flush=True,
        )


def swim(
    method: str, num_steps: int, differentiate: bool, batch: int = BATCH
) -> tuple[float, Tensor]:
    """CPU seconds per environment step of a batch, and the rewards (num_steps, batch)."""
    task = make_task("StarfishSwim", robot={"coarse": True, "method": method})
    rng = np.random.default_rng(1)
    shape = (num_steps, batch, task.num_actions)
    actions = torch.from_numpy(rng.uniform(-0.3, 0.3, shape)).requires_grad_(differentiate)
    times = []
    for _ in range(2):  # the first prepares
        state = task.start(batch, np.random.default_rng(0))
        with no_garbage_collection():
            began = time.process_time()
            rewards = []
            for action in actions:
                state, reward = task.step(state, action)
                rewards.append(reward)
            if differentiate:
                torch.stack(rewards).sum().backward()
            times.append(time.process_time() - began)
    return times[-1] / (num_steps * batch), torch.stack(rewards).detach()


def starfish_table(num_steps: int, repetitions: int, batch: int) -> None:
    """Environment steps per CPU second, with and without gradient."""
    num_steps = max(num_steps, LEAST // batch)
    plain: dict[str, list[float]] = {method: [] for method in METHODS}
    graded: dict[str, list[float]] = {method: [] for method in METHODS}
    rewards: dict[str, Tensor] = {}
    for _ in range(repetitions):
        for method in METHODS:
            with torch.no_grad():
                seconds, rewards[method] = swim(method, num_steps, False, batch)
            plain[method].append(seconds)
            graded[method].append(swim(method, num_steps, True, batch)[0])
    print("| method | steps per CPU s | with gradient | reward off by |")
    print("|---|---:|---:|---:|")
    exact = rewards["auto"]
    for method in METHODS:
        off = float((rewards[method] - exact).norm() / exact.norm())
        print(
            f"| {method} | {1.0 / statistics.median(plain[method]):.0f} | "
            f"{1.0 / statistics.median(graded[method]):.0f} | {off:.1%} |"
        )


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, nargs=3, default=(32, 8, 8))
    parser.add_argument("--starfish", action="store_true", help="without the cantilever")
    parser.add_argument("--batch", type=int, default=BATCH, help="of the starfish")
    parser.add_argument("--quick", action="store_true", help="five steps, one repetition")
    args = parser.parse_args()
    torch.set_num_threads(1)
    num_steps, repetitions = (5, 1) if args.quick else (25, 3)
    with cores(1):
        if not args.starfish:
            cantilever_table(args.cells, num_steps, repetitions)
            print()
        starfish_table(5 if args.quick else 10, repetitions, args.batch)


if __name__ == "__main__":
    main()
