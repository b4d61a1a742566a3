"""Command lines from dataclasses: every option of a method is an argument of its script."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import torch
import torch.distributed as dist

from diffsim.core.interrupts import EXIT_INTERRUPTED
from diffsim.envs.registry import make_task, task_class
from diffsim.envs.task_file import ChangedTaskError
from diffsim.learn.gradient import GradientLearner, GradientOptions
from diffsim.learn.parallel import LostProcessError, launched_together, rank
from diffsim.learn.recipes import recipe
from diffsim.learn.run import Learner, Run, train
from diffsim.learn.setup import Setup

T = TypeVar("T")
EXIT_MISTAKE = 2  # what argparse uses too


@contextmanager
def task_mistakes_in_short(setup: Setup | None = None) -> Iterator[None]:
    """What is wrong with a task, or its file, ends a script by its message alone.

    Args:
        setup: Whose task is made within, among other things: only what the task says of itself is
            shortened; None: all that is done within is about the task.

    Raises:
        SystemExit: after the message.
    """
    try:
        yield
    except (ValueError, TypeError, OSError) as error:
        if (said := error if setup is None else _task_mistake(setup)) is None:
            raise  # a mistake elsewhere
        print(said, file=sys.stderr)
        raise SystemExit(EXIT_MISTAKE) from None


def _task_mistake(setup: Setup) -> Exception | None:
    """What is wrong with a task; None: it can be made."""
    try:
        setup.make_task()
    except (ValueError, TypeError, OSError) as error:
        return error
    return None


def add_options(parser: argparse.ArgumentParser, cls: type, title: str) -> None:
    """One argument per field of a dataclass, with its default."""
    group = parser.add_argument_group(title)
    for field in dataclasses.fields(cls):
        kind = type(field.default)
        name = "--" + field.name.replace("_", "-")
        group.add_argument(name, type=kind, default=field.default, help=f"({field.default})")


def options_from(cls: type[T], args: argparse.Namespace, **fixed: Any) -> T:
    """The dataclass from parsed arguments, some fields fixed."""
    names = [f.name for f in dataclasses.fields(cls)]  # type: ignore[arg-type]
    return cls(**{n: getattr(args, n) for n in names if hasattr(args, n)} | fixed)


def training_parser(description: str | None) -> argparse.ArgumentParser:
    """Arguments that all training scripts share."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--task", default="CopterHover", help="name or YAML file of a task (CopterHover)")
    add("--task-options", type=json.loads, default={}, metavar="JSON", help="of the task ({})")
    add("--seed", type=int, default=0, help="(0)")
    add("--steps", type=int, default=200_000, help="budget of simulation steps (200000)")
    add("--evaluate-every", type=int, default=10_000, help="simulation steps (10000)")
    add("--evaluation-episodes", type=int, default=16, help="(16)")
    add("--out", type=Path, default=None, help="folder of results (runs/TASK/METHOD/seed_N)")
    add("--resume", action="store_true", help="continue from the folder's checkpoint")
    add("--quick", action="store_true", help="a tiny run, to see that all works")
    add("--output-gain", type=float, default=0.01, help="of the first network's last layer (0.01)")
    add("--balance-clock", action=argparse.BooleanOptionalAction, default=False, help="(no)")
    add("--start", default="", metavar="FOLDER", help="earlier run whose controller goes on")
    add("--plain", action="store_true", help="without the task's recipe: these defaults")
    add("--threads", type=int, default=1, help="of torch (1)")
    return parser


def setup_from(args: argparse.Namespace) -> Setup:
    """The run that arguments ask for."""
    if args.quick:
        return Setup(
            args.task,
            args.task_options | _short_episode(args.task, args.task_options),
            args.seed,
            steps=320,
            evaluate_every=160,
            evaluation_episodes=2,
            warm_up=5,
            output_gain=args.output_gain,
            balance_clock=args.balance_clock,
            start=args.start,
        )
    return options_from(Setup, args)


def _short_episode(task: str, options: dict[str, Any]) -> dict[str, Any]:
    """Options that make an episode a few steps long."""
    kind = task_class(task)
    if kind.length_option != "seconds":
        return {kind.length_option: 5}
    return {"seconds": 10 * make_task(task, **options).dt}


def start_from_recipe(
    parser: argparse.ArgumentParser, words: Sequence[str] | None, *, by_gradient: bool
) -> argparse.Namespace:
    """Parse arguments whose defaults are those of the task's recipe, unless ``--plain``.

    Args:
        parser: Of a training script, with its method's options.
        words: Arguments; None: those of the command line.
        by_gradient: Whether budget and options of the recipe are this method's, too.
    """
    given = parser.parse_args(words)
    if given.plain:
        return given
    chosen = recipe(given.task)
    parser.set_defaults(**chosen.setup)
    if by_gradient:
        parser.set_defaults(**chosen.budget, **chosen.gradient)
    args = parser.parse_args(words)
    args.task_options = {**chosen.task_options, **args.task_options}
    return args


def main_training(
    method: str,
    learner: type,
    options: type,
    quick: dict[str, Any],
    description: str | None,
    argv: Sequence[str] | None,
) -> Run:
    """Main function of a training script.

    Args:
        method: Name of the method, for the folder.
        learner, options: Classes of the method and of its options.
        quick: Options of a quick run.
        description: Docstring of the script.
        argv: Arguments; None: those of the command line.
    """
    parser = training_parser(description)
    add_options(parser, options, "method")
    with task_mistakes_in_short():
        args = start_from_recipe(parser, argv, by_gradient=options is GradientOptions)
    if launched_together() and learner is not GradientLearner:
        parser.error("torchrun: of all methods rl/train_gradient.py alone shares its episodes")
    with process_group():
        return _train_from_arguments(method, learner, options, quick, args)


@contextmanager
def process_group() -> Iterator[None]:
    """Join the processes that ``torchrun`` has started; nothing where this one is alone."""
    if not launched_together():
        yield
        return
    dist.init_process_group("gloo")
    try:
        yield
    finally:
        dist.destroy_process_group()


def _train_from_arguments(
    method: str, learner: type, options: type, quick: dict[str, Any], args: argparse.Namespace
) -> Run:
    """The run that arguments ask for, from its first update to its last."""
    torch.set_num_threads(args.threads)
    with task_mistakes_in_short():
        setup = setup_from(args)
    folder = args.out or Path("runs") / setup.label / method / f"seed_{setup.seed}"
    chosen: Any = options_from(options, args, **(quick if args.quick else {}))
    with task_mistakes_in_short(setup):
        made: Learner = learner(setup, chosen)
    try:
        run = train(setup, made, folder, resume=args.resume)
    except KeyboardInterrupt:
        raise SystemExit(EXIT_INTERRUPTED) from None
    except ChangedTaskError as error:
        print(error, file=sys.stderr)
        raise SystemExit(EXIT_MISTAKE) from None
    except LostProcessError as error:
        raise SystemExit(f"LostProcessError: {error}") from None
    last = run.rows[-1]
    if rank() != 0:
        return run
    print(
        f"{setup.label}, {method}, seed {setup.seed}: reward {run.rows[0]['reward']:.4g} -> "
        f"{last['reward']:.4g} in {last['steps']} steps, {last['seconds']:.1f} CPU s; {folder}"
    )
    return run
