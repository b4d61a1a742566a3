"""What the commands of the laboratories share: what a run has kept, and how it ends."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

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


def kept(folder: Path, plan: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Results of a run that were kept, those of other plans left out.

    Args:
        folder: Where ``run_kept`` keeps them.
        plan: Of the run: its seed, commit and effort.
    """
    rows = [json.loads(p.read_text(encoding="utf-8"))["result"] for p in folder.glob("*.json")]
    return [r for r in rows if all(r[k] == plan[k] for k in ("master", "commit", "effort"))]
