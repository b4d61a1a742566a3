"""Runs as a study file describes them: rows of CSV files, on their clock, in SI units."""

from __future__ import annotations

import fnmatch
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.check import did_you_mean
from diffsim.core.units import factor, to_si
from diffsim.data.columns_beside import choose_columns, numeric_columns
from diffsim.data.formula import names_in
from diffsim.data.run_plan import (
    RunFiles,
    cases_of,
    chosen_rows,
    constants,
    filled,
    parts_by,
    with_defaults,
)
from diffsim.data.run_samples import (
    RunSamples,
    averaged,
    facts_of,
    in_si,
    kept_rows,
    mean_of_equal,
    unfilled,
    without_gaps,
    zero_of,
)
from diffsim.data.stamps import Stamps, mended, of_further, stamp_words
from diffsim.data.study import Column, Run
from diffsim.data.study_schema import (
    MOST_BLOCKS,
    ChannelEntry,
    CommandEntry,
    RunEntry,
    Source,
    StudyFile,
    TableFormat,
    TimeSource,
)
from diffsim.data.table import Rows, Table

_WITH_HEADER = TableFormat()
_TIME = "time_s"  # column of the clock where none is stated
FEWEST_STAMPS = 2  # of a run
WITHOUT_STAMPS = "rows whose stamps are missing, equal to others or go back left out"
BLOCK_OF = "block_of"  # fact of a run that is a piece of another: that one's name


@dataclass(frozen=True, eq=False)
class Piece:
    """A run before its use, group and place are known."""

    run: Run  # the run, with its own name as its group
    # what may stand for it in ``use``, ``from_s``, ...: its name and value of ``split``
    labels: tuple[str, ...]
    group: str | None  # group that the entry states; None: none


