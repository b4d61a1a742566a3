"""L-BFGS for controllers with few parameters, from some starts."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import nn

from diffsim.core.errors import DiffsimError
from diffsim.core.files import write_json_atomic
from diffsim.learn.open_loop import KINDS, fit_open_loop, make_open_loop
from diffsim.learn.setup import evaluate
from rl.arguments import setup_from, task_mistakes_in_short, training_parser


def main(argv: Sequence[str], description: str | None = None) -> dict[str, object]:
    """``train_gradient.py --controller``: the best of some starts is written as JSON."""
    parser = training_parser(description)
    add: argparse._ActionsContainer = parser
    add.add_argument("--controller", choices=KINDS, required=True)
    add.add_argument("--starts", type=int, default=4, help="random first guesses (4)")
    add.add_argument("--max-iterations", type=int, default=30, help="of each (30)")
    args = parser.parse_args(argv)
    torch.set_num_threads(args.threads)
    with task_mistakes_in_short():
        setup = setup_from(args).require_new()
        task, begin = setup.make_task(), time.process_time()
    fits: list[tuple[float, int, nn.Module]] = []
    calls = 0
    for k in range(2 if args.quick else args.starts):
        controller = make_open_loop(args.controller, task, setup.seed + k)
        iterations = 2 if args.quick else args.max_iterations
        try:
            found = fit_open_loop(task, controller, seed=setup.seed, max_iterations=iterations)
            reward, count = -found.final.value, found.num_evaluations
        except DiffsimError:  # this first guess breaks down; another may not
            reward, count = -math.inf, 1
        calls += count
        fits.append((reward, setup.seed + k, controller))
    reward, seed, best = max(fits, key=lambda fit: fit[0])
    out = {
        "task": setup.task,
        "controller": args.controller,
        "rewards": [fit[0] for fit in fits],
        "best_start": seed,
        "evaluation_reward": evaluate(task, best, setup.evaluation_episodes),
        "steps": calls * task.max_steps,
        "seconds": time.process_time() - begin,
        "parameters": {name: value.tolist() for name, value in best.state_dict().items()},
    }
    name = Path("runs") / setup.label / args.controller / f"seed_{setup.seed}"
    path = write_json_atomic((args.out or name) / "open_loop.json", out)
    print(f"{setup.label}, {args.controller}: best reward {reward:.4g}; {path}")
    return out
