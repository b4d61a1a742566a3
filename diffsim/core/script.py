"""Imported first by scripts: Ctrl-C ends them with one line, also while the rest is imported.

PyTorch takes seconds to load, in which ``interruptible`` is not entered yet. A package that is
missing is named in one line too, with the command that installs it. What the scripts share can be
imported by all of them: ``examples.applications``, ``labs.loop``. Libraries do not import this
module: it changes how the process ends, and where modules are looked for.
"""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from types import TracebackType

from diffsim.core.interrupts import end_while_loading, interruptible
from diffsim.core.optional import advice, ask_for, present
from diffsim.core.paths import SCRIPTS

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
    own = ("", "diffsim", "examples", "labs", "rl")
    if not isinstance(error, ModuleNotFoundError) or top in own:
        return None
    return None if present(top) else f"{top} is not installed: {advice([top])}"


def _is_imported_by_a_script() -> bool:
    """Whether the process's own script imports this, not a test or a session that imports one."""
    frame = sys._getframe(1)
    while frame.f_back is not None and (
        frame.f_globals.get("__name__") == __name__
        or "importlib" in str(frame.f_globals.get("__name__"))
    ):
        frame = frame.f_back
    return frame.f_globals.get("__name__") == "__main__"


def _find_scripts() -> None:
    """Let a script import ``examples``, ``labs``, ``rl``; a user's own such names come first."""
    own = SCRIPTS in Path(sys.argv[0]).resolve().parents
    sys.path.insert(1 if own else len(sys.path), str(SCRIPTS))


sys.excepthook = _in_one_line
if _is_imported_by_a_script():
    _find_scripts()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not deaf to it
        signal.signal(signal.SIGINT, end_while_loading)

__all__ = ["ask_for", "interruptible"]
