"""What the tests of executors let workers do; importable there by name."""

import os
import signal
import time
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch

from diffsim.core.errors import ConvergenceError


def drawn(seed: int) -> float:
    """A number that depends on the seed and on rounding."""
    matrix = torch.from_numpy(np.random.default_rng(seed).normal(size=(64, 64)))
    return float((matrix @ matrix @ matrix).sum())


def drawn_slowly(item: dict[str, Any]) -> dict[str, Any]:
    """``drawn``, the process that did it, and a mark in a folder for each time that it began."""
    mark = Path(item["folder"]) / f"{item['seed']}_{time.monotonic_ns()}"
    mark.write_text(str(os.getpid()))
    time.sleep(item.get("seconds", 0.0))
    return {"value": drawn(item["seed"]), "process": os.getpid()}


def dies_once(item: dict[str, Any]) -> float:
    """``drawn``; the worker is killed the first time that an item of ``dies`` comes."""
    mark = Path(item["folder"]) / f"died_{item['seed']}"
    if item["dies"] and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return drawn(item["seed"])


def dies(seed: int) -> float:
    """No worker survives it."""
    os.kill(os.getpid(), signal.SIGKILL)
    return float(seed)


def fails(seed: int) -> int:
    """An error with data at seed 2."""
    if seed == 2:
        raise ConvergenceError("no way", residual_norm=3.0, tolerance=1.0, num_iters=seed)
    return seed


def threads(_: int) -> int:
    """Threads of PyTorch in the worker."""
    return torch.get_num_threads()


def unsendable(_: int) -> Callable[[], int]:
    """A result that no pickle holds."""
    return lambda: 1


def make_executor() -> Executor:
    """An executor of one's own."""
    return ThreadPoolExecutor(2)


def no_executor() -> int:
    """Not an executor."""
    return 3
