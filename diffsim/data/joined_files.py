"""Files that recorded one run: what a controller wrote, and what a camera saw.

Their names share all but a word, or they lie in a folder each run has. Names of several runs differ
in a word, too; so files with the same columns are one run only where one was commanded and another
was not, or where their clocks show that they were written at the same time.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import yaml

from diffsim.data.clock_guess import guess_clock, is_late, seconds_of
from diffsim.data.folder_tables import FoundTable
from diffsim.data.names import IDLE, STATE, has_role, is_asked, may_be_time, unit_of_clock
from diffsim.data.table_guess import TIME, Column, column_of

_MARK = re.compile(r"[_\-. ]+")
_MEETS = 0.5  # of the shorter record: clocks of one run overlap by more
_MOST = 2.0 / 3.0  # of the runs have a file of each kind

Group: TypeAlias = tuple[Path, str]  # where it lies, and the name of the run
Way: TypeAlias = Callable[[FoundTable], tuple[Group, str]]


@dataclass(frozen=True, eq=False)
class Kind:
    """Files of one kind."""

    tag: str  # word by which their names differ from those of other kinds; empty: there are none
    files: tuple[FoundTable, ...]  # one of each run
    columns: tuple[Column, ...]
    time: Mapping[str, Any]  # keys of ``time``; empty: rows are those of the first kind

    @property
    def num_rows(self) -> int:
        """Rows in the first run."""
        return len(self.files[0].table)

    @property
    def has_sure_clock(self) -> bool:
        """Whether its clock is called so."""
        column = column_of(str(self.time.get("column", "")))
        return bool(TIME.match(column.base) or unit_of_clock(column.base))

    def span(self) -> tuple[float, float]:
        """First and last time of the first run [s]."""
        table = self.files[0].table
        is_date = self.time.get("unit") == "clock"
        seconds = table.dates(self.time["column"]) if is_date else seconds_of(table, self.time)
        return float(seconds[0]), float(seconds[-1])


def join_files(
    tables: Sequence[FoundTable], said: list[str]
) -> tuple[list[Kind], tuple[str, ...]] | None:
    """Kinds of files that are joined, the record first, and names of the runs.

    Args:
        said: Sentences on what was guessed; more are added.

    Returns:
        None where no files are of one run.
    """
    found = [one for way in _ways(tables) if (one := _kinds(tables, way)) is not None]
    for kinds, groups, num_lacking in sorted(found, key=lambda one: len(one[1]) == 1):
        is_lone = len(groups) == 1 and groups[0][1] == groups[0][0].name
        if not _are_of_one_run(kinds, is_lone=is_lone):
            if len(groups) > 1 and groups[0][1] == groups[0][0].name:
                unclear = list(map(_list_shown, kinds))
                said.append(
                    f"runs: {', '.join(unclear)} have the same columns and no name that says what "
                    f"was commanded; if they are of one run, write file: {_in_yaml(unclear)}, and "
                    "file: 2 of the columns of the second"
                )
            continue
        fitting = _fit_clocks(kinds)
        if isinstance(fitting, str):
            said.append(fitting)
            return None
        first = " with ".join(map(_list_shown, fitting))
        said.append(f"runs: files of one run are joined at the clock of the first, such as {first}")
        if num_lacking:
            said.append(f"runs: {num_lacking} that lack a file are not used")
        return fitting, names_of_runs(groups)
    return None


def _ways(tables: Sequence[FoundTable]) -> Iterator[Way]:
    """How names may be divided into a run and the word for a kind of file."""
    if all(one.num_parts > 1 for one in tables):
        yield _by_group
        return
    yield lambda one: ((one.path.parent, one.path.parent.name), one.path.stem)
    words = {one.path.stem: _MARK.split(one.path.stem) for one in tables}

    def cut(one: FoundTable, first: slice, rest: slice) -> tuple[Group, str]:
        own = words[one.path.stem]
        return (one.path.parent, "_".join(own[first])), "_".join(own[rest])

    for k in range(1, max(map(len, words.values()))):
        yield lambda one, k=k: cut(one, slice(k), slice(k, None))  # type: ignore[misc]
        yield lambda one, k=k: cut(one, slice(-k, None), slice(-k))  # type: ignore[misc]
    yield lambda one: ((one.path.parent.parent, one.path.stem), one.path.parent.name)


def _by_group(one: FoundTable) -> tuple[Group, str]:
    """Run and kind of a table of a file that holds several: run_1/pose."""
    run, _, kind = one.part.rpartition("/")
    return (one.path, run or one.path.stem), kind


def _kinds(tables: Sequence[FoundTable], way: Way) -> tuple[list[Kind], list[Group], int] | None:
    """Files by kind, run by run, and the number of runs that lack one."""
    by_tag: dict[str, dict[Group, FoundTable]] = {}
    for one in tables:
        group, tag = way(one)
        if group in by_tag.setdefault(tag, {}):
            return None
        by_tag[tag][group] = one
    groups = list(dict.fromkeys(group for by in by_tag.values() for group in by))
    # a number counts runs, a word tells kinds apart
    usual = {
        tag: _alike(by)
        for tag, by in by_tag.items()
        if not _MARK.sub("", tag).isdigit() and len(by) >= _MOST * len(groups)
    }
    whole = [group for group in groups if all(group in by for by in usual.values())]
    if len(usual) < 2 or not whole:
        return None
    tags = dict(zip(usual, _shorten_names(list(usual)), strict=True))
    kinds = [_kind(tags[tag], [by[group] for group in whole]) for tag, by in usual.items()]
    return kinds, whole, len(groups) - len(whole)


def _alike(by_group: Mapping[Group, FoundTable]) -> dict[Group, FoundTable]:
    """Files with the columns that most have."""
    usual = Counter(one.layout for one in by_group.values()).most_common(1)[0][0]
    return {group: one for group, one in by_group.items() if one.layout == usual}


def _shorten_names(tags: list[str]) -> list[str]:
    """Tags without the words that all begin or end with."""
    words = [_MARK.split(tag) for tag in tags]
    for at in (0, -1):
        while all(len(own) > 1 for own in words) and len({own[at] for own in words}) == 1:
            words = [own[1:] if at == 0 else own[:-1] for own in words]
    return ["_".join(own) for own in words]


def _kind(tag: str, files: Sequence[FoundTable]) -> Kind:
    """A kind of file; columns without a header are called by its tag."""
    layout = files[0].layout
    if not layout.has_names:
        word = column_of(tag or "column").base
        count = len(layout.columns)
        names = [word] if count == 1 else [f"{word}_{k}" for k in range(1, 1 + count)]
        layout = replace(layout, columns=tuple(Column(n, n, None, False) for n in names))
        files = [replace(one, layout=layout) for one in files]
    asked = bool(tag) and is_asked(tag)
    columns = tuple(replace(c, is_asked=asked) for c in layout.columns)
    time, _, _ = guess_clock(columns, [files[0].table], [])
    return Kind(tag, tuple(files), columns, time)


def _are_of_one_run(kinds: Sequence[Kind], *, is_lone: bool) -> bool:
    """Whether files differ in what they hold of a run, and not in the run."""
    if is_lone and not all(has_role(kind.tag) for kind in kinds):
        return False
    for kind in kinds:
        same = [other for other in kinds if _share_columns(kind, other)]
        if len({is_asked(other.tag) for other in same}) == 1 < len(same):
            late = all(is_late(other.files[0].table, other.time) for other in same)
            if not late or not _meet(same):
                return False
    return True


def _share_columns(a: Kind, b: Kind) -> bool:
    """Whether two kinds have columns in common, beside one that may be the clock and all that are
    called so: topics of one log have stamps of several kinds."""
    if a is b:
        return True
    if not (a.files[0].layout.has_names and b.files[0].layout.has_names):
        return len(a.columns) == len(b.columns)
    of_b = {c.name for c in b.columns}
    shared = {c.name: c for c in a.columns if c.name in of_b - {""}}
    stamps = {n for n, c in shared.items() if (TIME.match(n) and may_be_time(c)) or IDLE.search(n)}
    rest = shared.keys() - stamps
    return len(rest) > (len(rest) == len(shared))


def _fit_clocks(kinds: Sequence[Kind]) -> list[Kind] | str:
    """The kinds, the record first, with clocks that one study can state; or why there are none."""

    def late_in_order(kind: Kind) -> tuple[bool, bool, bool]:
        no_record = not STATE.search(kind.tag)
        return not kind.has_sure_clock, is_asked(kind.tag), no_record

    first, *others = sorted(kinds, key=late_in_order)
    fitting = [first]
    for kind in others:
        beside = 0 <= first.num_rows - kind.num_rows <= 1
        if not kind.has_sure_clock and beside:
            fitting.append(replace(kind, time={}))
        elif "unit" in kind.time:
            fitting.append(kind)
        else:
            return (
                f"{_list_shown(kind)} has no clock and {kind.num_rows} rows, {_list_shown(first)} "
                f"{first.num_rows}: not joined; give it a column with the time"
            )
    timed = [kind for kind in fitting if kind.time]
    for kind in timed:
        names = {c.name for c in kind.columns}
        taken = next(t.time for t in timed if t.time.get("column") in (*names, None))
        if taken != kind.time:
            return (
                f"{_list_shown(kind)} and {_list_shown(timed[0])}: not joined, since column "
                f"{taken['column']} means another clock in each; rename it in one of them"
            )
    if len(timed) > 1 and not _meet(timed):
        return _why_apart(timed)
    return fitting


def _meet(kinds: Sequence[Kind]) -> bool:
    spans = np.array([kind.span() for kind in kinds])
    shared = spans[:, 1].min() - spans[:, 0].max()
    return bool(shared > _MEETS * np.ptp(spans, axis=1).min())


def _why_apart(kinds: Sequence[Kind]) -> str:
    """That clocks do not meet, and what joins the files all the same."""
    spans = "; ".join("{:.7g} to {:.7g} s".format(*kind.span()) for kind in kinds)
    names = list(map(_list_shown, kinds))
    clocks = {(k.time["column"], k.time["unit"]): {**k.time, "zero": "start"} for k in kinds}
    return (
        f"{', '.join(names)} look like one run, but their clocks do not meet ({spans}): not "
        "joined; if all were started at the same moment, state time: "
        f"{_in_yaml(list(clocks.values()))} and file: {_in_yaml(names)}"
    )


def _in_yaml(value: list[Any]) -> str:
    """On one line, as it can be pasted: Zeit [s] needs quotes."""
    text = yaml.safe_dump(
        value, default_flow_style=True, width=10_000, sort_keys=False, allow_unicode=True
    )
    return str(text).strip()


def _list_shown(kind: Kind) -> str:
    return kind.files[0].reference


def names_of_runs(groups: Sequence[Group]) -> tuple[str, ...]:
    """Names of the runs, with their folders where they are not enough."""
    short = [name for _, name in groups]
    if len(set(short)) == len(short):
        return tuple(short)
    return tuple(f"{place.name}_{name}" for place, name in groups)
