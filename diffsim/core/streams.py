"""Standard streams of a process that was started without them, as by ``>&-``."""

from __future__ import annotations

import os
import sys


def open_standard_streams() -> None:
    """Let the null device stand for standard streams that are closed.

    Else Python has None in their place, and the first file that is opened takes their number: what
    a library prints would go into it.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
        if getattr(sys, name) is None:
            mode = "w" if number else "r"
            # open as long as the process lasts
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", closefd=False))
