"""The loop around every method: budget, ratings, log, checkpoint, resume, Ctrl-C."""

from __future__ import annotations

import io
import json
import math
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import nn

from diffsim.core.checked import checked
from diffsim.core.files import to_plain, write_bytes_atomic, write_text_atomic
from diffsim.core.optional import ask_for
from diffsim.core.progress import show_progress
from diffsim.envs.task_file import record_of, require_unchanged
from diffsim.learn.checkpoint import CHECKPOINT, read_checkpoint
from diffsim.learn.parallel import rank
from diffsim.learn.setup import Setup, evaluate

Row = dict[str, Any]
RESULTS = "results.jsonl"


@dataclass
class Update:
    """What one update of a method used and measured."""

    steps: int  # number of simulation steps that it took
    gradient_steps: int = 0  # how many of them were differentiated
    scalars: dict[str, float] = field(default_factory=dict)  # numbers for the log, by name


class Learner(Protocol):
    """A method: makes a controller better, update by update."""

    def update(self, progress: float) -> Update:
        """One update; ``progress`` is the share of the budget that is spent, in [0, 1]."""

    def controller(self) -> nn.Module:
        """The controller as it is now, without exploration."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that a continued run needs: tensors, numbers, text, dicts and lists."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``."""


@checked(kinds_only=True)
@dataclass
class Run:
    """A run in progress, and its results.

    Attributes:
        folder: Where ``results.jsonl``, ``checkpoint.pt`` and TensorBoard's events lie.
        rows: One per rating: steps, seconds (CPU, without ratings), wall_seconds,
            forward_equivalents, reward.
        finished: Whether the budget is spent.
        task_file: What is remembered of the task's file (``TaskFile.record``); None: it has a name.
    """

    folder: Path
    rows: list[Row] = field(default_factory=list)
    steps: int = 0
    gradient_steps: int = 0
    updates: int = 0
    seconds: float = 0.0
    wall_seconds: float = 0.0
    finished: bool = False
    task_file: dict[str, Any] | None = None


_COUNTERS = ("steps", "gradient_steps", "updates", "seconds", "wall_seconds", "finished")


@checked
def train(
    setup: Setup, learner: Learner, folder: str | Path, *, resume: bool = False, show: bool = True
) -> Run:
    """Update until the budget is spent; rate, log and save on the way.

    A checkpoint is written before the rating that counts it: a run whose ratings say that it is
    finished has its last checkpoint, wherever it was killed. Ctrl-C leaves the last one and raises
    KeyboardInterrupt: what was done since is done again on resuming.

    Args:
        setup: Task and budget.
        learner: Method with its options.
        folder: Folder of results; made if need be.
        resume: Continue from the folder's checkpoint if there is one; otherwise start anew.
        show: Whether to draw a progress bar.

    Raises:
        ValueError: the checkpoint is of another set-up, or the task's file has changed since.
    """
    run = Run(Path(folder), task_file=record_of(setup.task))
    run.folder.mkdir(parents=True, exist_ok=True)
    if resume and (run.folder / CHECKPOINT).exists():
        _load(run, setup, learner)
    task = setup.make_task()
    leads = rank() == 0  # of processes that train together one rates and writes
    writer = _writer(run.folder) if leads else None
    bar = show_progress(
        total=setup.steps, initial=run.steps, unit="step", disable=not (show and leads)
    )
    try:
        if not run.rows:
            _rate(run, setup, task, learner)
        _write_rows(run)
        while run.steps < setup.steps:
            begin, begin_wall = time.process_time(), time.perf_counter()
            update = learner.update(run.steps / setup.steps)
            run.seconds += time.process_time() - begin
            run.wall_seconds += time.perf_counter() - begin_wall
            run.steps += update.steps
            run.gradient_steps += update.gradient_steps
            run.updates += 1
            bar.update(update.steps)
            if writer is not None:
                for name, value in update.scalars.items():
                    writer.add_scalar(name, value, run.steps)
            run.finished = run.steps >= setup.steps
            if run.finished or run.steps - run.rows[-1]["steps"] >= setup.evaluate_every:
                row = _rate(run, setup, task, learner)
                if writer is not None:
                    writer.add_scalar("reward", row["reward"], run.steps)
                bar.set_postfix(reward=f"{row['reward']:.4g}")
                _save(run, setup, learner)
                _write_rows(run)
    except KeyboardInterrupt:
        # an update cut in half would not be repeatable: the last checkpoint stands
        if show:
            bar.write(f"interrupted; continue with --resume (from {run.folder / CHECKPOINT})")
        raise
    finally:
        bar.close()
        if writer is not None:
            writer.close()
    return run


