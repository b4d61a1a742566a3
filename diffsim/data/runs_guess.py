"""Runs of an unknown folder: which repeat each other, which are kept back, what their names say."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.data.table import Table
from diffsim.data.table_guess import Column

_IN_NAME = re.compile(
    r"(?<![\d.])(\d+(?:p\d+)?)(mm|cm|g|kg|mbar|kPa|Pa|bar|mN|N|V|Hz|deg|rpm)(?![A-Za-z])"
)
_SAME = 0.02  # rms over range: commands of repeats agree to this


@dataclass
class GuessedQuantity:
    """A channel or command that is guessed."""

    name: str
    column: Column
    unit: str
    why: str
    sd: float | None = None
    lower: float | None = None
    upper: float | None = None
    is_measured: bool = False


@dataclass
class GuessedRun:
    """Rows of a file that look like one run."""

    name: str
    file: str
    table: Table
    rows: NDArray[np.int64]
    value: str | None = None
    use: str = "fit"
    repeat_of: str | None = None
    setup: dict[str, Any] = field(default_factory=dict)
    further: tuple[str, ...] = ()


def facts_of_name(file: str) -> dict[str, Any]:
    """Numbers with a unit in a file's name: step_100mbar.csv."""
    out: dict[str, Any] = {}
    for number, unit in _IN_NAME.findall(Path(file).stem):
        out[f"{unit}_in_name"] = {"value": float(number.replace("p", ".")), "unit": unit}
    return out


def find_repeats(
    runs: Sequence[GuessedRun],
    commands: Sequence[GuessedQuantity],
    facts: Sequence[Column],
    said: list[str],
) -> None:
    """Runs with the same facts and the same commands, sample by sample."""
    if not commands:
        return
    asked = [q for q in commands if not q.is_measured]
    found = []
    for i, run in enumerate(runs):
        for other in runs[:i]:
            alike = all(_constant(run, c) == _constant(other, c) for c in facts)
            if other.repeat_of is None and asked and alike and _same(run, other, asked):
                run.repeat_of = other.name
                found.append(f"{run.name} of {other.name}")
                break
    say(said, "repeats, by equal commands", found)


def _constant(run: GuessedRun, column: Column) -> str:
    return run.table.texts(column.name)[run.rows[0]]


def _same(run: GuessedRun, other: GuessedRun, commands: Sequence[GuessedQuantity]) -> bool:
    if run.setup != other.setup:
        return False
    for command in commands:
        a = run.table.numbers(command.column.name)[run.rows]
        b = other.table.numbers(command.column.name)[other.rows]
        n = min(len(a), len(b))
        if n < 0.8 * max(len(a), len(b)):
            return False
        apart = (a[:n] - b[:n])[np.isfinite(a[:n] - b[:n])]
        size = max(float(np.ptp(a[np.isfinite(a)])) if np.isfinite(a).any() else 0.0, 1e-300)
        if not len(apart) or float(np.sqrt(np.mean(apart**2))) > _SAME * size:
            return False
    return True


def give_uses(runs: Sequence[GuessedRun], said: list[str]) -> None:
    """Test runs: those of the last command; select runs where there are plenty."""
    groups = Counter(run.repeat_of or run.name for run in runs)
    names = list(groups)
    if len(names) < 3:
        if len(runs) > 1:
            last = next((r for r in reversed(runs) if groups[r.repeat_of or r.name] == 1), runs[-1])
            last.use = "test"
            said.append(f"uses: {last.name} is test")
        return
    # repeats tell the noise, which a fit needs: commands that were executed once are kept back
    single = [name for name in names if groups[name] == 1] or names
    chosen = {single[-1]: "test"}
    if len(names) > 5 and len(single) > 1:
        chosen[single[(len(single) - 1) // 2]] = "select"
    for run in runs:
        run.use = chosen.get(run.repeat_of or run.name, "fit")
    said.append(
        "uses: " + ", ".join(f"{run.name} is {run.use}" for run in runs if run.use != "fit")
    )


def say(said: list[str], what: str, names: Sequence[str], most: int = 10) -> None:
    """Add a sentence on names, if there are any."""
    if names:
        more = f" and {len(names) - most} more" if len(names) > most else ""
        said.append(f"{what}: {', '.join(names[:most])}{more}")
