"""A first study of an unknown folder, by rules in one order: what its files look like, and why.

Each rule looks at what is known so far, adds to it, and yields what it guessed, a sentence each.
One that finds nothing to do does nothing; what none has explained stays as it is.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.check import did_you_mean
from diffsim.core.figures import fold_alike
from diffsim.data.clock_guess import guess_clock, guess_split, is_late, seconds_of, unit_by_step
from diffsim.data.column_rules import COLUMN_RULES
from diffsim.data.facts_beside import facts_beside, facts_of
from diffsim.data.folder_tables import FoundTable, files_below, find_tables
from diffsim.data.formats import SUFFIXES
from diffsim.data.guess import Guess, GuessedColumn, GuessedRun, listed
from diffsim.data.joined_files import Kind, join_files, names_of_runs
from diffsim.data.names import BESIDE, COUNTER, DRIVES, STATE, is_asked, log_column, px4_topic
from diffsim.data.stamps import JUMP, filled, stamp_fault, usual_step
from diffsim.data.table import MAKER, Table
from diffsim.data.table_guess import TABLES, Column, last_line

Rule: TypeAlias = Callable[[Guess], Iterable[str] | None]

OTHERS = 12  # topics that a sentence names
MAX_SIZE = 100_000  # samples of all channels and runs, from which on fewer are used if they do
# Of a column's range, rms: lines between each n-th sample may be so far off. Slow presses and
# markers stay below 0.006, accelerations, rates and loads are 0.26 off at each second sample.
OFF_COURSE = 0.05
PROBED_RUNS, PROBED_ROWS = 8, 4000  # that tell it
_IN_NAME = re.compile(
    r"(?<![\d.])(\d+(?:p\d+)?)(mm|cm|g|kg|mbar|kPa|Pa|bar|mN|N|V|Hz|deg|rpm)(?![A-Za-z])"
)
#: Words that number runs: counted ones, and a letter.
_COUNTED = re.compile(
    r"\d+|[A-Za-z]|(run|rep|repeat|take|trial|test|try|log|rec|record|file|data|exp|part|sweep|cycle"
    r"|messung|versuch|lauf|nr|no)\d*",
    re.IGNORECASE,
)
#: Words by which people keep runs apart, for a fit and for what judges it; counted, too: train1.
_USES = {
    "fit": re.compile(r"(train(ing)?|fit(ted|ting)?|ident(ification)?|estimation)\d*", re.I),
    "select": re.compile(r"(val|valid(ation)?|dev)\d*", re.I),
    "test": re.compile(r"(test(ing)?|hold_?out|unseen|eval(uation)?|verif(ication)?)\d*", re.I),
}
_UNREAD = "not read: "
_PACKED = (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar")
_OTHER_UNIT = 2.0  # powers of ten between steps: units are three apart, and loggers' steps less
_MIXED = 0.01  # of the rows, that are out of order
_TURNS = 0.3  # of the rows have another name than the one before, where readings take turns
_SAME = 0.02  # rms over range: commands of repeats agree to this
_START_SD = 5.0  # of its noise, within which all begin alike
_START = 0.1  # of a channel's range: pendulums let go elsewhere began 0.15 and 0.8 of it apart


def search(guess: Guess) -> Iterable[str]:
    """Tables of the folder and of those in it; where there are some on top, these alone."""
    not_read: list[str] = []
    found = list(find_tables(guess.folder, not_read))
    sheets = tuple(f"{_UNREAD}{p}: holds no" for p in files_below(guess.folder) if facts_of(p))
    told = [said.removeprefix(_UNREAD) for said in not_read if not said.startswith(sheets)]
    yield from (f"{_UNREAD}{said}" for said in fold_alike(told))
    packed = [path for path in files_below(guess.folder) if path.suffix.lower() in _PACKED]
    names = sorted(path.relative_to(guess.folder).as_posix() for path in packed)
    yield from listed("packed files, not looked into; unpack them first", names)
    if not found:
        raise ValueError("\n".join([_why_none(guess.folder), *not_read]))
    top = min(one.level for one in [f for f in found if f.has_clock] or found)
    guess.found = [one for one in found if one.level == top]
    others = dict.fromkeys(
        one.path.relative_to(guess.folder).as_posix() for one in found if one.level != top
    )
    yield from listed("files in other folders, not used", others)


def asked_parts(guess: Guess) -> None:
    """Of files with several tables the one that is asked for."""
    if not guess.parts:
        return
    known = list(dict.fromkeys(one.part for one in guess.found if one.part))
    for part in guess.parts:
        if part not in known:
            close = did_you_mean(part, known)
            raise ValueError(f"--part: no table {part!r}{close}; known: {', '.join(known)}")


def readable(guess: Guess) -> Iterable[str]:
    """Files that can be read as tables, such as those whose rows have as many cells each."""
    errors = {one: error for one in guess.found if (error := one.error) is not None}
    if len(errors) == len(guess.found):
        raise next(iter(errors.values()))
    guess.found = [one for one in guess.found if one not in errors]
    yield from (f"not read: {error}" for error in errors.values())


def joins(guess: Guess) -> Iterable[str]:
    """Files of one run, from instruments of several kinds."""
    tables = [one for one in guess.found if not one.is_topic]
    said: list[str] = []
    if len(tables) > 1 and not guess.parts and (joined := join_files(tables, said)):
        guess.kinds, guess.names = joined
    return said


def families(guess: Guess) -> Iterable[str]:
    """Else tables with the same columns are runs: those that most files, then most bytes, have."""
    if not guess.kinds:
        by: dict[Any, list[FoundTable]] = {}
        for one in guess.found:
            if not guess.parts or not one.part or one.part == guess.parts[0]:
                by.setdefault((one.layout, one.is_topic and one.part), []).append(one)
        timed = [family for family in by.values() if family[0].has_clock]
        best = max(timed or by.values(), key=_rank)
        guess.kinds = [Kind("", tuple(best), best[0].layout.columns, {})]
        guess.names = names_of_runs([(one.path.parent, one.name) for one in best])
    taken = {one.path for kind in guess.kinds for one in kind.files}
    others = dict.fromkeys(
        one.path.relative_to(guess.folder).as_posix()
        for one in guess.found
        if one.path not in taken
    )
    is_apart = any("not joined" in said for said in guess.said)  # of one run, with their own clocks
    other_rig = "; recordings of another rig need a folder, and a study, of their own"
    names = [c.name for c in guess.kinds[0].columns]
    moved = {
        path: one.layout
        for one in guess.found
        if (path := one.path.relative_to(guess.folder).as_posix()) in others
        and [c.name for c in one.layout.columns] == names
    }
    line = guess.kinds[0].files[0].layout.header_line
    yield from listed(
        f"files with the same columns, but not with their names in line {line}, not used; take "
        "out or add lines above the names there",
        [f"{path} (line {layout.header_line})" for path, layout in moved.items()],
    )
    units = {
        path: told
        for one in guess.found
        if (path := one.path.relative_to(guess.folder).as_posix()) in others
        and (told := _other_units(guess.kinds[0].columns, one.layout.columns))
    }
    yield from listed(
        "files with a column in another unit, not used; write them under `runs`",
        [f"{{file: {path!r}, columns: {{{told}}}}}" for path, told in units.items()],
    )
    others = {path: None for path in others if path not in moved and path not in units}
    for sentence in listed("files with other columns, not used", others):
        yield sentence if is_apart else f"{sentence}{other_rig}"
    used = {one.reference for kind in guess.kinds for one in kind.files}
    beside = [one for one in guess.found if one.path in taken and not one.is_topic]
    rest = [one.reference for one in beside if one.reference not in used]
    yield from listed("tables with other columns, not used", rest, OTHERS)


def topics(guess: Guess) -> Iterable[str]:
    """Of a log the record, with topics that belong to it, and one that sounds commanded."""
    record = guess.kinds[0]
    if not record.files[0].is_topic:
        return
    by = {(one.path, one.part): one for one in guess.found}
    main = record.files[0]
    known = {part: one for (path, part), one in by.items() if path == main.path}
    parts = (main.part, *guess.parts[1:])
    if not guess.parts:
        parts = _topics_beside(main.part, known)
    if len(known) > 1:
        hint = "" if guess.parts else "; --part TOPIC, repeated, uses others"
        yield f"topics: {' and '.join(parts)}{hint}"
        yield from listed("other topics", (part for part in known if part not in parts), OTHERS)
    whole = [k for k, one in enumerate(record.files) if all((one.path, p) in by for p in parts)]
    guess.names = tuple(guess.names[k] for k in whole)
    guess.kinds, unused = [], []
    for part in parts:
        files = tuple(by[record.files[k].path, part] for k in whole)
        found = {c.name: log_column(c.name, part) for c in files[0].layout.columns}
        unused += [name for name, column in found.items() if column is None]
        columns = tuple(c for c in found.values() if c is not None)
        guess.kinds.append(Kind(part.rpartition("/")[2], files, columns, {}))
    yield from listed("fields of topics, not used", unused)


def exported_topics(guess: Guess) -> Iterable[str]:
    """Of topics of PX4 that were exported, a file each, those that ``topics`` would take."""
    of = {topic: kind for kind in guess.kinds if (topic := px4_topic(kind.tag))}
    if len(of) < 2:
        return
    main = max(of, key=lambda topic: (topic in BESIDE, bool(STATE.search(topic))))
    chosen = _topics_beside(main, {topic: kind.files[0] for topic, kind in of.items()})
    taken = [of[topic] for topic in chosen]
    others = (kind.tag for kind in guess.kinds if not any(kind is one for one in taken))
    yield from listed("other topics", others, OTHERS)
    unused = []
    guess.kinds = []
    for topic in chosen:
        found = {c.name: log_column(c.name, topic) for c in of[topic].columns}
        unused += [name for name, column in found.items() if column is None]
        columns = tuple(c for c in found.values() if c is not None)
        guess.kinds.append(replace(of[topic], tag=topic, columns=columns))
    yield from listed("fields of topics, not used", dict.fromkeys(unused))


def _topics_beside(main: str, known: Mapping[str, FoundTable]) -> tuple[str, ...]:
    """The record of a log, topics that belong to it, and one that sounds commanded."""
    beside = tuple(topic for topic in BESIDE.get(main, ()) if topic in known)
    asked = [topic for topic in known if is_asked(topic) and topic != main]
    if not asked:
        return (main, *beside)
    best = max(asked, key=lambda topic: (bool(DRIVES.search(topic)), known[topic].size()))
    return (main, *beside, best)


def headers(guess: Guess) -> Iterable[str]:
    """What the files hold and their tables do not, and columns that have no names."""
    tables = [one.table for kind in guess.kinds for one in kind.files]
    said = dict.fromkeys(sentence for table in tables for sentence in table.left_out)
    yield from fold_alike(list(said))
    bare = [kind for kind in guess.kinds if not kind.files[0].layout.has_names]
    if bare:
        names = ", ".join(c.name for kind in bare for c in kind.columns)
        is_part = any(c.base != f"column_{k}" for k, c in enumerate(bare[0].columns, 1))
        what = "have fewer names than columns" if is_part else "have none"
        yield f"header: {bare[0].files[0].reference} and the like {what}; columns are {names}"
        guess.todo.append(
            "columns of `table`: the files name none, these are by their place; rename them there, "
            "and in channels and commands"
        )


def clock(guess: Guess) -> Iterable[str]:
    """The clock of each kind of file."""
    said: list[str] = []
    for k, kind in enumerate(guess.kinds):
        if not k or kind.time or kind.files[0].is_topic:
            tables = [one.table for one in kind.files]
            time, column, todo = guess_clock(kind.columns, tables, said)
            guess.time += [] if time in guess.time else [time]
            guess.todo += [sentence for sentence in todo if sentence not in guess.todo]
            guess.is_late |= not k and is_late(tables[0], time)
            name = None if column is None else column.name
            guess.columns += [
                GuessedColumn(c, k, kind.tag, "clock" if c.name == name else "")
                for c in kind.columns
                if c.name
            ]
        else:
            guess.columns += [GuessedColumn(c, k, kind.tag) for c in kind.columns if c.name]
    yield from dict.fromkeys(said)
    if guess.is_late:
        yield "zero_time: the clock counts from long ago; every run starts at 0 s"


def long_form(guess: Guess) -> None:
    """A row for each reading, with its name beside it, is no record: rows are moments."""
    if len(guess.kinds) > 1 or not guess.those("clock"):
        return
    table = guess.kinds[0].files[0].table
    texts = [c.column.name for c in guess.those("") if not table.is_number[c.column.name]]
    numbers = [c.column.name for c in guess.those("") if table.is_number[c.column.name]]
    if not texts or len(numbers) != 1:
        return
    steps = np.diff(seconds_of(table, guess.time[0]))
    for name in texts:
        cells = table.texts(name)
        known = list(dict.fromkeys(cells))
        changes = sum(a != b for a, b in pairwise(cells))
        if 1 < len(known) <= OTHERS and changes > _TURNS * len(cells) and (steps <= 0.0).any():
            clock = guess.those("clock")[0].column.name
            raise ValueError(
                f"{table.path.name} has a row for each reading, by the names in column {name}; "
                f"write a column for each of {', '.join(known)}: Grafana's transformation `Series "
                f"joined by time`, InfluxDB's pivot(), or pandas' df.pivot(index={clock!r}, "
                f"columns={name!r}, values={numbers[0]!r}).to_csv(...)"
            )


def splits(guess: Guess) -> Iterable[str]:
    """Columns whose values are runs."""
    said: list[str] = []
    if len(guess.kinds) == 1:
        clocks = [c.column for c in guess.those("clock")]
        columns, tables = guess.kinds[0].columns, [one.table for one in guess.kinds[0].files]
        guess.split = guess_split(columns, tables, clocks[0] if clocks else None, said)
        for c in guess.columns:
            if c.column in guess.split and tables[0].is_number[c.column.name]:
                c.role = "split"
    return said


def runs(guess: Guess) -> Iterable[str]:
    """Runs: the files of each kind, or the rows of a file with one value of ``split``."""
    for name, files in zip(
        guess.names, zip(*(k.files for k in guess.kinds), strict=True), strict=True
    ):
        tables, references = [one.table for one in files], [one.reference for one in files]
        rows = np.arange(len(tables[0]))
        if not guess.split:
            guess.runs.append(GuessedRun(name, tuple(references), tuple(tables), rows))
            continue
        columns = [tables[0].texts(c.name) for c in guess.split]
        cells = np.array([" ".join(row) for row in zip(*columns, strict=True)])
        for value in dict.fromkeys(cells.tolist()):
            full = f"{name}_{value}" if len(guess.split) == 1 else value
            own = rows[cells == value]
            guess.runs.append(GuessedRun(full, tuple(references), tuple(tables), own, value))
    if not guess.split:
        count = len(guess.runs)
        of_parts = any("#" in file for run in guess.runs for file in run.files)
        what = "tables" if of_parts else "files"
        what = what if len(guess.kinds) == 1 else f"sets of {what}"
        yield f"runs: one for each of {count} {what}" if count > 1 else "runs: one"


def other_clocks(guess: Guess) -> Iterable[str]:
    """Runs whose clock counts in another unit, such as seconds after milliseconds; the header
    states none."""
    clocks = guess.those("clock")
    if guess.split or len(guess.kinds) != 1 or not clocks:
        return
    time, column = guess.time[0], clocks[0].column
    is_number = all(run.tables[0].is_number[column.name] for run in guess.runs)
    if column.unit or "step" in time or not is_number:
        return
    steps = [usual_step(run.numbers(clocks[0])) for run in guess.runs]
    by: dict[str, list[str]] = {}
    for run, step in zip(guess.runs, steps, strict=True):
        unit = unit_by_step(step)
        if unit != time["unit"] and step > 0.0 and abs(np.log10(step / steps[0])) > _OTHER_UNIT:
            run.time = {**time, "unit": unit}
            by.setdefault(unit, []).append(run.name)
    for unit, names in by.items():
        yield from listed(f"clocks in {unit}, by steps far from those in {time['unit']}", names)


def order(guess: Guess) -> Iterable[str]:
    """Rows that a logger wrote out of order or twice, a few in each file: they are sorted, and one
    is kept."""
    if guess.split or len(guess.kinds) != 1 or not guess.those("clock"):
        return
    if wrapped := _wraps(guess):
        guess.stamps = {"jumps": "close"}
        yield from listed(f"clocks that wrap at {wrapped[0]} go on by the usual step", wrapped[1])
        return
    mixed, equal, coarse, unfilled = [], [], [], []
    for run in guess.runs:
        now = seconds_of(run.tables[0], guess.time[0])
        if (rest := len(now) - filled(now)) > 0:
            unfilled += [f"{run.name} ({rest})"]
            now = now[:-rest]
        latest, least = np.maximum.accumulate(now), np.minimum.accumulate(now[::-1])[::-1]
        # rows out of place, not steps back: of recordings one after another these are few
        back = min(int((now < latest).sum()), int((now > least).sum()))
        again = len(now) - len(np.unique(now))
        fault = stamp_fault(now)
        known = ("sort", "duplicates")
        is_other = fault is not None and not any(word in fault[2] for word in known)
        if is_other or (back > _MIXED * len(now) and not (back == 1 and _is_swap(now))):
            return
        coarse += [run] if again > max(_MIXED * len(now), 1) else []
        mixed += [f"{run.name} ({back})"] if back else []
        equal += [f"{run.name} ({again})"] if again else []
    if coarse:
        if not mixed and not unfilled and (said := _many_equal(guess, coarse)):
            guess.duplicates = said[0]
            yield from listed(said[1], [run.name for run in coarse])
        return
    if mixed and unfilled:
        return
    guess.stamps = {"backward": "sort"} if mixed else {"backward": "drop"} if unfilled else {}
    yield from listed("rows at the end that were not filled, left out", unfilled)
    guess.duplicates = "first" if equal else None
    yield from listed("rows with the stamp of another, of which the first is kept", equal)
    yield from listed("rows out of order, sorted by their stamps", mixed)


def _is_swap(now: Array) -> bool:
    """Whether rows are out of order by one alone: the next ones overtook them."""
    places = np.argsort(np.argsort(now, kind="stable"))
    return bool(np.abs(places - np.arange(len(now))).max() <= 1)


def _many_equal(guess: Guess, runs: Sequence[GuessedRun]) -> tuple[str, str] | None:
    """What is done where many stamps are equal, and why; None: some rows are new, some are not."""
    counts = {c.column.name for c in guess.columns if COUNTER.match(c.column.base)}
    same = []
    for run in runs:
        table, now = run.tables[0], seconds_of(run.tables[0], guess.time[0])
        cells = [np.array(table.texts(n)) for n in table.header if n and n not in counts]
        is_equal = np.diff(now) == 0.0
        same.append(np.all([c[1:] == c[:-1] for c in cells], axis=0)[is_equal])
    share = float(np.mean(np.concatenate(same)))
    if share > 1.0 - _MIXED:
        return "first", "rows written more than once, of which the first is kept"
    if share < 0.5:
        return "spread", "rows that came faster than the clock counts, equal stamps spread evenly"
    return None


def _wraps(guess: Guess) -> tuple[int, list[str]] | None:
    """The count at which the clock of some runs begins anew, and these runs; None: it does not, or
    `jumps: close` would leave it so, or close a gap as well."""
    clock = guess.those("clock")[0]
    for most in (2**16, 2**32):
        found = []
        for run in guess.runs:
            if not run.tables[0].is_number[clock.column.name]:
                return None
            steps = np.diff(run.numbers(clock))
            back = steps[steps < 0.0]
            usual = float(np.median(steps)) if len(steps) else 0.0
            is_closed = most > JUMP * usual and (steps <= JUMP * usual).all()
            if len(back) and not (is_closed and (np.abs(back + most - usual) <= usual).all()):
                break
            found += [run.name] if len(back) else []
        else:
            if found:
                return most, found
    return None


def lists_of_runs(guess: Guess) -> Iterable[str]:
    """Tables that have a row for each run, such as labels: what they know of it may be facts."""
    names = {run.name for run in guess.runs}
    recorded = {table.path for run in guess.runs for table in run.tables}
    for path in sorted(guess.folder.glob("*.csv")) if len(names) > 1 else ():
        if path in recorded:
            continue
        try:
            table = Table(path, "table")
        except ValueError:
            continue
        others = [name for name in table.header if name]
        key = next((n for n in others if names <= set(table.texts(n))), None)
        if key is not None and len(others) > 1:
            run, word = guess.runs[0], f"{{{key}}}"
            files = ", ".join(f'"{file.replace(run.name, word, 1)}"' for file in run.files)
            facts = ", ".join(f'{name}: "{{{name}}}"' for name in others if name != key)
            yield (
                f"{path.name} lists the runs by its column {key}; to take the others as facts, "
                f'write runs: [{{table: {path.name}, name: "{word}", file: [{files}], '
                f"setup: {{{facts}}}}}]"
            )


def numbers_in_names(guess: Guess) -> None:
    """Numbers with a unit in the names of files and folders: step_100mbar.csv."""
    for run in guess.runs:
        for number, unit in _IN_NAME.findall(_path_words(run)):
            value = float(number.replace("p", "."))
            run.setup[f"{unit}_in_name"] = {"value": value, "unit": unit}


def labels_in_names(guess: Guess) -> Iterable[str]:
    """Words of folders and files that several runs share, and others have another one: a specimen.

    Counted words, run3, and single letters number repeats; words such as train and test say what
    runs are for. They are no facts.
    """
    split = [_words_of(run) for run in guess.runs]
    if guess.split or len({tuple(words) for words in split}) != 1:
        return
    said = []
    for place, name in enumerate(split[0]):
        values = [list(words.values())[place] for words in split]
        count = Counter(values)
        no_facts = (_COUNTED, _IN_NAME), tuple(_USES.values())
        is_told = any(all(any(k.fullmatch(w) for k in of) for w in count) for of in no_facts)
        if is_told or len(count) < 2 or min(count.values()) < 2:
            continue
        for run, word in zip(guess.runs, values, strict=True):
            run.setup[name] = word
        said.append(f"{name} ({', '.join(count)})")
    yield from listed("facts, by words in the names of several runs", said)


def repeats(guess: Guess) -> Iterable[str]:
    """Runs with the same facts and the same commands, sample by sample, that begin alike."""
    asked = [c for c in guess.those("command") if not c.is_measured]
    facts = guess.those("fact")
    found = []
    for i, run in enumerate(guess.runs if asked else ()):
        for other in guess.runs[:i]:
            is_alike = other.repeat_of is None and _are_repeats(run, other, asked, facts)
            if is_alike and all(_begin_alike(run, other, c) for c in guess.those("channel")):
                run.repeat_of = other.name
                found.append(f"{run.name} of {other.name}")
                break
    return listed("repeats, by equal commands", found)


def uses(guess: Guess) -> Iterable[str]:
    """Test runs: those that names keep back, else those of the last command; select runs where
    there are plenty."""
    if _set_named_uses(guess):
        named = (f"{run.name} is {run.use}" for run in guess.runs if run.use != "fit")
        yield from listed("uses, by words of names", named)
        return
    groups = Counter(run.repeat_of or run.name for run in guess.runs)
    names = list(groups)
    if len(names) < 3:
        if len(guess.runs) > 1:
            backwards = reversed(guess.runs)
            alone = (run for run in backwards if groups[run.repeat_of or run.name] == 1)
            last = next(alone, guess.runs[-1])
            last.use = "test"
            yield f"uses: {last.name} is test"
        return
    # repeats tell the noise, which a fit needs: commands that were executed once are kept back
    single = [name for name in names if groups[name] == 1] or names
    chosen = {single[-1]: "test"}
    if len(names) > 5 and len(single) > 1:
        chosen[single[(len(single) - 1) // 2]] = "select"
    for run in guess.runs:
        run.use = chosen.get(run.repeat_of or run.name, "fit")
    others = (f"{run.name} is {run.use}" for run in guess.runs if run.use != "fit")
    yield f"uses: {', '.join(others)}"


def _set_named_uses(guess: Guess) -> bool:
    """Give runs the uses of their names, where some are kept back by theirs and others are not;
    whether these are. Where most are called so, "test" is what a run is called."""
    named: list[str] = []
    for run in guess.runs:
        words = _words_of(run).values()
        found = [use for use, one in _USES.items() if any(one.fullmatch(w) for w in words)]
        named.append(found[0] if len(found) == 1 else "")
    kept = sum(use in ("select", "test") for use in named)
    if not kept or kept == len(named) or ("fit" not in named and 2 * kept > len(named)):
        return False
    for run, use in zip(guess.runs, named, strict=True):
        # what chooses is what judges where nothing else does
        run.use = "test" if use == "select" and "test" not in named else use or "fit"
    return True


def size(guess: Guess) -> Iterable[str]:
    """Samples that a diagnosis can bear, where fewer of them show the same course."""
    count = sum(len(run.rows) for run in guess.runs) * max(len(guess.those("channel")), 1)
    guess.every = wanted = max(1, round(count / MAX_SIZE))
    if wanted == 1:
        return
    seen = [c for c in (*guess.those("channel"), *guess.those("command")) if c.place == 0]
    courses = [[run.numbers(c)[:PROBED_ROWS] for run in guess.runs[:PROBED_RUNS]] for c in seen]
    while guess.every > 1 and any(_is_lost(course, guess.every) for course in courses):
        guess.every = guess.every * 2 // 3
    used = "all are used, as they move from one to the next"
    if guess.every > 1:
        used = f"one of {guess.every} is used"
    yield f"{count} samples cost time: {used}; a window or fewer runs do better"


def _is_lost(runs: Sequence[Array], every: int) -> bool:
    """Whether lines between each n-th sample are off a column's course."""
    runs = [x[np.isfinite(x)] for x in runs]
    runs = [x for x in runs if len(x) > every]
    if not runs:
        return False
    low, high = np.quantile(np.concatenate(runs), [0.01, 0.99])
    rows = [np.arange(len(x)) for x in runs]
    off = [x - np.interp(k, k[::every], x[::every]) for k, x in zip(rows, runs, strict=True)]
    return bool(np.sqrt(np.mean(np.concatenate(off) ** 2)) > OFF_COURSE * (high - low) > 0.0)


