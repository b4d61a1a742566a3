"""Entries of ``runs:`` spelled out: files that fit a pattern, rows of a table, names from both."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from diffsim.core.check import did_you_mean
from diffsim.core.inside import inside
from diffsim.core.schema import fill_in
from diffsim.data.formats import is_container, split_part
from diffsim.data.study_schema import RunEntry, RunKeys
from diffsim.data.table import Rows, Table, as_label

_FIELD = re.compile(r"\{(\w+)(?::[^}]*)?\}")
_RANGE = ("at_least", "below")
_MOST_PARTS = 40  # of a pattern: words, stars, and what stands between them


Given: TypeAlias = Collection[Path]


@dataclass(frozen=True)
class RunFiles:
    """Files of one or, with ``split``, several runs."""

    where: str  # entry of the study file, such as "runs[2]"
    entry: RunEntry  # the entry with the study's defaults
    files: tuple[Path, ...]  # the run's file and those that are read at its clock
    # what {name} stands for in texts of the entry
    words: Mapping[str, str] = field(default_factory=dict)


def with_defaults(entry: RunEntry, defaults: RunKeys) -> RunEntry:
    """The entry, with the defaults where it says nothing; ``setup`` and ``columns`` are joined."""
    given = {k: getattr(defaults, k) for k in defaults.model_fields_set}
    joined = {k: {**given[k], **getattr(entry, k)} for k in ("setup", "columns") if given.get(k)}
    stated = {k: getattr(entry, k) for k in entry.model_fields_set}
    return entry.model_copy(update={**given, **stated, **joined})


def cases_of(
    entry: RunEntry, where: str, root: Path, table: Callable[[Path], Table], given: Given = ()
) -> tuple[list[RunFiles], str]:
    """All files that an entry stands for.

    Args:
        entry: Entry of ``runs:``, with defaults.
        where: What messages call it, such as "runs[2]".
        table: Reads a CSV file.
        given: Files that the caller named, and not the study: they may lie anywhere.

    Returns:
        The files, and a sentence on rows of ``table`` that are left out, or "".

    Raises:
        ValueError: no file fits, one is not in the folder, or a word of a pattern is unknown.
    """
    rows: list[dict[str, str]] = [{}]
    left_out = ""
    if entry.table is not None:
        listing = table(inside(root, entry.table, f"{where}.table"))
        chosen = chosen_rows(listing, np.arange(len(listing)), entry.where, f"{where}.where")
        columns = {name: listing.texts(name) for name in listing.header if name}
        rows = [{name: cells[i] for name, cells in columns.items()} for i in chosen]
        if fewer := len(listing) - len(chosen):
            left_out = f"{entry.table}: {fewer} of {len(listing)} runs, by {where}.where"
    cases = []
    patterns = entry.file or (f"{entry.name}.csv",)
    for words in rows:
        first, *further = [_fill_in_known_words(p, words) for p in patterns]
        for path, found in _files(root, first, where, given):
            all_words = {**words, **found, "file": split_part(path)[0].stem}
            others = [
                _resolve_file(root, filled(p, all_words, f"{where}.file"), where, given)
                for p in further
            ]
            cases.append(RunFiles(where, entry, (path, *others), all_words))
    return cases, left_out


def _fill_in_known_words(pattern: str, words: Mapping[str, str]) -> str:
    return _FIELD.sub(lambda m: words.get(m.group(1), m.group(0)), pattern)


def _resolve_file(root: Path, stated: str, where: str, given: Given) -> Path:
    if Path(stated) in given:
        return Path(stated)
    return inside(root, stated, f"{where}.file")


def _files(root: Path, pattern: str, where: str, given: Given) -> list[tuple[Path, dict[str, str]]]:
    """Files of a pattern with ``*`` and {words}; a plain name is one file, whether there or not."""
    if is_container(pattern):  # FILE#PART: the pattern is that of the file
        file, part = split_part(pattern)
        found = _files_named(root, str(file), where, given)
        return [(Path(f"{path}#{part}") if part else path, words) for path, words in found]
    return _files_named(root, pattern, where, given)


def _files_named(
    root: Path, pattern: str, where: str, given: Given
) -> list[tuple[Path, dict[str, str]]]:
    if "*" not in pattern and not _FIELD.search(pattern):
        return [(_resolve_file(root, pattern, where, given), {})]
    inside(root, pattern, f"{where}.file")
    parts = [p for p in re.split(r"(\*+|\{\w+\})", pattern) if p]
    names = [p[1:-1] for p in parts if p.startswith("{")]
    if len(set(names)) < len(names):
        raise ValueError(f"{where}.file: a word occurs twice in {pattern!r}")
    if len(parts) > _MOST_PARTS:
        raise ValueError(f"{where}.file: at most {_MOST_PARTS // 2} words and * in a pattern")
    found = []
    wild = re.sub(r"\*+", "*", "".join("*" if p[0] in "*{" else p for p in parts))
    for path in root.glob(wild):  # ** would walk through all folders
        words = _words_of(parts, path.relative_to(root).as_posix())
        if words is not None and path.is_file():
            here = inside(root, path.relative_to(root).as_posix(), f"{where}.file")
            found.append((here, words))
    if not found:
        beside = sorted(p.name for p in root.glob("*.csv"))
        raise ValueError(
            f"{where}.file: no file fits {pattern!r}{did_you_mean(pattern, beside)}; "
            f"{root} has {', '.join(beside[:12]) or 'no CSV files'}"
        )
    return sorted(found, key=lambda f: split_numbers(f[0].as_posix()))


def _words_of(parts: Sequence[str], name: str) -> dict[str, str] | None:
    """What the {words} of a pattern stand for, as short as can be; None: it does not fit.

    Places that led nowhere are remembered: a regular expression would try all ways to part a name.
    """

    @cache
    def ends(k: int, at: int) -> tuple[int, ...] | None:
        """Where the parts from the k-th on end, the first of them beginning at ``at``."""
        if k == len(parts):
            return () if at == len(name) else None
        if parts[k][0] not in "*{":
            tries: Iterable[int] = [at + len(parts[k])] if name.startswith(parts[k], at) else ()
        else:
            slash = name.find("/", at)
            stop = len(name) if slash < 0 else slash
            is_word = parts[k][0] == "{"
            tries = range(at + 1, stop + 1) if is_word else range(stop, at - 1, -1)
        for end in tries:
            if (rest := ends(k + 1, end)) is not None:
                return (end, *rest)
        return None

    found = ends(0, 0)
    if found is None:
        return None
    spans = zip(parts, (0, *found), found, strict=False)
    return {p[1:-1]: name[start:end] for p, start, end in spans if p[0] == "{"}


def split_numbers(name: str) -> list[tuple[int, int | str]]:
    """A key that puts run_9 before run_10."""
    return [(0, int(p)) if p.isdigit() else (1, p) for p in re.split(r"(\d+)", name) if p]


def filled(text: str, words: Mapping[str, str], where: str) -> str:
    """A text with its {words} filled in; {toss:03d} writes a number with three digits.

    Raises:
        ValueError: a word that there is not.
    """
    try:
        # a number where it is written as numbers are: 7, not 007
        labels = {k: as_label(v) for k, v in words.items()}
        return fill_in(text, {k: v if str(v) == words[k] else words[k] for k, v in labels.items()})
    except KeyError as error:
        name = str(error.args[0])
        raise ValueError(
            f"{where}: {text!r} has {{{name}}}{did_you_mean(name, words)}; known: "
            f"{', '.join(words) or 'nothing'}"
        ) from None
    except ValueError as error:
        raise ValueError(f"{where}: {text!r} cannot be filled in: {error}") from None


def constants(table: Table, rows: Rows, texts: Sequence[str]) -> dict[str, str]:
    """Columns that texts have in {} and that are constant over some rows: their value."""
    asked = {m.group(1) for text in texts for m in _FIELD.finditer(text)}
    out = {}
    for name in asked.intersection(table.header):
        cells = table.texts(name)
        if len(found := {cells[i] for i in rows}) == 1:
            out[name] = found.pop()
    return out


def chosen_rows(table: Table, rows: Rows, where: Mapping[str, Any], path: str) -> Rows:
    """Rows whose cells are as ``where`` says.

    Args:
        table: File with these columns.
        where: Value, list of values, or {at_least, below}, by column.
        path: What messages call it, such as "runs[2].where".

    Raises:
        ValueError: no such column, nothing is left, or a range that is none.
    """
    for column, wanted in where.items():
        if isinstance(wanted, Mapping):
            if not wanted or any(k not in _RANGE for k in wanted):
                raise ValueError(f"{path}.{column} must be a value, a list or {{at_least, below}}")
            values = table.numbers(column)[rows]
            keep = values >= float(wanted.get("at_least", -np.inf))
            keep &= values < float(wanted.get("below", np.inf))
        else:
            cells = [str(as_label(c)) for c in table.texts(column)]
            listed = (
                wanted if isinstance(wanted, Sequence) and not isinstance(wanted, str) else [wanted]
            )
            texts = {str(as_label(str(w))) for w in listed}
            keep = np.array([cells[i] in texts for i in rows], dtype=bool)
            if not keep.any():
                there = sorted({cells[i] for i in rows})
                raise ValueError(
                    f"{path}.{column}: no row has {', '.join(sorted(texts))}"
                    f"{did_you_mean(sorted(texts)[0], there)}; {table.path.name} has "
                    f"{', '.join(there[:12])}{', ...' if len(there) > 12 else ''}"
                )
        rows = rows[keep]
    if not len(rows):
        raise ValueError(f"{path}: no row of {table.path.name} is left")
    return rows


def parts_by(table: Table, rows: Rows, columns: Sequence[str]) -> list[tuple[dict[str, str], Rows]]:
    """Rows by the values of columns, in order of appearance; all of them without columns."""
    if not columns:
        return [({}, rows)]
    cells = [table.texts(name) for name in columns]
    parts: dict[tuple[str, ...], list[int]] = {}
    for i in rows:
        parts.setdefault(tuple(column[i] for column in cells), []).append(int(i))
    return [
        (dict(zip(columns, values, strict=True)), np.array(part)) for values, part in parts.items()
    ]