class RunReader:
    """Reads the runs of a study and collects what is wrong with them.

    Args:
        root: Folder of the run files, which no file of the study leaves.
        given: Files that the caller named, and not the study: they may lie anywhere.
        strict: Whether stamps that cannot be right are a problem; else their rows are left out.

    Attributes:
        problems: What is wrong, one line each.
        left_out: What is not used, one line each.
        mended: What was done to the record, with the names of the runs.
        stamps: Runs whose stamps cannot be right, and why.
        columns: What the runs hold beside channels and commands.
    """

    def __init__(
        self, study: StudyFile, root: Path, given: Collection[Path] = (), *, strict: bool = True
    ):
        self.study, self.root, self.given, self.strict = study, root, given, strict
        self.stamps: list[tuple[str, str]] = []
        self.problems: list[str] = []
        self.mended: dict[str, list[str]] = {}
        every = (*study.channels, *study.commands)
        self._is_coded = any(s.decode is not None or s.unwrap is not None for s in every)
        self.left_out: list[str] = []
        self.tables: dict[Path, Table] = {}
        self.columns: tuple[Column, ...] = ()

    def runs(self) -> tuple[Run, ...]:
        """All runs, those that cannot be read left out; ``problems`` tells them."""
        made: list[tuple[Piece, RunEntry, str]] = []
        for i, stated in enumerate(self.study.runs):
            where, entry = f"runs[{i}]", with_defaults(stated, self.study.defaults)
            try:
                cases, left_out = cases_of(entry, where, self.root, self._table, self.given)
            except (ValueError, FileNotFoundError) as error:
                self._tell(error)
                continue
            self.left_out += [left_out] if left_out else []
            pieces = [piece for case in cases for piece in self._pieces(case)]
            for key in ("use", "from_s", "until_s", "zero_time"):
                self._check_labels(f"{where}.{key}", getattr(entry, key), pieces, cases)
            made += [(piece, entry, where) for piece in pieces]
        groups = {piece.run.name: piece.group or piece.run.name for piece, _, _ in made}
        out: list[Run] = []
        for piece, entry, where in made:
            try:
                out += _place_runs(piece, entry, where, groups, len(out))
            except ValueError as error:
                self._tell(error)
        used = {name for table in self.tables.values() for name in table.used}
        taken = {name for run in out for name in (*run.command, *run.setup)}
        taken |= {channel.name for channel in self.study.channels}
        units = {n: unit for t in self.tables.values() for n, unit in t.unit_cells.items()}
        placed, self.columns = choose_columns(out, used, taken, units)
        return placed

    def _tell(self, error: Exception) -> None:
        if str(error) not in self.problems:
            self.problems.append(str(error))

    def _table(self, path: Path, form: TableFormat = _WITH_HEADER) -> Table:
        if path not in self.tables:
            self.tables[path] = Table(path, "run", **dict(form))
            further = (s for s in self.tables[path].left_out if s not in self.left_out)
            self.left_out += further
        return self.tables[path]

    def _formats(self, count: int) -> Sequence[TableFormat]:
        """Lay-out of each file of a run; one that is stated alone holds for all."""
        stated = self.study.table
        if len(stated) == 1:
            return stated * count
        if len(stated) != count:
            raise ValueError(f"table has {len(stated)} entries, but a run has {count} files")
        return stated

    def _pieces(self, case: RunFiles) -> Iterator[Piece]:
        """Runs of a file, by the values of ``split``."""
        entry = case.entry
        try:
            table, *others = map(self._table, case.files, self._formats(len(case.files)))
            rows = np.arange(len(table))
            if entry.table is None:
                rows = chosen_rows(table, rows, entry.where, f"{case.where}.where")
            parts = parts_by(table, rows, entry.split)
        except (ValueError, FileNotFoundError) as error:
            self._tell(error)
            return
        if len(rows) < len(table):
            self.left_out.append(
                f"{table.path.name}: {len(table) - len(rows)} of {len(table)} rows, "
                f"by {case.where}.where"
            )
        for values, part in parts:
            texts = (entry.name or "", entry.group or "")
            words = {**constants(table, part, texts), **case.words, **values}
            default = "_".join([case.words["file"], *values.values()])
            try:
                name = filled(entry.name or default, words, f"{case.where}.name")
                group = entry.group and filled(entry.group, words, f"{case.where}.group")
                labels = (name, "_".join(values.values())) if values else (name,)
                run = self._build_run(case, [table, *others], part, words, name, labels)
            except (ValueError, FileNotFoundError) as error:
                self._tell(error)
                continue
            yield Piece(run, labels, group)

    def _build_run(
        self,
        case: RunFiles,
        tables: Sequence[Table],
        rows: Rows,
        words: Mapping[str, str],
        name: str,
        labels: Sequence[str],
    ) -> Run:
        entry = case.entry
        own = self._seconds(entry, tables[0])
        clocks = [own, *(self._seconds_beside(entry, t, tables[0], own) for t in tables[1:])]
        rows, recorded, clocks = self._mend_clocks(name, entry, tables, rows, clocks)
        samples = RunSamples(tables, clocks, rows, recorded)
        facts = facts_of(entry.setup, samples, words, f"{case.where}.setup")
        whole = replace(samples, facts=facts, time_s=recorded)
        made = {c.name: partial(self._values, c, entry, whole) for c in self.study.channels}
        zero = zero_of(entry, whole, labels, case.where, made)
        samples = replace(samples, facts=facts, time_s=recorded - zero if zero else recorded)
        keep = kept_rows(entry, samples, labels, f"{case.where}")
        if len(keep) < len(rows) and entry.every == 1:
            self.left_out.append(
                f"run {name}: {len(rows) - len(keep)} of {len(rows)} samples, by its window"
            )
        facts = facts_of(entry.setup, samples.only(keep), words, f"{case.where}.setup")
        samples = replace(samples, facts=facts)
        raw: dict[str, tuple[str, Array]] = {}
        # column by column, as those of millions of rows need the room; a formula sees all rows
        seen = keep if entry.missing_if is None else slice(None)
        time_s = samples.time_s[seen]
        channels = [self._values(c, entry, samples, raw, seen) for c in self.study.channels]
        measured = np.column_stack([*channels]) if channels else np.empty((len(time_s), 0))
        command = {c.name: self._values(c, entry, samples, raw, seen) for c in self.study.commands}
        if entry.missing_if is not None:
            named = {c.name: v for c, v in zip(self.study.channels, channels, strict=True)}
            stated = {name: partial(np.copy, v) for name, v in {**named, **command}.items()}
            missing = samples.formula(entry.missing_if, stated) != 0.0
            measured[missing] = np.nan
            # nor are such values asked for faults of the record, which this key mends
            for c in self.study.channels:
                if c.name in raw:
                    raw[c.name] = raw[c.name][0], np.where(missing, np.nan, raw[c.name][1])
        columns = {
            name: values
            for name, values in numeric_columns(samples, seen).items()
            if not any(fnmatchcase(name, pattern) for pattern in self.study.ignore)
        }
        run = Run(
            name,
            time_s,
            measured,
            command,
            name,
            setup=facts,
            columns=columns,
            files=tuple(str(table.path.absolute()) for table in tables),
            raw=raw,
            row_s=entry.row_s,
        )
        run = run if entry.missing_if is None else run.part(keep)
        if self._is_coded or entry.stamps or entry.duplicates or entry.gaps or entry.columns:
            self._tell_mended(name, entry)
        if entry.duplicates == "mean":
            run = mean_of_equal(run)
        if entry.gaps is not None:
            run = without_gaps(run)
        return run if entry.every == 1 or not entry.average else averaged(run, entry.every)

    def _mend_clocks(
        self, name: str, entry: RunEntry, tables: Sequence[Table], rows: Rows, given: list[Array]
    ) -> tuple[Rows, Array, list[Array]]:
        """Rows of a run in order, their stamps, and the clocks of all tables, mended as stated.

        Raises:
            ValueError: stamps are missing or do not increase, and none but these are read.
        """
        clocks, recorded = given, given[0][rows]
        stamps, equal, kept = entry.stamps, entry.duplicates, rows
        if stamps is not None or equal is not None:
            order, recorded = mended(
                recorded, stamps or Stamps(), None if equal == "mean" else equal
            )
            kept = rows[order]
            clocks = [given[0], *(of_further(c, stamps or Stamps(), equal) for c in given[1:])]
        new = np.append(True, np.diff(recorded) != 0.0) if equal == "mean" else slice(None)
        now = recorded[new]
        is_wrong = bool(not (np.diff(now) > 0.0).all() or np.isnan(now).any())
        lines = [tables[0].lines[row] for row in kept[new]] if is_wrong else []
        checked: list[tuple[Table, Sequence[int], Array, bool]] = []
        checked.append((tables[0], lines, now, is_wrong))
        for table, clock in zip(tables[1:], clocks[1:], strict=True):
            checked.append((table, table.lines, clock, bool(np.isnan(clock).any())))
        wrong = [
            str(stamp_words(table.path, lines, clock, self._clock(entry, table).column or _TIME))
            for table, lines, clock, is_wrong in checked
            if is_wrong
        ]
        if not wrong:
            return kept, recorded, clocks
        left_out = {"stamps": (stamps or Stamps()).leaving_out(), "duplicates": equal or "first"}
        further = entry.model_copy(update=left_out)
        if self.strict or further == entry or np.isfinite(given[0][rows]).sum() < FEWEST_STAMPS:
            raise ValueError(wrong[0])
        self.stamps += [(name, said) for said in wrong]
        self.mended.setdefault(WITHOUT_STAMPS, []).append(name)
        return self._mend_clocks(name, further, tables, rows, given)

    def _tell_mended(self, name: str, entry: RunEntry) -> None:
        """What was done to the record of a run."""
        said = [f"rows with equal stamps: {entry.duplicates}"] if entry.duplicates else []
        said += [entry.stamps.words] if entry.stamps is not None else []
        said += ["lost rows put back, commands on lines"] if entry.gaps else []
        every: list[ChannelEntry | CommandEntry] = [*self.study.channels, *self.study.commands]
        for stated in every:
            source: Source = entry.columns.get(stated.name) or stated
            words = [source.decode.words] if source.decode is not None else []
            words += [f"unwrapped at {source.unwrap:g}"] if source.unwrap else []
            said += [f"{stated.name}: {', '.join(words)}"] if words else []
        if said:
            self.mended.setdefault("; ".join(said), []).append(name)

    def _values(
        self,
        stated: ChannelEntry | CommandEntry,
        entry: RunEntry,
        samples: RunSamples,
        raw_of: dict[str, tuple[str, Array]] | None = None,
        keep: Rows | slice = slice(None),
    ) -> Array:
        """A channel or command in SI units, at the rows of the run.

        Args:
            raw_of: Gets what one column holds of it, by name.
        """
        source: Source = stated
        unit = stated.unit
        if stated.name in entry.columns:
            other = entry.columns[stated.name]
            if other is None:
                return np.full(len(samples.time_s), np.nan)[keep]
            source, unit = other, other.unit or unit
            if unit and stated.unit and to_si(unit).unit != to_si(stated.unit).unit:
                factor(unit, stated.unit)  # refuses a unit of another quantity
        if isinstance(stated, CommandEntry) and stated.fill == "hold":
            samples = samples.holding()
        if source.decode is not None:
            samples = samples.decoding(source.decode)
        columns: tuple[str, ...] = (source.column or stated.name,)
        if source.formula is None:
            raw = samples.column(columns[0], source.file)
        else:
            raw = samples.formula(source.formula, file=source.file)
            columns = tuple(n for n in names_in(source.formula) if n not in samples.facts)
        if raw_of is not None and len(columns) == 1 and "derivative" not in (source.formula or ""):
            own = raw if source.formula is None else samples.column(columns[0], source.file)
            raw_of[stated.name] = (columns[0], own[keep])
        values = in_si(raw, source, unit)
        if isinstance(stated, ChannelEntry) and stated.zero_s is not None:
            start, end = stated.zero_s
            rest = (samples.recorded_s >= start) & (samples.recorded_s < end)
            if not np.isfinite(values[rest]).any():
                raise ValueError(
                    f"channel {stated.name}: zero_s: {samples.table.path.name} has no sample "
                    f"from {start:g} to {end:g} s"
                )
            values = values - np.nanmean(values[rest])
        if isinstance(stated, CommandEntry) and stated.fill is not None:
            scale = to_si(stated.unit).factor if stated.unit else 1.0
            values = unfilled(values, samples.time_s, stated.fill, scale)
        return values[keep]

    def _seconds(self, entry: RunEntry, table: Table) -> Array:
        source = self._clock(entry, table)
        factor = None if source.unit == "clock" else to_si(source.unit).factor
        return table.seconds(source.column, factor, source.step, source.zero)

    def _seconds_beside(self, entry: RunEntry, table: Table, first: Table, clock: Array) -> Array:
        """Clock of a further file; one without has its rows beside those of the first."""
        source, main = self._clock(entry, table), self._clock(entry, first)
        if source.unit == main.unit == "clock" and main.column and source.column in table.header:
            return table.dates(source.column) - first.dates(main.column)[0]
        if source.step is not None or (source.column or _TIME) in table.header:
            return self._seconds(entry, table)
        if not 0 <= len(first) - len(table) <= 1:
            raise ValueError(
                f"{table.path}: column {source.column or _TIME} is missing, and of its "
                f"{len(table)} rows not each is beside one of the {len(first)} of "
                f"{first.path.name}; state its clock, or give each row its partner"
            )
        return clock[: len(table)]

    def _clock(self, entry: RunEntry, table: Table) -> TimeSource:
        """The first of the stated clocks that the file has; the first of all where it has none."""
        sources = entry.time or self.study.time or (TimeSource(),)
        for source in sources:
            if (source.column or _TIME) in table.header or (source.step and not source.column):
                return source
        return sources[0]

    def _check_labels(
        self, where: str, stated: Any, pieces: Sequence[Piece], cases: Sequence[RunFiles]
    ) -> None:
        """Values of a mapping by run that no run has."""
        if not isinstance(stated, Mapping) or len(pieces) < len(cases):
            return
        known = [piece.labels[-1] for piece in pieces]
        by_run = not where.endswith("use")  # seconds by run, or runs by use
        for label in stated if by_run else [v for values in stated.values() for v in values]:
            if not any(_is_meant(str(label), piece.labels) for piece in pieces):
                shown = ", ".join(known[:12]) + (", ..." if len(known) > 12 else "")
                close = did_you_mean(str(label), known)
                self._tell(ValueError(f"{where}: no run {label}{close}; there are {shown}"))