RULES: tuple[Rule, ...] = (
    search,
    asked_parts,
    readable,
    joins,
    families,
    topics,
    exported_topics,
    headers,
    clock,
    long_form,
    splits,
    runs,
    other_clocks,
    order,
    *COLUMN_RULES,
    lists_of_runs,
    numbers_in_names,
    labels_in_names,
    facts_beside,
    repeats,
    uses,
    size,
)


def guess_study(folder: Path, parts: Sequence[str] = ()) -> Guess:
    """Look at the tables of a folder; nothing is asked, everything guessed is said.

    Args:
        folder: Folder with the user's files, or with folders of them.
        parts: Tables of each file that are used, the record first; empty: as they look.

    Raises:
        ValueError: no table that looks like a recording, or no such part.
    """
    guess = Guess(folder, parts)
    with np.errstate(over="ignore"):  # squares of what no sensor reads; it is compared alone
        for rule in RULES:
            guess.said += rule(guess) or ()
    return guess


def _path_words(run: GuessedRun) -> str:
    """Names of its folders and its file, without the ending."""
    path = Path(run.files[0])
    return "/".join([*path.parts[:-1], path.stem])


def _words_of(run: GuessedRun) -> dict[str, str]:
    """Its folders, and the words of its file's name, by what a fact of each may be called."""
    *folders, file = _path_words(run).split("/")
    words = re.split(r"[_\-\s]+", file)
    named = [("folder", one) for one in folders] + [("label", one) for one in words]
    kinds = [kind for kind, _ in named]
    return {
        f"{kind}_{kinds[:i].count(kind) + 1}" if kinds.count(kind) > 1 else kind: word
        for i, (kind, word) in enumerate(named)
    }


