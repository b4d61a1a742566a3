"""Where many independent runs are computed: here, in processes, or on a cluster.

Everything that consists of such runs takes a ``concurrent.futures.Executor``; its commands take
``--executor``, whose words ``open_executor`` understands.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from diffsim.core.optional import optional
from diffsim.core.workers import Processes

WORDS = "here, processes[:N], dask:ADDRESS, or MODULE:FUNCTION"


def num_processors() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def executor_word(text: str) -> str:
    """The word after ``--executor``, refused where it cannot mean anything.

    Raises:
        ValueError: it has none of the forms of ``WORDS``.
    """
    kind, colon, rest = text.partition(":")
    if kind == "processes":
        good = not colon or (rest.isdigit() and int(rest) > 0)
    elif kind == "here":
        good = not colon
    else:
        good = bool(kind and rest)
    if not good:
        hint = ", such as dask:tcp://10.0.0.7:8786 or dask:scheduler.json" if kind == "dask" else ""
        raise ValueError(f"executor must be {WORDS}{hint}; got {text!r}")
    return text


@contextmanager
def open_executor(word: str | None = None) -> Iterator[Executor | None]:
    """The executor that a word names; on leaving it is closed, on an error with what still runs.

    Args:
        word: "here" or None: none, one run after another in this process. "processes:N": so many
            worker processes of this machine, "processes": one per processor. "dask:ADDRESS": the
            cluster of that scheduler; a name that ends with .json is its file. "MODULE:FUNCTION":
            what an importable function returns, called without arguments, such as
            ``mpi4py.futures:MPIPoolExecutor``.

    Raises:
        ValueError: another word.
        ImportError: no such module, or dask's ``distributed`` is not installed.
        OSError: no scheduler answers.
        TypeError: the function returned no executor.
    """
    kind, _, rest = executor_word(word or "here").partition(":")
    if kind == "here":
        yield None
    elif kind == "processes":
        yield from _processes(int(rest) if rest else num_processors())
    elif kind == "dask":
        yield from _dask(rest)
    else:
        yield from _own(kind, rest)


def _processes(count: int) -> Iterator[Executor]:
    workers = Processes(count)
    try:
        yield workers
    except BaseException:
        workers.end()
        raise
    workers.shutdown()


def _dask(address: str) -> Iterator[Executor]:
    distributed = optional("distributed", purpose="--executor dask")
    where = {"scheduler_file": address} if address.endswith(".json") else {"address": address}
    with distributed.Client(**where, set_as_default=False) as client:
        yield client.get_executor()  # closing the client drops what has not begun


def _own(module: str, function: str) -> Iterator[Executor]:
    executor = getattr(importlib.import_module(module), function)()
    if not isinstance(executor, Executor):
        raise TypeError(
            f"{module}:{function} must return a concurrent.futures.Executor, got "
            f"{type(executor).__name__}"
        )
    try:
        yield executor
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        raise
    executor.shutdown()