def _is_meant(given: str, labels: Sequence[str]) -> bool:
    return any(fnmatch.fnmatchcase(label, given) for label in labels)


def _use_of(stated: str | Mapping[str, Sequence[str]], piece: Piece, where: str) -> str:
    if isinstance(stated, str):
        return stated
    uses = [use for use, given in stated.items() if any(_is_meant(v, piece.labels) for v in given)]
    if len(uses) > 1:
        raise ValueError(f"{where}.use: run {piece.run.name} is both {' and '.join(uses)}")
    return uses[0] if uses else "test" if "fit" in stated else "fit"


def _place_runs(
    piece: Piece, entry: RunEntry, where: str, groups: Mapping[str, str], place: int
) -> list[Run]:
    """The run, or the blocks of it, with use, group and place in the order."""
    use = _use_of(entry.use, piece, where)
    group = piece.group or piece.run.name
    if entry.repeat_of is not None:
        if entry.repeat_of not in groups:
            raise ValueError(
                f"{where}.repeat_of: no run {entry.repeat_of!r}"
                f"{did_you_mean(entry.repeat_of, groups)}"
            )
        group = groups[entry.repeat_of]
    order = place if entry.order is None else entry.order
    run = replace(piece.run, use=use, group=group, order=order)
    return [run] if entry.blocks is None else _blocks(run, entry, where)