def _why_none(folder: Path) -> str:
    """That a folder has no table, and what it has."""
    there = sorted(path.name for path in folder.iterdir())
    packed = [name for name in there if Path(name).suffix.lower() in _PACKED]
    mend = f"unpack {packed[0]} first" if packed else ""
    mend = f"`python {folder / MAKER}` makes its files" if MAKER in there else mend
    expected = f"a table is a CSV file, or one of {', '.join(SUFFIXES)}"
    texts = (folder / name for name in there if Path(name).suffix.lower() in TABLES)
    if line := next(filter(None, map(last_line, texts)), ""):
        expected = (
            f"lines such as {line!r} are no rows; a table is a line of names above rows of nothing "
            "but numbers, dates and labels, with commas, semicolons, tabs or blanks between them"
        )
    return (
        f"{folder} has no table with rows of numbers, nor has a folder in it; it has "
        f"{', '.join(there[:8])}{', ...' if there[8:] else ''}: {mend or expected}"
    )


def _rank(family: Sequence[FoundTable]) -> tuple[int, bool, int]:
    """More runs first, then what sounds like a record, then what is larger."""
    looks = family[0].is_topic and bool(STATE.search(family[0].part))
    return len(family), looks, sum(one.size() for one in family)


def _begin_alike(run: GuessedRun, other: GuessedRun, channel: GuessedColumn) -> bool:
    """Whether a channel begins at about one value, or within its noise, as repeats do."""
    both = [v[np.isfinite(v)] for v in (run.numbers(channel), other.numbers(channel))]
    if not all(map(len, both)):
        return True
    apart = abs(both[0][0] - both[1][0])
    noise = _START_SD * (channel.sd or 0.0)
    return bool(apart <= max(_START * np.ptp(np.concatenate(both)), noise))


