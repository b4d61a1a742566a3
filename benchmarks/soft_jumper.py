"""The soft jumper beside the figures its authors published: time step, speed, learning curves.

python -m benchmarks.soft_jumper                     # the same jump at smaller time steps; speed
python -m benchmarks.soft_jumper --speed             # steps per CPU second by method
python -m benchmarks.soft_jumper --curves rl/results/soft_jumper
python -m benchmarks.soft_jumper --picture docs/images/soft_jumper

Published returns: Xing, Luk, Oh, "Stabilizing reinforcement learning in differentiable multiphysics
simulation" (ICLR 2025, arXiv:2412.12089), soft jumper, final policies after 6 million steps.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from benchmarks.envs import Case, gradient_price
from benchmarks.plot_style import legend_below, new_figure, save, style
from diffsim.core import interruptible
from diffsim.envs import TaskState
from diffsim.envs.rollout import rollout_task
from diffsim.envs.soft_named import SoftJumper
from diffsim.learn.run import read_rows
from diffsim.learn.setup import evaluate
from diffsim.viz.figures import CYCLE, SOFT

PUBLISHED = {"SAPO": 1820.5, "APG": 956.6, "SHAC": 853.3, "TrajOpt": 437.0, "PPO": 261.5}
PUBLISHED_STEPS = 6_000_000
# folder of runs: what they are, and the published method that is nearest
RUNS = {
    "sapo_clock": ("SAPO with a clock", "SAPO"),
    "gradient_clock": ("Adam, a network with a clock, whole episodes", "APG"),
    "gradient_short": ("the same, first 100 steps of episodes", "APG"),
    "open_loop": ("Adam on one period, no network", "TrajOpt"),
    "sapo": ("SAPO, no clock", "SAPO"),
    "shac": ("SHAC, no clock", "SHAC"),
}
PLAIN = ("gradient_short", "sapo", "shac")  # dotted: what did not pay
METHODS = ("newton_cholesky", "auto")  # linearly implicit steps refuse the floor
SUBSTEPS = (1, 2, 4, 8, 16)
SQUARE_WAVES = (2.0, 2.5, 3.0, 3.5, 4.0)  # [Hz]
BY_HAND = 139.0  # return of the best of them, 3 Hz
CONTROL_PERIOD = 1.0 / 60.0  # [s]
EPISODE, EPISODES = 300, 4  # control steps, and how many episodes rate a controller


def command(seconds: float) -> float:
    """Of all muscles: they shrink slowly, hold, and swell at once."""
    return min(seconds / 0.5, 1.0) if seconds < 0.7 else -1.0


def jump(task: SoftJumper, control_steps: int = 84) -> Iterator[TaskState]:
    """States of the jump by ``command``, the first one included."""
    state = task.start(1, np.random.default_rng(0))
    yield state
    with torch.no_grad():
        for k in range(control_steps):
            level = command((k + 0.5) * CONTROL_PERIOD)
            state, _ = task.step(state, torch.full((1, task.num_actions), level).double())
            yield state


def still_jumper(substeps: int) -> SoftJumper:
    """The task from rest on the floor.

    The solver's tolerance falls with the time step's square, as its scale grows.
    """
    robot = {"dt": CONTROL_PERIOD / substeps, "rtol": 4e-4 / substeps**2}
    return SoftJumper(robot=robot, substeps=substeps, drop=0.0, aside=0.0, size_spread=0.0)


def rise(substeps: int) -> tuple[float, float]:
    """How high the center of the jump rises [m], and CPU seconds per control step."""
    task, began = still_jumper(substeps), time.process_time()
    heights = [float(task.robot.center(state["x"])[0, 2]) for state in jump(task)]
    return max(heights) - heights[0], (time.process_time() - began) / (len(heights) - 1)


def report_square_waves() -> None:
    """Returns of all muscles shrinking and swelling together, from the starts that rate runs."""
    task = SoftJumper()
    print("| square wave | return |\n|---|---|")
    for hertz in SQUARE_WAVES:
        per_step = evaluate(task, partial(square_wave, task, hertz), EPISODES)
        print(f"| {hertz:g} Hz | {task.max_steps * per_step:.0f} |", flush=True)


def square_wave(task: SoftJumper, hertz: float, seen: torch.Tensor, step: int) -> torch.Tensor:
    """Commands (batch, num_actions): 1 in the first half of a period, -1 in the second."""
    level = 1.0 if (step * task.dt * hertz) % 1.0 < 0.5 else -1.0
    return torch.full((len(seen), task.num_actions), level, dtype=torch.float64)


def report_steps() -> None:
    """The table of time steps, and the price of a step with its gradient."""
    print("| substeps | time step | center rises | CPU ms per control step |\n|---|---|---|---|")
    for substeps in SUBSTEPS:
        height, cost = rise(substeps)
        step = 1e3 * CONTROL_PERIOD / substeps
        print(f"| {substeps} | {step:.2f} ms | {height:.3f} m | {1e3 * cost:.1f} |", flush=True)
    price = gradient_price(Case("SoftJumper", {}, 8), batch=32)
    print(
        f"batch of 32: {1.0 / price['forward_s']:.0f} steps per CPU s, "
        f"{1.0 / price['with_gradient_s']:.0f} with gradient"
    )


def report_speed() -> None:
    """Steps per CPU second by the method of a time step, under random commands; best of two."""
    print(
        "| method | steps per CPU s | with gradient | 6 million with gradient |\n|---|---|---|---|"
    )
    for method in METHODS:
        rates = {grad: max(rate(method, grad) for _ in range(2)) for grad in (False, True)}
        hours = PUBLISHED_STEPS / rates[True] / 3600.0
        cells = f"{rates[False]:.0f} | {rates[True]:.0f} | {hours:.0f} CPU hours"
        print(f"| {method} | {cells} |", flush=True)


def rate(method: str, differentiate: bool, batch: int = 8, steps: int = 16) -> float:
    """Control steps per CPU second of episodes under random commands, held for four steps."""
    task = SoftJumper()
    task.robot.body.solver = replace(task.robot.body.solver, method=method)
    rng = np.random.default_rng(0)
    start = task.start(batch, rng)
    shape = (steps // 4, batch, task.num_actions)
    commands = torch.from_numpy(rng.uniform(-1.0, 1.0, shape)).requires_grad_(differentiate)
    began = time.process_time()
    with torch.set_grad_enabled(differentiate):
        total = rollout_task(task, lambda _seen, k: commands[k // 4], start, steps).rewards.sum()
    if differentiate:
        total.backward()
    return batch * steps / (time.process_time() - began)


def draw_curves(records: Path, out: Path) -> None:
    """Returns against steps, to the published number of them, and against CPU seconds."""
    figure = new_figure(8.6, 4.4)
    panels = figure.subplots(1, 2, sharey=True)
    colors = dict(zip(PUBLISHED, CYCLE, strict=False))
    for method, value in PUBLISHED.items():
        label = f"{method}, published after 6 million steps"
        panels[0].plot(PUBLISHED_STEPS, value, "D", color=colors[method], label=label)
        for ax in panels:
            ax.axhline(value, color=colors[method], lw=0.8, ls="--")
    for folder, (words, method) in RUNS.items():
        dashes = ":" if folder in PLAIN else "-"
        for k, path in enumerate(sorted((records / folder).glob("seed_*"))):
            rows = read_rows(path)
            returns = [EPISODE * row["reward"] for row in rows]
            style_of = {"color": colors[method], "ls": dashes, "marker": ".", "lw": 1.3}
            label = f"{words}, here" if k == 0 else "_"  # matplotlib lists no label of these
            for ax, axis in zip(panels, ("steps", "seconds"), strict=True):
                ax.plot([row[axis] for row in rows], returns, label=label, **style_of)
    for ax in panels:
        label = "all muscles by a square wave of 3 Hz, no training"
        ax.axhline(BY_HAND, color=SOFT, lw=0.8, ls=":", label=label)
    style(panels[0], "Return of an episode", "simulation steps")
    panels[0].set_xscale("symlog", linthresh=1000, linscale=0.3)
    panels[0].set_xlim(-100, 1.5 * PUBLISHED_STEPS)
    panels[0].set_xticks([0, 1e3, 1e4, 1e5, 1e6])
    style(panels[1], "The runs here", "CPU seconds of training")
    legend_below(figure, panels, 2)
    save(figure, out)


def draw_jump(out: Path) -> None:
    """Four pictures of the jump: at rest, shrunk, leaving the floor, at its height."""
    task = still_jumper(2)
    states = list(jump(task))
    heights = [float(task.robot.center(state["x"])[0, 2]) for state in states]
    figure = new_figure(9.6, 2.1)
    moments = (0, 41, 48, int(np.argmax(heights)))
    for ax, k in zip(figure.subplots(1, len(moments)), moments, strict=True):
        ax.imshow(task.picture(states[k], 0))
        ax.set_axis_off()
        ax.set_title(f"{k * CONTROL_PERIOD:.2f} s, center at {heights[k]:.2f} m", fontsize=8)
    save(figure, out)


def main() -> None:
    """Run; see the module."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--speed", action="store_true", help="of the methods of a time step")
    parser.add_argument("--curves", type=Path, default=None, help="folder METHOD/seed_N of runs")
    parser.add_argument("--picture", type=Path, default=None, help="where to put one of a jump")
    parser.add_argument("--out", type=Path, default=Path("docs/images/learning_SoftJumper"))
    args = parser.parse_args()
    if args.speed:
        report_speed()
    if args.picture is not None:
        draw_jump(args.picture)
    if args.curves is not None:
        draw_curves(args.curves, args.out)
    if not args.speed and args.curves is None and args.picture is None:
        report_steps()
        report_square_waves()


if __name__ == "__main__":
    with interruptible():
        main()
