"""How the commands of the laboratories end: what went wrong in a line, and how to go on."""

from __future__ import annotations

import sys
from collections.abc import Callable

from diffsim.core.errors import DiffsimError


def ended(work: Callable[[], None], again: str, *, debug: bool = False) -> int:
    """Do the work of a command that keeps what it finishes.

    Args:
        work: All of it.
        again: Command that goes on after an interruption.
        debug: Whether an error shows its traceback.

    Returns:
        Exit status: 0, 2 after an error, 130 after Ctrl-C.
    """
    try:
        work()
        return 0
    except KeyboardInterrupt:
        print(f"\ninterrupted; what was finished is kept, go on with: {again}", file=sys.stderr)
        return 130
    except (DiffsimError, ValueError, OSError, ImportError) as error:
        if debug:
            raise
        print(f"{type(error).__name__}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