def _other_units(ours: Sequence[Column], theirs: Sequence[Column]) -> str:
    """Keys of ``columns`` for a file that has our columns, some in another unit; else empty."""
    if [c.base for c in ours] != [c.base for c in theirs]:
        return ""
    pairs = [(a, b) for a, b in zip(ours, theirs, strict=True) if a.name != b.name]
    if any(None in (a.unit, b.unit) for a, b in pairs):
        return ""
    return ", ".join(f"{b.base}: {{column: {b.name!r}, unit: {b.unit!r}}}" for _, b in pairs)


def _are_repeats(
    run: GuessedRun,
    other: GuessedRun,
    commands: Sequence[GuessedColumn],
    facts: Sequence[GuessedColumn],
) -> bool:
    if run.setup != other.setup or any(run.texts(c)[0] != other.texts(c)[0] for c in facts):
        return False
    for command in commands:
        a, b = run.numbers(command), other.numbers(command)
        n = min(len(a), len(b))
        if n < 0.8 * max(len(a), len(b)):
            return False
        apart = (a[:n] - b[:n])[np.isfinite(a[:n] - b[:n])]
        there = a[np.isfinite(a)]
        full = max(float(np.ptp(there)) if len(there) else 0.0, 1e-300)
        if not len(apart) or float(np.sqrt(np.mean(apart**2))) > _SAME * full:
            return False
    return True
