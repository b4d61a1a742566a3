"""Independent simulations side by side, with one progress bar and a clean stop.

Every job is single-threaded and owns its body, so results do not depend on the thread count.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from diffsim.core import show_progress

T = TypeVar("T")


class Stopped(Exception):
    """Raised inside jobs after an interruption, so that threads end soon."""


class Workers:
    """Runs jobs on threads; ``tick`` inside a job moves the bar and ends it when stopped.

    Args:
        threads: Jobs at a time.
        total_steps: Time steps planned, for the bar.
        quiet: No bar.
    """

    def __init__(self, threads: int, total_steps: int, *, quiet: bool = False):
        if threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        self.threads = threads
        self.bar = show_progress(
            total=total_steps, unit="step", desc="demo", disable=quiet, smoothing=0.1
        )
        self._stop, self._lock = threading.Event(), threading.Lock()
        self._planned, self._begun, self._stage = 0, 0, ""

    def stage(self, name: str, steps: int) -> None:
        """A new stage of ``steps`` planned steps begins; the bar catches up with the plan."""
        with self._lock:
            self.bar.update(self._planned - self.bar.n)
            self._begun = self._planned
            self._planned += steps
            self._stage = name
            self.bar.set_postfix_str(name)

    def note(self, doing: str, share: float) -> None:
        """What a stage without steps of its own is doing now, and which share of it is done."""
        with self._lock:
            done = self._begun + int(share * (self._planned - self._begun))
            self.bar.update(max(done - self.bar.n, 0))
            self.bar.set_postfix_str(f"{self._stage}: {doing}")

    def say(self, line: str) -> None:
        """A result, on its own line above the bar; nothing where there is no bar."""
        if not self.bar.disable:
            with self._lock:
                self.bar.write(line)

    def tick(self) -> None:
        """One step is done."""
        if self._stop.is_set():
            raise Stopped
        with self._lock:
            if self.bar.n < self._planned:
                self.bar.update()

    def run(self, jobs: Sequence[Callable[[], T]]) -> list[T]:
        """Results in the order of the jobs; the first failure, or Ctrl-C, ends all."""
        if self.threads == 1 or len(jobs) == 1:
            return [job() for job in jobs]
        with ThreadPoolExecutor(max_workers=self.threads) as pool:
            futures = [pool.submit(job) for job in jobs]
            try:
                return [future.result() for future in futures]
            except BaseException:
                self._stop.set()
                pool.shutdown(wait=True, cancel_futures=True)
                raise

    def close(self) -> None:
        """Fill and close the bar."""
        if not self._stop.is_set():
            self.stage("done", 0)
        self.bar.close()
