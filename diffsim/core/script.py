"""Imported first by scripts: Ctrl-C ends them with one line, also while the rest is imported.

PyTorch takes seconds to load, in which ``interruptible`` is not entered yet. A package that is
missing is named in one line too, with the command that installs it. Libraries do not import this
module: it changes how the process ends.
"""

from __future__ import annotations

import sys
from types import TracebackType

from diffsim.core.interrupts import interruptible
from diffsim.core.optional import advice, ask_for, present

_before = sys.excepthook


def _in_one_line(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    """Python's own words for all errors but an interruption and a package that is missing."""
    if issubclass(kind, KeyboardInterrupt):
        print("\ninterrupted", file=sys.stderr)  # Python now ends the process by the signal
    elif isinstance(error, ImportError) and (said := _missing(error)):
        print(said, file=sys.stderr)
    else:
        _before(kind, error, trace)


def _missing(error: ImportError) -> str | None:
    """What to install; None where that is not why an import failed."""
    if "pip install" in str(error):  # as diffsim's own messages say it
        return str(error)
    top = (error.name or "").partition(".")[0]
    if not isinstance(error, ModuleNotFoundError) or top in ("", "diffsim", "examples", "rl"):
        return None
    return None if present(top) else f"{top} is not installed: {advice([top])}"


sys.excepthook = _in_one_line

__all__ = ["ask_for", "interruptible"]
