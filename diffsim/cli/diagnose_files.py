"""The files of an explanation: which there are, which are lacking, and why."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from diffsim.identify.model_file import MODEL_FILE

INPUTS_FILE, REPORT_FILE = "inputs.json", "report.json"
PAGE_FILE, RECORDING_FILE = "report.html", "runs.rrd"
NEEDS = {PAGE_FILE: "matplotlib", RECORDING_FILE: "rerun"}
"""Packages of the ``viz`` extra that pictures need; results need none."""


def lacking(out: Path, before: Mapping[str, Any] | None) -> list[str]:
    """Files that an explanation should have and has not: a run is finished when all are there.

    Args:
        out: Folder of the explanation.
        before: Content of its ``inputs.json``, which is written last; None: there is none.

    Returns:
        Names of files. A picture that could not be drawn counts once its package is installed.
    """
    if before is None:
        return [INPUTS_FILE]
    undrawn = before.get("not_drawn", ())
    return [
        name
        for name in (REPORT_FILE, MODEL_FILE, PAGE_FILE, RECORDING_FILE)
        if not (out / name).is_file() and not (name in undrawn and find_spec(NEEDS[name]) is None)
    ]


def is_drawn(write: Callable[[], Path]) -> bool:
    """Whether it was written: pictures need packages of the ``viz`` extra; results do not."""
    try:
        print(f"wrote {write()}")
    except ImportError as error:
        print(f"not drawn: {error}")
        return False
    return True