@checked
def read_rows(path: str | Path) -> list[Row]:
    """Ratings of a run's folder, or of a file of them; an empty list where there are none.

    Args:
        path: The folder, or the file.

    Raises:
        ValueError: a line that is no rating, such as one that was cut.
    """
    path = Path(path)
    path = path / RESULTS if path.suffix != ".jsonl" else path
    if not path.exists():
        return []
    lines = path.read_bytes().splitlines()
    return [_read_row(line, f"{path}, row {k}") for k, line in enumerate(lines, start=1)]


def _read_row(line: bytes, where: str) -> Row:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        row = None
    if not isinstance(row, dict) or "reward" not in row or "finished" not in row:
        raise ValueError(
            f"{where}: no rating of a training; was the file cut? --resume writes it again from "
            f"{CHECKPOINT}"
        )
    return row | {"reward": math.nan if row["reward"] is None else row["reward"]}


def is_finished(folder: str | Path) -> bool:
    """Whether a folder holds a run that spent its budget."""
    rows = read_rows(folder)
    return bool(rows) and bool(rows[-1]["finished"])


def _writer(folder: Path) -> Any:
    ask_for(["tensorboard"], purpose="the log of a training")
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder))


def _rate(run: Run, setup: Setup, task: Any, learner: Learner) -> Row:
    row: Row = {
        "steps": run.steps,
        "gradient_steps": run.gradient_steps,
        "forward_equivalents": run.steps + (setup.step_cost - 1.0) * run.gradient_steps,
        "seconds": run.seconds,
        "wall_seconds": run.wall_seconds,
        "updates": run.updates,
        "reward": _rating(setup, task, learner),
        "finished": run.finished,
    }
    run.rows.append(row)
    return row


def _rating(setup: Setup, task: Any, learner: Learner) -> float:
    """The rating; other processes of a training wait for the one that rates."""
    if rank() != 0:
        return math.nan
    return evaluate(task, learner.controller(), setup.evaluation_episodes)


def _write_rows(run: Run) -> None:
    """The ratings, after the checkpoint that holds them: resuming writes those that a kill lost."""
    if rank() != 0:
        return
    lines = [json.dumps(to_plain(r), allow_nan=False) for r in run.rows]
    write_text_atomic(run.folder / RESULTS, "\n".join(lines) + "\n")


def _save(run: Run, setup: Setup, learner: Learner) -> None:
    if rank() != 0:
        return
    content = io.BytesIO()
    counters = {name: getattr(run, name) for name in _COUNTERS}
    state = {
        "setup": json.dumps(to_plain(asdict(setup)), sort_keys=True),
        "task_file": json.dumps(run.task_file),
        "rows": run.rows,
        "counters": counters,
        "learner": learner.state_dict(),
        "controller": learner.controller().state_dict(),
    }
    torch.save(state, content)
    write_bytes_atomic(run.folder / CHECKPOINT, content.getvalue())


def _load(run: Run, setup: Setup, learner: Learner) -> None:
    state = read_checkpoint(run.folder)
    saved, asked = json.loads(state["setup"]), to_plain(asdict(setup))
    for name in ("task", "task_options", "seed", "start", "steps", "evaluate_every"):
        if saved.get(name, "") != asked[name]:
            raise ValueError(
                f"{name} must be {saved.get(name)!r} as in {run.folder / CHECKPOINT}, got "
                f"{asked[name]!r}; give the same values or another folder"
            )
    run.rows = state["rows"]
    for name, value in state["counters"].items():
        setattr(run, name, value)
    learner.load_state_dict(state["learner"])
    require_unchanged(setup.task, task_file_of(state), str(run.folder / CHECKPOINT))


def task_file_of(checkpoint: dict[str, Any]) -> dict[str, Any] | None:
    """What a checkpoint remembers of its task's file; None: a task by name, or one of before."""
    kept: dict[str, Any] | None = json.loads(checkpoint.get("task_file", "null"))
    return kept


def load_controller(folder: str | Path, controller: nn.Module) -> nn.Module:
    """The trained weights of a run, put into a controller of the same shape."""
    controller.load_state_dict(read_checkpoint(folder)["controller"])
    return controller


def rng_state(rng: Any) -> str:
    """State of a numpy generator as text (its integers are wider than a tensor's)."""
    return json.dumps(rng.bit_generator.state)


def set_rng_state(rng: Any, text: str) -> None:
    """Undo ``rng_state``."""
    rng.bit_generator.state = json.loads(text)
