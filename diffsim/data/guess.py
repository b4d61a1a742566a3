"""What a folder seems to hold, as rules fill it in one after the other."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.core.arrays import Array, IntArray
from diffsim.core.figures import list_first
from diffsim.data.clock_guess import seconds_of
from diffsim.data.folder_tables import FoundTable
from diffsim.data.joined_files import Kind
from diffsim.data.table import Table
from diffsim.data.table_guess import Column

PIECES = 6  # that one long run is cut into


@dataclass(eq=False)
class GuessedColumn:
    """A column of the runs' files and what it seems to be."""

    column: Column  # as its header states it
    place: int = 0  # which of a run's files has it, from 0
    tag: str = ""  # word by which the names of these files differ from those of others
    role: str = ""  # clock, split, text, fact, idle, command or channel; empty: not yet known
    why: str = ""  # why it looks commanded
    name: str = ""  # name of the channel or command
    unit: str = "-"  # unit, - where none is stated
    sd: float | None = None  # noise of a channel; None: none was seen
    # lower, upper: ends of what was seen of a command
    lower: float | None = None
    upper: float | None = None
    is_measured: bool = False  # whether a controller gave it out
    before: float | None = None  # what was commanded before runs begin; None: nothing tells it
    fill: str = ""  # how a command goes on between samples of its own file


@dataclass(eq=False)
class GuessedRun:
    """Files, or rows of one, that look like one run."""

    name: str
    files: tuple[str, ...]
    tables: tuple[Table, ...]
    rows: IntArray
    value: str | None = None
    use: str = "fit"
    repeat_of: str | None = None
    setup: dict[str, Any] = field(default_factory=dict)
    time: dict[str, Any] | None = None  # its clock, if another than that of the first run

    def numbers(self, of: GuessedColumn) -> Array:
        """Samples of a column on its own file's clock, (num_samples,)."""
        values = self.tables[of.place].numbers(of.column.name)
        return values if of.place else values[self.rows]

    def texts(self, of: GuessedColumn) -> list[str]:
        """Cells of a column."""
        cells = self.tables[of.place].texts(of.column.name)
        return cells if of.place else [cells[i] for i in self.rows]


@dataclass(eq=False)
class Guess:
    """What a folder seems to hold."""

    folder: Path
    # tables of each file that are asked for, the record first; empty: as they look
    parts: Sequence[str] = ()
    found: list[FoundTable] = field(default_factory=list)  # tables that are looked at
    kinds: list[Kind] = field(default_factory=list)  # files of a run, the record first, run by run
    names: tuple[str, ...] = ()  # names of the runs
    columns: list[GuessedColumn] = field(default_factory=list)  # columns of the files of a run
    # keys of ``time``, of each clock where a run's files have several
    time: list[dict[str, Any]] = field(default_factory=list)
    # keys of ``stamps`` that mend the clock of all runs
    stamps: dict[str, str] = field(default_factory=dict)
    # what is done with equal stamps of all runs; None: nothing, there are none
    duplicates: str | None = None
    # whether the clock counts from long ago, so that runs should start at 0 s
    is_late: bool = False
    # runs, one for each file or value of ``split``
    runs: list[GuessedRun] = field(default_factory=list)
    split: tuple[Column, ...] = ()  # columns whose values are runs; empty: each file is one
    every: int = 1  # each n-th sample is enough
    beside: list[Path] = field(default_factory=list)  # files that are no tables and hold no facts
    said: list[str] = field(default_factory=list)  # what was guessed, a sentence each
    todo: list[str] = field(default_factory=list)  # what the user must say, a sentence each

    def those(self, role: str) -> list[GuessedColumn]:
        """Columns of a role; of "": those whose role is not known yet."""
        return [c for c in self.columns if c.role == role]

    def samples(self, of: GuessedColumn) -> list[Array]:
        """Samples of a column in each run, (num_samples,) each."""
        return [run.numbers(of) for run in self.runs]

    def pieces(self, of: GuessedColumn) -> list[Array]:
        """The same of each run as the study will have it: one long run is cut."""
        return self._cut(self.samples(of))

    def seconds(self, of: GuessedColumn) -> list[Array]:
        """Clock of a column's pieces, (num_samples,) each [s]."""
        time = self.time[min(of.place, len(self.time) - 1)]
        whole = [seconds_of(run.tables[of.place], time) for run in self.runs]
        if not of.place:
            whole = [seconds[run.rows] for seconds, run in zip(whole, self.runs, strict=True)]
        return self._cut(whole)

    def _cut(self, whole: list[Array]) -> list[Array]:
        if len(whole) != 1 or self.split:
            return whole
        edges = np.linspace(0, len(whole[0]), PIECES + 1).round().astype(int)
        return np.split(whole[0], edges[1:-1])


def listed(what: str, names: Iterable[str], most: int = 10) -> list[str]:
    """A sentence on names, if there are any."""
    names = list(names)
    return [f"{what}: {list_first(names, most)}"] if names else []
