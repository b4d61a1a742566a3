"""Processes that die while they write files: at a certain rename, before or after it."""

import os
from collections.abc import Callable
from typing import Any


class Killed(BaseException):
    """Stands for SIGKILL: no ``except Exception`` sees it."""


def killing_replace(last: int, *, before: bool) -> Callable[..., Any]:
    """An ``os.replace`` that dies.

    Args:
        last: Number of the call at which it dies, from 1.
        before: Die before the file is in its place, or after.
    """
    replace, calls = os.replace, 0

    def dying(source: Any, target: Any) -> None:
        nonlocal calls
        calls += 1
        if calls < last or not before:
            replace(source, target)
        if calls == last:
            raise Killed

    return dying
