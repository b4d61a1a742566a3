"""Worker processes of this machine, of which one that dies costs only the call it was at."""

from __future__ import annotations

import multiprocessing
import pickle
import signal
import sys
import threading
import traceback
import weakref
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any

from diffsim.core.errors import DiffsimError

GRACE_S = 5.0  # for a worker that was asked to end, before it is killed


class LostWorkerError(BrokenExecutor, DiffsimError):
    """A worker died during a call: killed, out of memory, or crashed."""


class RemoteTraceback(Exception):
    """The traceback in the worker, as the cause of an error that a call raised there."""


class Worker:
    """A process that runs one call after another.

    It is forked from a server that has imported the first call's module and has done nothing else
    (where the system has such servers, else it starts afresh). It uses one thread of PyTorch,
    leaves Ctrl-C to its parent, and ends with it.

    Args:
        module: Module that the server imports, for a quick start.
    """

    def __init__(self, module: str):
        here = "forkserver" in multiprocessing.get_all_start_methods()
        context = multiprocessing.get_context("forkserver" if here else "spawn")
        if here:
            context.set_forkserver_preload([module])
        self._pipe, there = context.Pipe()
        self._ending = threading.Lock()
        self.process = context.Process(target=_serve, args=(there,))  # type: ignore[attr-defined]
        self.process.start()
        there.close()
        # a closed pipe ends the worker: when this object or its process goes, however it goes
        self._close = weakref.finalize(self, self._pipe.close)

    def call(
        self, function: Callable[..., Any], /, *args: Any, timeout: float | None = None
    ) -> Any:
        """The value of ``function(*args)`` in the worker.

        Raises:
            LostWorkerError: the worker died.
            TimeoutError: no answer within ``timeout`` [s]; end the worker, it is still busy.
            Exception: what the function raised there, its traceback as the cause.
        """
        sent = pickle.dumps((function, args))  # not the pipe's own: that shares tensors' memory
        try:
            self._pipe.send_bytes(sent)
            if not self._pipe.poll(timeout):
                raise TimeoutError(f"not done within {timeout:.0f} s")
            good, value = self._pipe.recv()
        except (EOFError, ConnectionError) as error:
            with self._ending:
                self.process.join()
            raise LostWorkerError(
                f"died with exit code {self.process.exitcode} (-9: most likely out of memory)"
            ) from error
        if good:
            return value
        failure, text = value
        raise failure from RemoteTraceback(f"\n{text}")

    def end(self, *, at_once: bool = False) -> None:
        """End the process; a call that runs is interrupted, as Ctrl-C would."""
        with self._ending:
            self.process.kill() if at_once else self.process.terminate()
            self.process.join(GRACE_S)
            if self.process.is_alive():
                self.process.kill()
                self.process.join()
        self._close()


def _serve(pipe: Connection) -> None:
    """Answer calls until the parent closes the pipe or sends SIGTERM."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is told, and ends this process
    signal.signal(signal.SIGTERM, _interrupt_once)  # so that calls clean up
    try:
        while True:
            pipe.send_bytes(_outcome(pipe.recv_bytes()))
    except (EOFError, ConnectionError, KeyboardInterrupt):
        return
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)


def _interrupt_once(number: int, frame: object) -> None:
    """Interrupt what runs; a process that ends already is not disturbed by a second signal."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise KeyboardInterrupt


def _outcome(sent: bytes) -> bytes:
    """What is sent back: (True, value), or (False, (error, traceback))."""
    try:
        function, args = pickle.loads(sent)  # may not be importable here
        return pickle.dumps((True, one_thread(function, *args)))
    except Exception as error:  # of the call, or a value that cannot be sent
        return pickle.dumps((False, (_sendable(error), traceback.format_exc())))


def _sendable(error: Exception) -> Exception:
    """The error itself where it survives being sent, else one that says the same."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # whatever keeps it from being sent
        return DiffsimError(f"{type(error).__name__}: {error}")
    return error


def one_thread(function: Callable[..., Any], /, *args: Any) -> Any:
    """``function(*args)`` with one thread of PyTorch, where that is loaded.

    Workers share a machine; and the same number everywhere makes the same bits everywhere.
    """
    torch = sys.modules.get("torch")
    if torch is None or torch.get_num_threads() == 1:
        return function(*args)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return function(*args)
    finally:
        torch.set_num_threads(before)


def _module_of(function: Callable[..., Any], args: tuple[Any, ...]) -> str:
    """Module of what is called in the end, behind ``one_thread`` and ``functools.partial``."""
    inner: Any = args[0] if function is one_thread else function
    return getattr(getattr(inner, "func", inner), "__module__", __name__)


class Processes(ThreadPoolExecutor):
    """An executor of worker processes, each with a thread here that waits for it.

    Other than with ``ProcessPoolExecutor`` a worker that dies takes no other with it: its call
    raises ``LostWorkerError``, the next call starts a new worker.

    Args:
        count: Number of workers.
    """

    def __init__(self, count: int):
        super().__init__(count, thread_name_prefix="worker")
        self._own = threading.local()
        self._living: set[Worker] = set()
        self._lock = threading.Lock()
        self._ended = False

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """See ``concurrent.futures.Executor``."""
        if kwargs:
            raise TypeError(f"calls take positional arguments only, got {', '.join(kwargs)}")
        return super().submit(self._call, function, args)

    def _call(self, function: Callable[..., Any], args: tuple[Any, ...]) -> Any:
        worker: Worker | None = getattr(self._own, "worker", None)
        if worker is None:
            worker = self._start(_module_of(function, args))
        try:
            return worker.call(function, *args)
        except LostWorkerError:
            self._own.worker = None
            with self._lock:
                self._living.discard(worker)
            worker.end()
            raise

    def _start(self, module: str) -> Worker:
        with self._lock:  # the server of forks is started by one thread alone
            if self._ended:
                raise LostWorkerError("the workers were ended")
            worker = self._own.worker = Worker(module)
            self._living.add(worker)
        return worker

    def end(self) -> None:
        """Interrupt what runs, start nothing more, and end the workers."""
        with self._lock:
            self._ended = True
            living = tuple(self._living)
        self.shutdown(wait=False, cancel_futures=True)
        for worker in living:
            worker.process.terminate()
        for worker in living:
            worker.end()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """See ``concurrent.futures.Executor``."""
        super().shutdown(wait=wait, cancel_futures=cancel_futures)
        if wait:
            with self._lock:
                living = tuple(self._living)
            for worker in living:
                worker.end()
