"""Ctrl-C and SIGTERM: a script ends with one line and its own status, never with a traceback."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells count
INSTALLED = frozenset(("site-packages", "dist-packages"))  # folders of packages
SWALLOWING = ("torch", "trimesh")  # wherever they are installed


def terminate_as_interrupt() -> None:
    """Answer SIGTERM, as batch systems and services send it, as Ctrl-C is answered.

    Both are heard while PyTorch loads, too. Only the main thread may set signal handlers; elsewhere
    nothing is changed.
    """
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _interrupt)
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> None:
    """As Python answers Ctrl-C; while modules of packages run for the first time, some of which
    swallow all exceptions (PyTorch, trimesh), the process ends."""
    while frame is not None:
        package = str(frame.f_globals.get("__name__")).partition(".")[0]
        is_installed = package in SWALLOWING or not INSTALLED.isdisjoint(
            frame.f_code.co_filename.split(os.sep)
        )
        if frame.f_code.co_name == "<module>" and is_installed:
            end_while_loading(number, frame)
        frame = frame.f_back
    raise KeyboardInterrupt


def ending_at_once() -> None:
    """From here on a further Ctrl-C or SIGTERM ends the process without another word."""
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)


def end_while_loading(number: int, frame: object) -> None:
    """Handler of Ctrl-C while modules are imported: some swallow an exception or change it."""
    os.write(2, b"\ninterrupted\n")
    os._exit(EXIT_INTERRUPTED)


@contextmanager
def interruptible(hint: str = "") -> Iterator[None]:
    """The main part of a script: an interruption prints a line and exits with status 130.

    Args:
        hint: How to go on, printed after the word that it was interrupted.

    Raises:
        SystemExit: it was interrupted.
    """
    terminate_as_interrupt()
    if signal.getsignal(signal.SIGINT) is end_while_loading:  # all is loaded: work is kept now
        signal.signal(signal.SIGINT, _interrupt)
    with ending_in_one_line(hint):
        yield


@contextmanager
def ending_in_one_line(hint: str = "") -> Iterator[None]:
    """As ``interruptible``, but SIGTERM is left as it is: for what an import does."""
    try:
        yield
    except KeyboardInterrupt:
        ending_at_once()
        print(f"\ninterrupted{'; ' + hint if hint else ''}", file=sys.stderr)
        raise SystemExit(EXIT_INTERRUPTED) from None


@contextmanager
def postponed_interrupts() -> Iterator[None]:
    """Ctrl-C and SIGTERM within the block take effect at its end: what it does, it does whole."""
    if threading.current_thread() is not threading.main_thread():  # others are never interrupted
        yield
        return
    came: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {n: signal.signal(n, lambda number, frame: came.append(number)) for n in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])
