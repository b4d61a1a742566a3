"""Tables of an unknown folder and of the folders in it, in whatever format."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from diffsim.data.formats import SUFFIXES, json_records, lerobot, parts_of
from diffsim.data.names import may_be_time
from diffsim.data.run_plan import split_numbers
from diffsim.data.side_by_side import runs_beside
from diffsim.data.table import Table
from diffsim.data.table_guess import TABLES, TIME, TableLayout, column_of, layout_of

JSON = (".json", ".jsonl")
LOGS = (".ulg", ".mcap", ".bag", ".db3")
BAG = "metadata.yaml"  # beside the files of a ROS 2 bag
DEEPEST = 5  # folders in folders that are looked into


@dataclass(frozen=True, eq=False)
class FoundTable:
    """A table of a folder."""

    folder: Path  # folder that is looked at
    path: Path  # file that holds the table
    part: str  # its part of the file; empty: the file is one table
    layout: TableLayout  # what each of its columns seems to be
    num_parts: int = 1  # tables in the file
    is_log: bool = False  # whether these are topics of messages, in a file of JSON

    @property
    def reference(self) -> str:
        """How a study names it."""
        file = self.path.relative_to(self.folder).as_posix()
        return f"{file}#{self.part}" if self.part and self.num_parts > 1 else file

    @property
    def name(self) -> str:
        """What its run may be called: the file, or the folder that is the bag."""
        several = self.num_parts > 1 and not self.is_topic
        return f"{self.stem}_{self.part.replace('/', '_')}" if several else self.stem

    @property
    def is_bag(self) -> bool:
        """Whether its folder is the recording."""
        return self.is_topic and (self.path.parent / BAG).is_file()

    @property
    def stem(self) -> str:
        """Name of its file, or of the folder that is the bag."""
        return self.path.parent.name if self.is_bag else self.path.stem

    @property
    def level(self) -> int:
        """How many folders deep it lies."""
        return len(self.path.relative_to(self.folder).parts) - 1 - self.is_bag

    @property
    def is_topic(self) -> bool:
        """Whether the other tables of its file were recorded at the same time."""
        return self.path.suffix.lower() in LOGS or self.is_log

    @property
    def has_clock(self) -> bool:
        """Whether a column, or a file of one column without a header, is called a clock."""
        if not self.layout.has_names and len(self.layout.columns) == 1:
            return bool(TIME.match(self.path.stem))
        return any(TIME.match(c.base) and may_be_time(c) for c in self.layout.columns)

    def size(self) -> int:
        """How much it holds."""
        return self.path.stat().st_size if self.num_parts == 1 else len(self.table) * self.width

    @property
    def width(self) -> int:
        """Number of its columns."""
        return len(self.layout.columns)

    @cached_property
    def table(self) -> Table:
        """The table itself.

        Raises:
            ValueError: it cannot be read.
        """
        if self.path.suffix.lower() in SUFFIXES:
            return Table(self.folder / self.reference, "run")
        head, first = self.layout.header_line, self.layout.first_line
        names = () if head else tuple(c.name for c in self.layout.columns)
        path = self.folder / self.reference
        return Table(path, "run", header_line=head, first_line=first, columns=names)

    @cached_property
    def error(self) -> ValueError | None:
        """Why it cannot be read; None: it can, as those of containers were when they were found."""
        if self.path.suffix.lower() in SUFFIXES:
            return None
        try:
            len(self.table)
        except ValueError as error:
            return error
        return None


def find_tables(folder: Path, said: list[str]) -> Iterator[FoundTable]:
    """Tables of a folder and of the folders in it, by name; of a dataset of LeRobot its own.

    Args:
        said: Sentences on what could not be read; more are added.
    """
    files = lerobot.tables_of(folder) or files_below(folder)
    for path in sorted(files, key=lambda p: split_numbers(p.as_posix())):
        suffix = path.suffix.lower()
        if not _is_text(path):
            said.append(f"not read: {path.name!a}: no name of UTF-8 text; rename it")
        elif suffix in TABLES and (layout := layout_of(path)):
            yield from _runs_of(folder, path, layout)
        elif suffix in SUFFIXES:
            try:
                yield from _parts(folder, path)
            except (ImportError, ValueError) as error:
                said.append(f"not read: {error}")


def _runs_of(folder: Path, path: Path, layout: TableLayout) -> Iterator[FoundTable]:
    """The table of a file, or each of the runs that stand side by side in it."""
    runs = runs_beside([c.name for c in layout.columns]) if layout.header_line else {}
    whole = {c.name: c for c in layout.columns}
    for label, names in runs.items():
        pairs = ((column_of(name), whole[own]) for name, own in names.items())
        columns = (c if c.unit else replace(c, unit=of.unit, is_said=of.is_said) for c, of in pairs)
        yield FoundTable(folder, path, label, replace(layout, columns=tuple(columns)), len(runs))
    if not runs:
        yield FoundTable(folder, path, "", layout)


def _is_text(path: Path) -> bool:
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True


def files_below(folder: Path, depth: int = DEEPEST) -> Iterator[Path]:
    """Files of a folder and of those in it, so many deep; no hidden folders, no links."""
    for path in folder.iterdir():
        if path.is_file():
            yield path
        elif depth and path.is_dir() and not path.is_symlink() and path.name[0] not in "._":
            yield from files_below(path, depth - 1)


def _parts(folder: Path, path: Path) -> Iterator[FoundTable]:
    parts = parts_of(path)
    is_log = len(parts) > 1 and path.suffix.lower() in JSON and json_records.is_log(path)
    for part in parts:
        bare = FoundTable(folder, path, part, TableLayout(1, 2, ()), len(parts))
        layout = TableLayout(1, 2, tuple(column_of(name) for name in bare.table.header))
        yield FoundTable(folder, path, part, layout, len(parts), is_log)
