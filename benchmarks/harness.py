"""What a long benchmark needs: clocks, the machine's description, kept parts, child processes."""

from __future__ import annotations

import gc
import json
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from tqdm import tqdm

from diffsim._files import to_plain, write_json_atomic

ROOT = Path(__file__).resolve().parents[1]
Result = Any
T = TypeVar("T")


class Seconds(NamedTuple):
    """Wall time and CPU time (of all threads) of one call [s]."""

    wall: float
    cpu: float


def timed(call: Callable[[], T]) -> tuple[T, Seconds]:
    """The result of ``call`` and its time, with Python's garbage collector held back."""
    with no_garbage_collection():
        return _timed(call)


def repeat_for(call: Callable[[], object], *, seconds: float, at_most: int = 200) -> list[Seconds]:
    """Times of repeated calls, after one that is not counted; at least one."""
    call()
    times: list[Seconds] = []
    with no_garbage_collection():
        while not times or (sum(t.wall for t in times) < seconds and len(times) < at_most):
            times.append(_timed(call)[1])
    return times


def _timed(call: Callable[[], T]) -> tuple[T, Seconds]:
    wall, cpu = time.perf_counter(), time.process_time()
    result = call()
    return result, Seconds(time.perf_counter() - wall, time.process_time() - cpu)


@contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Collect young garbage now (all of it would take 0.2 s with torch), nothing in the block."""
    gc.collect(0)
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median and quartiles."""
    q1, median, q3 = np.percentile(np.asarray(values, float), [25, 50, 75])
    return {"median": float(median), "q1": float(q1), "q3": float(q3), "count": len(values)}


@contextmanager
def cores(count: int) -> Iterator[None]:
    """Keep this process on ``count`` of its cores, so that a thread count means what it says."""
    if not hasattr(os, "sched_setaffinity"):  # not Linux: the system decides
        yield
        return
    allowed = os.sched_getaffinity(0)
    # The last ones: interrupts and other people's work tend to gather on the first.
    os.sched_setaffinity(0, sorted(allowed)[-count:])
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def num_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class Part:
    """One piece of a benchmark that is measured as a whole and kept when it is done.

    Attributes:
        name: ``stage/what``, also its file name.
        settings: Everything its result depends on besides the code.
        compute: ``compute(results, say)``: results of earlier parts by name; ``say(text)`` shows
            what is being done.
    """

    name: str
    settings: dict[str, Any]
    compute: Callable[[dict[str, Result], Callable[[str], None]], Result]


@dataclass
class Store:
    """Finished parts of a run, one JSON file each.

    A part is taken from an earlier run only with ``resume``, and only if its settings and the
    code fingerprint are the same.
    """

    folder: Path
    fingerprint: str
    resume: bool
    results: dict[str, Result] = field(default_factory=dict)

    def run(self, parts: Sequence[Part]) -> None:
        """Compute what is missing, in order, under a progress bar."""
        with tqdm(total=len(parts), unit="part", dynamic_ncols=True) as bar:
            for part in parts:
                bar.set_description(part.name)
                kept = self._read(part) if self.resume else None
                if kept is None:
                    say = bar.set_postfix_str
                    kept = {
                        "settings": to_plain(part.settings),
                        "fingerprint": self.fingerprint,
                        "result": to_plain(part.compute(self.results, say)),
                    }
                    write_json_atomic(self._path(part), kept)
                    say("")
                self.results[part.name] = kept["result"]
                bar.update()

    def _path(self, part: Part) -> Path:
        return self.folder / f"{part.name.replace('/', '__')}.json"

    def _read(self, part: Part) -> dict[str, Any] | None:
        try:
            kept = json.loads(self._path(part).read_text(encoding="utf-8"))
        except (FileNotFoundError, json.JSONDecodeError):
            return None
        same = (kept["settings"], kept["fingerprint"]) == (
            to_plain(part.settings),
            self.fingerprint,
        )
        if not same:
            tqdm.write(f"{part.name}: measured with other code or settings before, measuring anew")
        return kept if same else None


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


def available_memory() -> int:
    """Memory that can be had without swapping [byte]."""
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemAvailable:"):
            return 1024 * int(line.split()[1])
    return 4 << 30
