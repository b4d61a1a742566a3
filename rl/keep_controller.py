"""Keep a trained run's controller with the package, for `diffsim play`.

python rl/train_gradient.py --task CopterHover --seed 0
python rl/keep_controller.py runs/CopterHover/gradient/seed_0

The numbers are rounded first and rated afterwards; the rating is what `diffsim play` compares with.
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import torch

from diffsim.control import MLPController
from diffsim.envs.task_file import require_unchanged
from diffsim.learn.checkpoint import read_checkpoint
from diffsim.learn.run import task_file_of
from diffsim.learn.setup import Setup, evaluate
from diffsim.learn.trained import FOLDER, Trained, stored, write_trained


def main(argv: Sequence[str] | None = None) -> Path:
    """Round, rate, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="folder with checkpoint.pt")
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder (the package's)")
    parser.add_argument("--made-by", default=None, help="command of the training, for the record")
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    saved = read_checkpoint(args.run)
    setup = Setup(**json.loads(saved["setup"]))
    require_unchanged(setup.task, task_file_of(saved), str(args.run))
    task = setup.make_task()
    net = MLPController(task.num_observations, task.num_actions)
    net.load_state_dict(saved["controller"])
    usual = f"python rl/train_gradient.py --task {setup.task} --seed {setup.seed}"
    made_by = args.made_by or usual + (f" --start {setup.start}" if setup.start else "")
    kept = Trained(
        task=setup.task,
        task_options=setup.task_options,
        episodes=setup.evaluation_episodes,
        reward=0.0,
        made_by=made_by,
        state=stored(net),
        task_file=task_file_of(saved),
    )
    reward = evaluate(task, kept.controller(task), setup.evaluation_episodes)
    path = write_trained(
        args.out / f"{setup.label}.npz", Trained(**{**vars(kept), "reward": reward})
    )
    size = path.stat().st_size / 1e3
    print(
        f"{path}: {size:.0f} kB, reward {reward:.4f} (in the run {saved['rows'][-1]['reward']:.4f})"
    )
    return path


if __name__ == "__main__":
    with interruptible():
        main()
