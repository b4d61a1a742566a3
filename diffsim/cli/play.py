"""``diffsim play``: a trained controller that comes with the package, replayed and filmed."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from diffsim.core.files import csv_text, write_text_atomic
from diffsim.core.optional import ask_for

if TYPE_CHECKING:
    from torch import Tensor

    from diffsim.envs.task import Task, TaskState
    from diffsim.learn.trained import Trained

HELP = "replay a trained controller and film it"
FPS = 10  # of films, about


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``diffsim play``."""
    parser.add_argument(
        "name", metavar="NAME", nargs="?", help="a task, such as SharkSwim; none: list them"
    )
    parser.add_argument("--file", type=Path, help="a controller of your own instead")
    parser.add_argument(
        "--changed", action="store_true", help="play although the task's file has changed"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/play"), help="default: %(default)s")
    parser.add_argument("--no-film", action="store_true", help="only the reward and the recording")


def command(args: argparse.Namespace) -> None:
    """Check what is needed, steer the recorded starts, print the reward beside the recorded one.

    Raises:
        ImportError: a package is missing; the message says how to install it.
        ValueError: no controller of this name.
    """
    if args.name is None and args.file is None:
        from diffsim.learn.kept_files import about, trained_names

        for name in trained_names():
            said = about(name)
            print(f"{name:<14} reward {said['reward']:.3f} a step; {said['made_by']}")
        return
    film = [] if args.no_film else ["matplotlib"]  # which brings Pillow
    ask_for(["gymnasium", *film], purpose="diffsim play")
    from diffsim.learn.trained import load_trained, read_trained

    kept = load_trained(args.name) if args.file is None else read_trained(args.file)
    folder = args.out / kept.label
    folder.mkdir(parents=True, exist_ok=True)  # a folder that cannot be written costs no episode
    _play(kept, folder, film=not args.no_film, changed=args.changed)


def _play(kept: Trained, folder: Path, *, film: bool, changed: bool) -> None:
    import torch

    from diffsim.learn.trained import replay

    torch.set_num_threads(1)  # a network of 64 units gains nothing from more
    task = kept.make_task(changed=changed)
    print(
        f"{kept.label}: {kept.episodes} episodes of {task.max_steps} steps of "
        f"{1e3 * task.dt:.3g} ms ...",
        flush=True,
    )
    played = replay(kept, task)
    mean = float(played.rewards.mean())
    print(f"reward per step  {mean:.4f}   recorded {kept.reward:.4f}")
    print(f"trained by       {kept.made_by}")
    rows = played.commands[:, 0], played.rewards[:, 0]
    written = [_record(folder / "recording.csv", task, *rows)]
    if film:
        written.append(_film(folder / "film.gif", task, played.states))
    print(f"written          {', '.join(str(path) for path in written)}")


def _record(path: Path, task: Task, commands: Tensor, rewards: Tensor) -> Path:
    """Time, commands and reward of the first episode."""
    header = ["time_s", *(entry.name for entry in task.actions), "reward"]
    both = zip(commands.tolist(), rewards.tolist(), strict=True)
    rows = ([k * task.dt, *command, reward] for k, (command, reward) in enumerate(both))
    return write_text_atomic(path, csv_text(header, rows, ".6g"))


def _film(path: Path, task: Task, states: list[TaskState]) -> Path:
    """The first episode, about ``FPS`` pictures a second, as fast as the robot was."""
    from diffsim.viz.film import write_gif

    every = max(1, round(1.0 / (FPS * task.dt)))
    pictures = [task.picture(state, 0) for state in states[::every]]
    return write_gif(path, pictures, 1.0 / (every * task.dt))
