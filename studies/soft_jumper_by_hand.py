"""What a good hop of the soft jumper returns: Adam on the commands of one period, no network.

python -m studies.soft_jumper_by_hand --out runs/SoftJumper/open_loop/seed_0

One period of a third of a second, 20 control steps x 216 commands, is repeated. It begins as a
square wave for all muscles together. Adam differentiates the first 100 steps of two episodes, whose
starts are drawn anew, and is rated on the four whole episodes that rate learned controllers.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from diffsim.core import interruptible
from diffsim.core.files import to_plain, write_text_atomic
from diffsim.envs.rollout import rollout_task
from diffsim.envs.soft_named import SoftJumper
from diffsim.learn.adam import Adam
from diffsim.learn.gradient import cosine_rate
from diffsim.learn.run import RESULTS
from diffsim.learn.setup import evaluate

COMMANDS = "commands.npy"
EPISODES = 4  # that rate


@dataclass(frozen=True)
class Options:
    """How the period is found.

    Attributes:
        period: Control steps of a period; 20 are 3 Hz, the best square wave.
        horizon: Control steps that are differentiated.
        batch: Episodes of an iteration.
        iterations: Steps of Adam.
        rate: Of Adam at the start; falls along a half cosine.
        last_rate: What is left of the rate at the end, as a share; 1: it stays.
        every: Iterations between two ratings.
        seed: Of the starts.
    """

    period: int = 20
    horizon: int = 100
    batch: int = 2
    iterations: int = 60
    rate: float = 0.1
    last_rate: float = 0.1
    every: int = 10
    seed: int = 0


class Period(torch.nn.Module):
    """Repeats commands: tanh of ``raw`` (period, num_actions)."""

    def __init__(self, period: int, num_actions: int):
        super().__init__()
        raw = torch.full((period, num_actions), 0.8, dtype=torch.float64)
        raw[period // 2 :] *= -1.0
        self.raw = torch.nn.Parameter(raw)

    def forward(self, seen: Tensor, step: int) -> Tensor:
        """Commands (batch, num_actions) of a step; what is seen only says how many."""
        return torch.tanh(self.raw[step % len(self.raw)]).expand(len(seen), -1)


def optimize(task: SoftJumper, options: Options, out: Path) -> Period:
    """Improve the period; ratings and the commands of the best one go to a folder."""
    o, rng = options, np.random.default_rng(options.seed)
    period, rows = Period(o.period, task.num_actions), []
    adam = Adam([period.raw], o.rate)
    seconds = 0.0
    out.mkdir(parents=True, exist_ok=True)
    for k in range(o.iterations + 1):
        if k % o.every == 0 or k == o.iterations:
            rows.append(_row(task, period, o, k, seconds))
            print(
                f"{rows[-1]['steps']:,} steps: {task.max_steps * rows[-1]['reward']:.0f}",
                flush=True,
            )
            if rows[-1]["reward"] == max(row["reward"] for row in rows):
                np.save(out / COMMANDS, torch.tanh(period.raw).detach().numpy().astype(np.float16))
            lines = [json.dumps(to_plain(row), allow_nan=False) for row in rows]
            write_text_atomic(out / RESULTS, "\n".join(lines) + "\n")
        if k == o.iterations:
            break
        began = time.process_time()
        adam.rate = cosine_rate(o.rate, k / o.iterations, o.last_rate)
        adam.zero_grad()
        episode = rollout_task(task, period, task.start(o.batch, rng), o.horizon)
        (-episode.rewards.mean()).backward()
        torch.nn.utils.clip_grad_norm_([period.raw], 1.0)
        adam.step()
        seconds += time.process_time() - began
    return period


def _row(task: SoftJumper, period: Period, options: Options, k: int, seconds: float) -> dict:
    """A rating, as runs of training keep them."""
    steps = k * options.batch * options.horizon
    return {
        "steps": steps,
        "gradient_steps": steps,
        "seconds": seconds,
        "updates": k,
        "reward": evaluate(task, period, EPISODES),
        "finished": k == options.iterations,
    }


def main() -> None:
    """Run; see the module."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for field in dataclasses.fields(Options):
        assert field.default is not dataclasses.MISSING
        kind = type(field.default)
        parser.add_argument(f"--{field.name}", type=kind, default=field.default)
    parser.add_argument("--out", type=Path, default=Path("runs/SoftJumper/open_loop/seed_0"))
    args = vars(parser.parse_args())
    out = args.pop("out")
    torch.set_num_threads(1)
    optimize(SoftJumper(), Options(**args), out)


if __name__ == "__main__":
    with interruptible():
        main()
