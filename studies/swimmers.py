"""Rows "Starfish" and "Shark" of thesis Table 4.4: seconds of one episode and of its gradient.

A neural controller (the thesis's sizes, untrained) steers 200 steps of 33.3 ms on top of a
sinusoid of 1 Hz, without which an untrained shark hardly moves and costs next to nothing; every
step is solved to the thesis's 1e-3 by our solver and by both Newton baselines. What such
controllers learn is in docs/learning.md. CPU seconds of one thread; every number is written as it
comes, and what is on file is not measured again.

    python -m studies.swimmers --out runs/swimmers
    python -m studies.swimmers --quick
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from labs.machine import machine
from diffsim.applications import SOLVERS, solver_options
from diffsim.control import MLPController
from diffsim.core import interruptible
from diffsim.core.errors import ConvergenceError
from diffsim.core.files import write_json_atomic
from diffsim.envs import make_task
from diffsim.envs.rollout import rollout_task
from diffsim.envs.soft_tasks import SoftTask

TASKS = ("StarfishSwim", "SharkSwim")
RTOL, STEPS = 1e-3, 200
STROKE, FREQUENCY = 0.7, 1.0  # of the sinusoid under the network's commands [-], [Hz]


def episode_cost(task: SoftTask, num_steps: int) -> dict[str, Any]:
    """Forward and backward CPU seconds of one episode."""
    network = MLPController(task.num_observations, task.num_actions, seed=0, output_gain=1.0)

    def controller(seen: Tensor, step: int) -> Tensor:
        swing = STROKE * math.sin(2.0 * math.pi * FREQUENCY * step * task.dt)
        return (network(seen, step) + swing).clamp(-1.0, 1.0)

    start = task.start(1, np.random.default_rng(0))
    begin = time.process_time()
    try:
        reward = rollout_task(task, controller, start, num_steps).rewards.mean()
        middle = time.process_time()
        gradient = torch.autograd.grad(reward, list(network.parameters()))
    except ConvergenceError as err:
        return {"failure": " ".join(str(err).split())}
    return {
        "steps": num_steps,
        "forward_cpu_s": middle - begin,
        "backward_cpu_s": time.process_time() - middle,
        "reward": float(reward.detach()),
        "gradient_norm": float(torch.stack([g.norm() for g in gradient]).norm()),
        "network_parameters": network.num_parameters,
    }


def main() -> None:
    """Measure what is not on file yet, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="coarse bodies, 10 steps")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS)
    parser.add_argument("--solvers", nargs="+", choices=tuple(SOLVERS), default=tuple(SOLVERS))
    parser.add_argument("--steps", type=int, default=STEPS, help="of an episode (200)")
    parser.add_argument("--out", type=Path, default=Path("runs/swimmers"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    steps = 10 if args.quick else args.steps
    path = args.out / ("swimmers_quick.json" if args.quick else "swimmers.json")
    table: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
    table["machine"] = machine()
    for name in args.tasks:
        for solver in args.solvers:
            key = f"{name} {solver} {steps} steps"
            if key not in table:
                task = make_task(name, robot={"coarse": args.quick})
                assert isinstance(task, SoftTask)
                task.robot.body.solver = solver_options(solver, rtol=RTOL)
                episode_cost(task, 1)  # what only the first call of a process costs
                table[key] = {"dofs": task.robot.num_dofs, **episode_cost(task, steps)}
                write_json_atomic(path, table)
            print(key, table[key], flush=True)


if __name__ == "__main__":
    with interruptible():
        main()
