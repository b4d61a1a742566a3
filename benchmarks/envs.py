"""Environment steps per second: one, a batch, gymnasium's vector environments; price of gradients.

All kinds of one task take turns in one run, several rounds, medians over rounds. Steps are per
second of CPU time of this process, with one thread, which a busy machine changes little; those of
worker processes (forkserver, one thread each) are per second of the wall clock, and use as many
cores as there are workers.

python -m benchmarks.envs --out runs/bench_envs
python -m benchmarks.envs --quick
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

import diffsim.envs
from benchmarks.harness import spread
from diffsim.core import interruptible
from diffsim.core.files import to_plain, write_json_atomic
from diffsim.envs import make_task, make_vector
from labs.machine import machine

BATCHES = (1, 8, 64)
LARGE = 8192  # of vehicles, whose batches are cheap
WORKERS = 2


@dataclass(frozen=True)
class Case:
    """A task, its options, and control steps per measurement."""

    task: str
    options: Mapping[str, Any]
    steps: int


CASES = {
    "CopterHover": Case("CopterHover", {}, 60),
    "CopterTrack": Case("CopterTrack", {}, 60),
    "StarfishSwim, coarse": Case("StarfishSwim", {"robot": {"coarse": True}}, 10),
    "StarfishSwim, thesis size": Case("StarfishSwim", {}, 3),
}


def stepper(env: Any, num_envs: int, steps: int) -> Callable[[], int]:
    """A call that takes ``steps`` control steps of all members, and their number."""
    shape = env.action_space.shape
    env.reset(seed=0)
    rng = np.random.default_rng(0)

    def call() -> int:
        for _ in range(steps):
            outcome = env.step(rng.uniform(-0.3, 0.3, shape).astype(np.float32))
            if num_envs == 1 and (outcome[2] or outcome[3]) is True:
                env.reset()
        return steps * num_envs

    return call


def kinds(case: Case) -> dict[str, tuple[Any, int]]:
    """Environments of a case by name, with their numbers of members."""
    make = partial(gymnasium.make, f"diffsim/{case.task}-v0", **case.options)
    out: dict[str, tuple[Any, int]] = {"single": (make(), 1)}
    for count in (*BATCHES, *([LARGE] if case.task.startswith("Copter") else [])):
        out[f"native batch of {count}"] = (make_vector(case.task, count, **case.options), count)
    out["SyncVectorEnv of 8"] = (SyncVectorEnv([make] * 8), 8)
    out[f"AsyncVectorEnv, {WORKERS} processes"] = (
        AsyncVectorEnv([partial(_in_worker, case)] * WORKERS, context="forkserver"),
        WORKERS,
    )
    return out


def _in_worker(case: Case) -> gymnasium.Env:
    torch.set_num_threads(1)
    return gymnasium.make(f"diffsim.envs:diffsim/{case.task}-v0", **case.options)


def gradient_price(case: Case, batch: int = 4) -> dict[str, float]:
    """CPU seconds of a step forward, of one with its gradient, and their ratio."""
    task = make_task(case.task, **case.options)
    action = torch.full((batch, task.num_actions), 0.1, dtype=torch.float64)

    def rollout(differentiate: bool) -> float:
        given = action.clone().requires_grad_(differentiate)
        state = task.start(batch, np.random.default_rng(0))
        began = time.process_time()
        total = torch.zeros((), dtype=torch.float64)
        with torch.set_grad_enabled(differentiate):
            for _ in range(case.steps):
                state, reward = task.step(state, given)
                total = total + reward.sum()
        if differentiate:
            total.backward()
        return (time.process_time() - began) / (case.steps * batch)

    rollout(True)
    pairs = [(rollout(False), rollout(True)) for _ in range(3)]
    forward, both = (float(np.median(column)) for column in zip(*pairs, strict=True))
    return {"forward_s": forward, "with_gradient_s": both, "ratio": both / forward}


def measure(case: Case, rounds: int) -> dict[str, Any]:
    """Steps per second of all kinds, in turns."""
    envs = kinds(case)
    try:
        calls = {name: stepper(env, n, case.steps) for name, (env, n) in envs.items()}
        rates: dict[str, list[float]] = {name: [] for name in calls}
        for _ in range(rounds + 1):  # the first round warms up
            for name, call in calls.items():
                clock = time.perf_counter if name.startswith("Async") else time.process_time
                began = clock()
                count = call()
                rates[name].append(count / (clock() - began))
    finally:
        for env, _ in envs.values():
            env.close()
    return {
        "steps_per_second": {name: spread(values[1:]) for name, values in rates.items()},
        "gradient": gradient_price(case),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("runs/bench_envs"))
    parser.add_argument("--only", choices=list(CASES), help="one case")
    parser.add_argument("--quick", action="store_true", help="one round, no thesis size")
    args = parser.parse_args()
    torch.set_num_threads(1)
    assert diffsim.envs.ENV_IDS  # importing registers them
    wanted = [args.only] if args.only else list(CASES)
    cases = {k: CASES[k] for k in wanted if not (args.quick and "thesis" in k)}
    results: dict[str, Any] = {"machine": machine(), "cases": {}}
    for name, case in cases.items():
        results["cases"][name] = measure(case, 1 if args.quick else 5)
        print(name)
        for kind, rate in results["cases"][name]["steps_per_second"].items():
            each = 1e3 / rate["median"]
            print(f"  {kind:32s} {rate['median']:10.0f} steps/s, {each:8.4f} ms each")
        price = results["cases"][name]["gradient"]
        print(f"  a step with its gradient costs {price['ratio']:.1f} steps without")
        write_json_atomic(args.out / "results.json", to_plain(results))


if __name__ == "__main__":
    with interruptible():
        main()