def _blocks(run: Run, entry: RunEntry, where: str) -> list[Run]:
    blocks = entry.blocks
    assert blocks is not None
    n = len(run.time_s)
    if blocks.num is not None:
        edges = np.linspace(0, n, blocks.num + 1).round().astype(int)
    else:
        assert blocks.length_s is not None
        count = (run.time_s[-1] - run.time_s[0]) / blocks.length_s
        if count > MOST_BLOCKS:
            raise ValueError(
                f"{where}.blocks.length_s: makes {count:,.0f} pieces of run {run.name}, at most "
                f"{MOST_BLOCKS:,}"
            )
        lengths = np.arange(run.time_s[0], run.time_s[-1], blocks.length_s)
        edges = np.append(np.searchsorted(run.time_s, lengths - 1e-9), n)
    by_number = {k: use for use, numbers in blocks.use.items() for k in numbers}
    if too_large := [k for k in by_number if k > len(edges) - 1]:
        raise ValueError(
            f"{where}.blocks.use: no piece {too_large[0]}; run {run.name} has {len(edges) - 1}"
        )
    out = []
    for k in range(1, len(edges)):
        part = run.part(slice(0 if blocks.run_up else edges[k - 1], edges[k]))
        measured = part.measured.copy()
        if blocks.run_up:
            measured[: edges[k - 1]] = np.nan
        out.append(
            replace(
                part,
                name=f"{run.name}_{k}",
                group=f"{run.group}_{k}",
                time_s=part.time_s - part.time_s[0] if blocks.restart_time else part.time_s,
                measured=measured,
                order=run.order if blocks.run_up else run.order + k - 1,
                use=by_number.get(k, run.use),
                setup={**run.setup, BLOCK_OF: run.name},
            )
        )
    return out
