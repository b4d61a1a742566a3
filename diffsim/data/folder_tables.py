"""Tables of an unknown folder, in whatever format: which of them are the runs.

Files of several instruments, such as run1_mocap.csv and run1_imu.csv, are one run. In HDF5 and
MAT files with several tables of the same columns each is a run. In logs (ULog, MCAP, rosbags) a
table is a topic: one is the record, and another may hold what was commanded.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.core.check import did_you_mean
from diffsim.data.clock_guess import TIME
from diffsim.data.formats import SUFFIXES, lerobot, parts_of
from diffsim.data.log_columns import BESIDE, COMMAND, DRIVES, log_column
from diffsim.data.paired_files import clocks_of, joined, joined_layout, paired, share_columns
from diffsim.data.runs_guess import say
from diffsim.data.table import Table
from diffsim.data.table_guess import TableLayout, column_of, layout_of, tables_in

LOGS = (".ulg", ".mcap", ".bag", ".db3")
BAG = "metadata.yaml"
OTHERS = 12  # topics that a sentence names
_STATE = re.compile(
    r"odom|pose|position|joint_?states|(^|[/_])states?($|[/_.])|attitude|mocap", re.I
)


@dataclass(frozen=True, eq=False)
class FoundTable:
    """A table of a folder.

    Attributes:
        folder: Folder that is looked at.
        path: File that holds the table.
        part: Its part of the file; empty: the file is one table.
        layout: What each of its columns seems to be.
        num_parts: Tables in the file.
    """

    folder: Path
    path: Path
    part: str
    layout: TableLayout
    num_parts: int = 1

    @property
    def reference(self) -> str:
        """How a study names it."""
        file = self.path.relative_to(self.folder).as_posix()
        return f"{file}#{self.part}" if self.part else file

    @property
    def name(self) -> str:
        """What its run may be called: the file, or the folder that is the bag."""
        stem = self.path.parent.name if (self.path.parent / BAG).is_file() else self.path.stem
        several = self.num_parts > 1 and not self.is_topic
        return f"{stem}_{self.part.replace('/', '_')}" if several else stem

    @property
    def is_topic(self) -> bool:
        """Whether the other tables of its file were recorded at the same time."""
        return self.path.suffix.lower() in LOGS

    def size(self) -> int:
        """How much it holds."""
        if not self.part:
            return self.path.stat().st_size
        return len(self.table()) * len(self.layout.columns)

    def table(self) -> Table:
        """The table itself."""
        if self.path.suffix.lower() not in SUFFIXES:
            head, first = self.layout.header_line, self.layout.first_line
            return Table(self.path, "run", header_line=head, first_line=first)
        return Table(self.folder / self.reference, "run")


@dataclass(frozen=True, eq=False)
class FolderRecording:
    """A run of an unknown folder, before its columns are sorted out.

    Attributes:
        name: What the run may be called.
        file: How a study names its table.
        further: Tables that are read at its clock.
        table: Its columns, those of further tables at its clock.
    """

    name: str
    file: str
    further: tuple[str, ...]
    table: Table


def recordings_in(
    folder: Path, said: list[str], parts: Sequence[str] = ()
) -> tuple[TableLayout, list[FolderRecording], list[dict[str, Any]]]:
    """Tables with the same columns: those that most files, then most bytes, have.

    Files of other columns that share the names of these, but for a word, are read with them.

    Args:
        folder: Folder of the files.
        said: Sentences on what was guessed; more are added.
        parts: Tables of each file that are used, the record first; empty: as they look.

    Returns:
        Columns, runs, and the clock of each file of a run where it has several: keys of ``time``.

    Raises:
        ValueError: no table that looks like a recording, or no such part.
    """
    found = list(_find_tables(folder, said))
    if parts:
        known = dict.fromkeys(f.part for f in found if f.part)
        for part in parts:
            if part not in known:
                close = did_you_mean(part, list(known))
                raise ValueError(f"--part: no table {part!r}{close}; known: {', '.join(known)}")
    families: dict[tuple[Any, ...], list[FoundTable]] = {}
    for one in found:
        if parts and one.part and one.part != parts[0]:
            continue
        names = tuple(c.name for c in one.layout.columns)
        lines = (one.layout.header_line, one.layout.first_line)
        families.setdefault((*lines, names, one.part if one.is_topic else ""), []).append(one)
    if not families:
        raise ValueError(
            f"{folder} has no table with a header line and rows of numbers; expected files such as "
            "run_1.csv with columns divided by comma, semicolon or tab, or one of "
            f"{', '.join(SUFFIXES)}"
        )
    timed = {k: v for k, v in families.items() if any(TIME.match(_strip_unit(n)) for n in k[2])}
    best = max((timed or families).values(), key=_rank)
    kinds = [] if best[0].part else _kinds(best, families.values())
    times = _times(kinds)
    taken = {f.path for kind in (kinds if times else [best]) for f in kind}
    others = dict.fromkeys(f.path.name for f in found if f.path not in taken)
    say(said, "files with other columns, not used", list(others))
    beside = [f for f in found if f.path in taken and f not in best and not f.is_topic]
    say(said, "tables with other columns, not used", [f.reference for f in beside], OTHERS)
    if times:
        return *_of_kinds(kinds, times, said), times
    further = _choose_further(found, best, parts, said)
    runs = [_recording(one, further, found) for one in best]
    said += dict.fromkeys(sentence for run in runs for sentence in run.table.left_out)
    layout = best[0].layout
    if best[0].is_topic:
        layout = _of_topics(runs[0].table, (best[0].part, *further), best[0], found, said)
    return layout, runs, []


def _kinds(
    best: Sequence[FoundTable], families: Iterable[Sequence[FoundTable]]
) -> list[list[FoundTable]]:
    """Files of several instruments, run by run: what sounds like the record of a motion first."""
    kinds, names = [list(best)], [one.path.stem for one in best]
    for family in families:
        one = family[0]
        alike = any(share_columns(one.layout, kind[0].layout) for kind in kinds)
        lines = (one.layout.header_line, one.layout.first_line)
        at = (best[0].layout.header_line, best[0].layout.first_line)  # one study states one
        if alike or one.part or lines != at:
            continue
        if found := paired(names, [f.path.stem for f in family]):
            kinds.append([family[k] for _, k in found.values()])
    return sorted(kinds, key=lambda kind: not _STATE.search(kind[0].path.stem))


def _times(kinds: Sequence[Sequence[FoundTable]]) -> list[dict[str, Any]]:
    """Clocks of the files of a run; empty where a run has one file, or they do not fit."""
    if len(kinds) < 2:
        return []
    layouts = [kind[0].layout for kind in kinds]
    return clocks_of(layouts, [[f.table() for f in kind] for kind in kinds]) or []


def _of_kinds(
    kinds: Sequence[Sequence[FoundTable]], times: Sequence[dict[str, Any]], said: list[str]
) -> tuple[TableLayout, list[FolderRecording]]:
    """Runs of several files each."""
    runs = []
    for files in zip(*kinds, strict=True):
        shared = paired([files[0].path.stem], [files[1].path.stem]) or {files[0].name: (0, 0)}
        table = joined([f.table() for f in files], times)
        first, *further = (f.reference for f in files)
        runs.append(FolderRecording(next(iter(shared)), first, tuple(further), table))
    one = " with ".join(f.path.name for f in next(zip(*kinds, strict=True)))
    said.append(f"runs: files that share a name are one, such as {one}, at the clock of the first")
    layouts, tables = [k[0].layout for k in kinds], [[f.table() for f in k] for k in kinds]
    return joined_layout(layouts, times, tables, runs[0].table.header), runs


def _of_topics(
    joined: Table,
    parts: Sequence[str],
    main: FoundTable,
    found: Sequence[FoundTable],
    said: list[str],
) -> TableLayout:
    """Columns of a log as conventions have them, each of the first topic that has it."""
    own = {f.part: {c.name for c in f.layout.columns} for f in found if f.path == main.path}
    columns, unused = [], []
    for name in joined.header:
        part = next(p for p in parts if name in own[p])
        column = log_column(name, part)
        (unused.append(name) if column is None else columns.append(column))
    say(said, "fields of topics, not used", unused)
    return TableLayout(1, 2, tuple(columns))


def _find_tables(folder: Path, said: list[str]) -> Iterator[FoundTable]:
    for path in tables_in(folder):
        if layout := layout_of(path):
            yield FoundTable(folder, path, "", layout)
    failed: list[str] = []
    bags = (p for p in folder.iterdir() if (p / BAG).is_file())  # of ROS 2: a folder each
    files = [*folder.iterdir(), *(file for bag in bags for file in bag.iterdir())]
    files += lerobot.tables_of(folder)
    for path in sorted(p for p in files if p.suffix.lower() in SUFFIXES and p.is_file()):
        try:
            parts = parts_of(path)
            for part in parts:
                header = FoundTable(folder, path, part, TableLayout(1, 2, ())).table().header
                layout = TableLayout(1, 2, tuple(column_of(name) for name in header))
                yield FoundTable(folder, path, part, layout, len(parts))
        except (ImportError, ValueError) as error:
            failed.append(str(error))
    said += [f"not read: {message}" for message in failed]


def _rank(family: Sequence[FoundTable]) -> tuple[int, bool, int]:
    """More runs first, then what sounds like a record, then what is larger."""
    looks = family[0].is_topic and bool(_STATE.search(family[0].part))
    return len(family), looks, sum(f.size() for f in family)


def _choose_further(
    found: Sequence[FoundTable], best: Sequence[FoundTable], parts: Sequence[str], said: list[str]
) -> tuple[str, ...]:
    """Topics that are read at the clock of the record: those that are asked for, else those
    that belong to it, and one that sounds commanded."""
    main = best[0]
    beside = [f for f in found if f.path == main.path and f.part != main.part]
    if not main.is_topic or not beside:
        return ()
    asked = tuple(parts[1:])
    if not parts:
        known = {f.part for f in beside}
        asked = tuple(part for part in BESIDE.get(main.part, ()) if part in known)
        commanded = [f for f in beside if COMMAND.search(f.part)]
        if commanded:
            best_of = max(commanded, key=lambda f: (bool(DRIVES.search(f.part)), f.size()))
            asked = (*asked, best_of.part)
    used = " and ".join((main.part, *asked))
    said.append(f"topics: {used}" + ("" if parts else "; --part TOPIC, repeated, uses others"))
    say(said, "other topics", [f.part for f in beside if f.part not in asked], OTHERS)
    return asked


def _recording(
    one: FoundTable, further: Sequence[str], found: Sequence[FoundTable]
) -> FolderRecording:
    table = one.table()
    if not further:
        return FolderRecording(one.name, one.reference, (), table)
    others = [f for part in further for f in found if (f.path, f.part) == (one.path, part)]
    references = tuple(f.reference for f in others)
    joined = _join_tables(table, [f.table() for f in others])
    return FolderRecording(one.name, one.reference, references, joined)


def _join_tables(main: Table, others: Sequence[Table]) -> Table:
    """Columns of all tables at the clock of the first, as a study reads them."""
    columns = main.columns()
    clock = main.numbers("time_s")
    for other in others:
        at = other.numbers("time_s")
        for name in other.header:
            if name not in columns and other.is_number[name]:
                columns[name] = np.interp(clock, at, other.numbers(name), np.nan, np.nan)
    return Table.of_columns(main.path, columns, main.left_out)


def _strip_unit(name: str) -> str:
    return column_of(name).base


__all__ = ["FolderRecording", "recordings_in"]
