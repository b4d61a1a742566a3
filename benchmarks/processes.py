"""Measurements in a process of their own, and the memory of a process."""

from __future__ import annotations

import gc
import multiprocessing
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

Result = Any


def run_child(
    task: Callable[[dict[str, Any]], Result], settings: dict[str, Any], *, timeout: float
) -> Result:
    """``task(settings)`` in a process of its own; its result, or {"failed": reason}.

    Such a process has its own peak memory and may be killed without harm. It is forked from a
    server that has everything imported and has done nothing else.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([task.__module__])
    receive, send = context.Pipe(duplex=False)
    child = context.Process(target=_child, args=(task, settings, send), daemon=True)
    child.start()
    send.close()
    try:
        if not receive.poll(timeout):
            return {"failed": f"not done within {timeout:.0f} s"}
        return receive.recv()
    except EOFError:
        child.join()
        return {"failed": f"died with exit code {child.exitcode} (-9: most likely out of memory)"}
    finally:
        child.kill()
        child.join()
        receive.close()


def _child(task: Callable[[dict[str, Any]], Result], settings: dict[str, Any], send: Any) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is told, and ends this process
    try:
        send.send(task(settings))
    except Exception as err:  # whatever it is, the parent reports it
        send.send({"failed": f"{type(err).__name__}: {err}"})


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
