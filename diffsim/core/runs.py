"""Many independent runs, and their results: in order, kept one by one, whoever computes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    wait,
)
from pathlib import Path
from typing import Any, TypeVar

from diffsim.core.errors import DiffsimError
from diffsim.core.files import digest_of, read_kept, to_plain, write_json_atomic
from diffsim.core.interrupts import postponed_interrupts
from diffsim.core.workers import one_thread

Item = TypeVar("Item")
Result = TypeVar("Result")
ATTEMPTS = 3  # of a run whose worker dies; dask's own scheduler counts alike


class LostRunError(DiffsimError):
    """A run ended with its worker every time that it was tried."""


def run_each(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    executor: Executor | None = None,
    *,
    done: Callable[[int, Result], None] | None = None,
    attempts: int = ATTEMPTS,
) -> list[Result]:
    """``function`` of every item, wherever it is computed.

    Results do not depend on the executor, the number of workers, or who is first. A run whose
    worker died is computed again. After Ctrl-C, or an error of a run, what has not begun is dropped
    and what has ended is given to ``done``.

    Args:
        function: Function of one item. With an executor it, the items and the results must be
            picklable: a function of a module, or a ``functools.partial`` of one.
        items: Items, each independent of the others.
        executor: Executor of the runs; None: one after another in this process.
        done: Called here, with index and result, as each run ends: the place to keep it.
        attempts: How often a run may lose its worker.

    Returns:
        The results, in the order of the items.

    Raises:
        LostRunError: a run lost its worker too often, or the executor does not go on without it.
        Exception: what a run raised.
    """
    keep = done or (lambda index, result: None)
    if executor is None:
        results: dict[int, Result] = {}
        for k, item in enumerate(items):
            results[k] = function(item)
            with postponed_interrupts():
                keep(k, results[k])
        return [results[k] for k in range(len(items))]
    return _Round(function, items, executor, keep, attempts).run()


class _Round:
    """The runs of one ``run_each`` that are with an executor."""

    def __init__(
        self,
        function: Callable[[Any], Any],
        items: Sequence[Any],
        executor: Executor,
        keep: Callable[[int, Any], None],
        attempts: int,
    ):
        self.function, self.items, self.executor = function, items, executor
        self.keep, self.attempts = keep, attempts
        self.results: dict[int, Any] = {}
        self.tries = [0] * len(items)
        self.out: dict[Future[Any], int] = {}

    def run(self) -> list[Any]:
        try:
            for k in range(len(self.items)):
                self._send(k)
            while self.out:
                ended, _ = wait(self.out, return_when=FIRST_COMPLETED)
                for future in sorted(ended, key=self.out.__getitem__):
                    with postponed_interrupts():  # a result is kept whole, or asked for again
                        self._take(future)
        except BaseException:
            for future in self.out:
                future.cancel()
            self._take_what_ended()
            raise
        return [self.results[k] for k in range(len(self.items))]

    def _send(self, k: int) -> None:
        self.tries[k] += 1
        try:
            future = self.executor.submit(one_thread, self.function, self.items[k])
        except BrokenExecutor as error:
            raise LostRunError(
                f"a worker died and its {type(self.executor).__name__} does not go on without it; "
                "runs that had ended are kept; use an executor whose workers die alone, such as "
                "--executor processes:N or dask"
            ) from error
        self.out[future] = k

    def _take(self, future: Future[Any]) -> None:
        k = self.out.pop(future)
        try:
            result = future.result()
        except BrokenExecutor as error:
            if self.tries[k] >= self.attempts:
                raise LostRunError(
                    f"run {k + 1} of {len(self.items)} lost its worker {self.tries[k]} times: "
                    f"{error}"
                ) from error
            self._send(k)
            return
        except CancelledError as error:  # such as a cluster that went away
            raise LostRunError(
                f"run {k + 1} of {len(self.items)} was cancelled by its executor; runs that had "
                "ended are kept"
            ) from error
        self.results[k] = result
        self.keep(k, result)

    def _take_what_ended(self) -> None:
        """Keep what ended besides the run that failed; failures after the first say no more."""
        for future, k in self.out.items():
            if future.done() and not future.cancelled() and future.exception() is None:
                self.keep(k, future.result())


def run_kept(
    function: Callable[[Item], Result],
    items: Mapping[str, Item],
    folder: str | Path,
    executor: Executor | None = None,
    *,
    done: Callable[[str, Result], None] | None = None,
) -> dict[str, Result]:
    """``run_each`` of named items, each result in a file of its own: a second call goes on.

    Args:
        function: Function of one item, whose result JSON can hold.
        items: Items by name, in types that JSON has; a file made from another item is made anew.
        folder: Folder of ``NAME.json``.
        executor: Executor of the runs; None: this process.
        done: Called as each run ends, and for those that are on file.

    Returns:
        The results as their files hold them, by name.
    """
    folder = Path(folder)
    found: dict[str, Result] = {}
    say = done or (lambda name, result: None)
    for name, item in items.items():
        kept = read_kept(folder / f"{name}.json")
        if kept is not None and kept.get("of") == digest_of(item):
            found[name] = kept["result"]
            say(name, found[name])
    missing = [name for name in items if name not in found]

    def keep(k: int, result: Result) -> None:
        name = missing[k]
        plain = to_plain(result)
        write_json_atomic(folder / f"{name}.json", {"of": digest_of(items[name]), "result": plain})
        found[name] = plain
        say(name, plain)

    run_each(function, [items[name] for name in missing], executor, done=keep)
    return {name: found[name] for name in items}
