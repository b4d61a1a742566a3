"""Progress of long work on standard error: a bar on a terminal, now and then a line elsewhere.

A bar draws itself anew by carriage returns, thousands of them in the line of a log. What shows
progress opens it here and nowhere else, so that all commands keep to the same rule.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from tqdm import tqdm

PERIOD_S = 10.0  # between two lines, whichever bars they are of
IN_NOTEBOOK = "ipykernel"  # the module that runs a notebook's cells: a cell redraws a line
USUAL_COLUMNS = 80
STAGE_S = 2.0  # between two lines of what has no bar


class Pace:
    """Lets one line through per period, counted over all that share it.

    Args:
        period_s: Least time between two lines [s].
        clock: Time that only grows [s].
    """

    def __init__(self, period_s: float = PERIOD_S, clock: Callable[[], float] = time.monotonic):
        self.clock = clock
        self._period_s, self._next_s, self._lock = period_s, -float("inf"), threading.Lock()

    def take_turn(self) -> bool:
        """Whether a line is due; if so, the next one is due a period later."""
        with self._lock:
            is_due = self.clock() >= self._next_s
            if is_due:
                self.begin_anew()
            return is_due

    def begin_anew(self) -> None:
        """A line was printed, due or not."""
        self._next_s = self.clock() + self._period_s


_SHARED = Pace()


class ProgressLines:
    """Stands in for ``tqdm`` where there is no terminal: the first line, one per period, the last.

    Args:
        iterable: What to pass on, counted; None: ``update`` counts.
        desc: Text before the count.
        total: Largest count; None: the iterable's length, or not known.
        initial: Count at the start.
        unit: What is counted; "%": the count is a share; "it": no word for it.
        leave: Whether a line says the end.
        pace: Says when the next line is due.
    """

    disable = False  # as of a bar that is shown

    def __init__(
        self,
        iterable: Iterable[Any] | None = None,
        *,
        desc: str = "",
        total: int | None = None,
        initial: int = 0,
        unit: str = "it",
        leave: bool = True,
        pace: Pace = _SHARED,
    ):
        length = getattr(iterable, "__len__", None)
        self.iterable, self.n = iterable, initial
        self.total = length() if total is None and length is not None else total
        self._desc, self._initial, self._unit, self._leave = desc, initial, unit, leave
        self._pace, self._began_s, self._file = pace, pace.clock(), sys.stderr
        self._postfix = self._last = ""
        self._is_closed = False
        self.refresh()

    def __enter__(self) -> ProgressLines:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[Any]:
        with self:
            for item in self.iterable or ():
                yield item
                self.update()

    def update(self, n: int = 1) -> None:
        """Count ``n`` more."""
        self.n += n
        self.refresh()

    def set_description(self, desc: str) -> None:
        """Change the text before the count."""
        self._desc = desc
        self.refresh()

    def set_postfix_str(self, text: str) -> None:
        """Change the text at the end of the line."""
        self._postfix = text
        self.refresh()

    def set_postfix(self, *, refresh: bool = True, **values: Any) -> None:
        """Change the text at the end to names with values."""
        self._postfix = ", ".join(f"{name}={_in_short(value)}" for name, value in values.items())
        if refresh:
            self.refresh()

    def say(self, text: str) -> None:
        """Change the text at the end of the line, and print it, due or not: a stage begins."""
        self._postfix = text
        self._pace.begin_anew()
        self._print(str(self))

    def refresh(self) -> None:
        """Print a line if one is due."""
        if self._pace.take_turn():
            self._print(str(self))

    def write(self, line: str) -> None:
        """Print a line of its own on standard output, at once."""
        print(line, flush=True)

    def close(self) -> None:
        """Print the last line, unless this bar leaves none or has said the same."""
        if self._is_closed:
            return
        self._is_closed = True
        if self._leave and str(self) != self._last:
            self.say(self._postfix)

    def __str__(self) -> str:
        elapsed_s = self._pace.clock() - self._began_s
        said = [self._count(), f"{elapsed_s:.0f} s", self._rate(elapsed_s), self._postfix]
        head = f"{self._desc}: " if self._desc else ""
        return head + ", ".join(part for part in said if part)

    def _count(self) -> str:
        if self._unit == "%":
            return f"{self.n} %"
        word = "" if self._unit == "it" else f"{self._unit} "
        return f"{word}{self.n}" + ("" if self.total is None else f" of {self.total}")

    def _rate(self, elapsed_s: float) -> str:
        done = self.n - self._initial
        if self._unit == "%" or done <= 0 or elapsed_s <= 0:
            return ""
        rate = done / elapsed_s
        return f"{_in_short(rate)}/s" if rate >= 1.0 else f"{_in_short(1 / rate)} s each"

    def _print(self, line: str) -> None:
        sys.stdout.flush()  # where both go to one file, results stand before what came later
        print(line, file=self._file, flush=True)
        self._last = line


_hidden = False
_stages: Pace | None = None


def hide_progress(hidden: bool) -> None:
    """Show no progress of this process from now on, or show it again: ``--quiet``."""
    global _hidden, _stages
    _hidden, _stages = hidden, Pace(STAGE_S)
    _stages.begin_anew()


def say_stage(text: str) -> None:
    """A line on standard error with what a command is at, one in ``STAGE_S``; else nothing.

    Of a program that has not asked for progress (:func:`hide_progress`) nothing is said.
    """
    if not _hidden and _stages is not None and _stages.take_turn():
        print(f"{text} ...", file=sys.stderr, flush=True)


def show_progress(
    iterable: Iterable[Any] | None = None,
    *,
    desc: str = "",
    total: int | None = None,
    initial: int = 0,
    unit: str = "it",
    leave: bool = True,
    disable: bool = False,
    **look: Any,
) -> tqdm | ProgressLines:
    """A bar in a terminal or a notebook's cell, else lines; used as ``tqdm`` is.

    Args:
        iterable: See ``ProgressLines``, as for ``desc``, ``total``, ``initial`` and ``unit``.
        leave: Whether the bar stays, or a line says the end.
        disable: Whether to show nothing.
        **look: Options of ``tqdm`` that change how the bar on a terminal looks.
    """
    if disable or _hidden:
        return tqdm(iterable, disable=True)
    said: dict[str, Any] = {"desc": desc, "total": total, "initial": initial}
    said |= {"unit": unit, "leave": leave}
    if not (sys.stderr.isatty() or IN_NOTEBOOK in sys.modules):
        return ProgressLines(iterable, **said)
    look.setdefault("ncols", _columns())  # a line that is wrapped is drawn anew below itself
    if os.environ.get("NO_COLOR"):
        look["colour"] = None  # over TQDM_COLOUR
    return tqdm(iterable, **said, **look)


def _columns() -> int:
    """Width of the terminal; of one that does not say, as a notebook's, the usual one."""
    try:
        return os.get_terminal_size(sys.stderr.fileno()).columns or USUAL_COLUMNS
    except (OSError, ValueError):
        return USUAL_COLUMNS


def _in_short(value: Any) -> str:
    """Three digits of a number without an exponent where it is large; other things as they are."""
    if not isinstance(value, int | float):
        return str(value)
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
