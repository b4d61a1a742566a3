"""Time steps in which a body buckles: seconds and iterations by solver.

A starfish of 7,020 degrees of freedom holds random full strokes for eight steps each; its arms snap
through when they change. The slowest of these steps, by the textbook Newton-Cholesky, are solved
again by every solver to the tolerance that learning uses. CPU seconds of one thread.

    python -m studies.buckling
"""

from __future__ import annotations

import argparse
import dataclasses
import time

import numpy as np
import torch

from diffsim import soft
from diffsim.core import interruptible
from diffsim.envs import make_task
from diffsim.envs.soft_tasks import SoftTask
from diffsim.envs.task import TaskState

METHODS = ("newton_pcg", "auto", "quasi_newton", "newton_cholesky")
HELD, CHANGES, SLOWEST = 8, 24, 8  # steps of a stroke, strokes, steps that are solved again


def solve(task: SoftTask, state: TaskState, action: torch.Tensor) -> tuple[TaskState, float, int]:
    """State after a step, its CPU seconds, and its iterations."""
    begin = time.process_time()
    with soft.record_stats() as solves:
        after, _ = task.step(state, action)
    return after, time.process_time() - begin, int(solves[0].num_iters)


def use(task: SoftTask, method: str) -> None:
    """Solve by a method; 5,000 iterations at most."""
    body = task.robot.body
    body.solver = dataclasses.replace(body.solver, method=method, max_iters=5000)


def main() -> None:
    """Collect the steps and print the table."""
    argparse.ArgumentParser(description=__doc__.partition("\n")[0]).parse_args()
    torch.set_num_threads(1)
    task = make_task("StarfishSwim")
    assert isinstance(task, SoftTask)
    use(task, "newton_cholesky")
    rng = np.random.default_rng(0)
    state, found = task.start(1, rng), []
    for _ in range(CHANGES):
        action = torch.from_numpy(np.sign(rng.standard_normal((1, task.num_actions))))
        for _ in range(HELD):
            after, seconds, _ = solve(task, state, action)
            found.append((seconds, state, action))
            state = after
    found = sorted(found, key=lambda f: -f[0])[:SLOWEST]
    print(f"{'solver':16s} {'CPU seconds a step (median, range)':36s} iterations (median)")
    for method in METHODS:
        use(task, method)
        solve(task, task.start(1, rng), torch.zeros_like(found[0][2]))  # prepares the solver
        rows = [solve(task, s, a)[1:] for _, s, a in found]
        seconds, iterations = (np.array(c) for c in zip(*rows, strict=True))
        spread = f"{np.median(seconds):.2f} ({seconds.min():.2f} to {seconds.max():.2f})"
        print(f"{method:16s} {spread:36s} {np.median(iterations):.0f}")


if __name__ == "__main__":
    with interruptible():
        main()
