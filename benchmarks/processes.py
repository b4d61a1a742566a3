"""Measurements in a process of their own, and the memory of a process."""

from __future__ import annotations

import gc
from collections.abc import Callable
from pathlib import Path
from typing import Any

from diffsim.core.workers import LostWorkerError, Worker

Result = Any


def run_child(
    task: Callable[[dict[str, Any]], Result], settings: dict[str, Any], *, timeout: float
) -> Result:
    """``task(settings)`` in a process of its own; its result, or {"failed": reason}.

    Such a process has its own peak memory and may be killed without harm. It is forked from a
    server that has everything imported and has done nothing else.
    """
    worker = Worker(task.__module__)
    try:
        return worker.call(_told, task, settings, timeout=timeout)
    except (TimeoutError, LostWorkerError) as error:
        return {"failed": str(error)}
    finally:
        worker.end(at_once=True)


def _told(task: Callable[[dict[str, Any]], Result], settings: dict[str, Any]) -> Result:
    try:
        return task(settings)
    except Exception as err:  # whatever it is, the parent reports it
        return {"failed": f"{type(err).__name__}: {err}"}


def memory(which: str = "VmRSS") -> int:
    """Resident memory now (VmRSS) or its peak since the last reset (VmHWM) [byte].

    Not ru_maxrss: a child inherits that from the process that started it.
    """
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(which + ":"):
            return 1024 * int(line.split()[1])
    raise RuntimeError(f"this system does not report {which}")


def reset_peak_memory() -> int:
    """Start the peak anew; returns the resident memory that it starts from [byte]."""
    gc.collect()
    Path("/proc/self/clear_refs").write_text("5")
    return memory()
