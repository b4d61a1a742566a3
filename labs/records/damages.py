"""Faults of records, of drawn sizes: each makes a damaged copy of a sound folder, or cannot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from labs.records.rig import RUNS, Array, Folder, Tables
from labs.records.rigs import SOUND

TRIES = 30  # of a damage, until a rig is drawn that can have it
Rng = np.random.Generator
Channel = Mapping[str, Any]
FACTORS = (1000.0, 180.0 / np.pi, 60.0 / (2.0 * np.pi), 9.80665, 100.0)


@dataclass(frozen=True)
class Damage:
    """A kind of fault."""

    name: str  # short name
    remedy: str  # what the right remedy has in it, as a regular expression
    # the damaged copy; None where this folder cannot have it
    make: Callable[[Folder, Rng], Folder | None]


def _columns(folder: Folder) -> list[str]:
    return [str(c["column"]) for c in folder.study["channels"]]


def _commands(folder: Folder) -> list[str]:
    return [str(c["column"]) for c in folder.study["commands"]]


def _drawn(folder: Folder, rng: Rng) -> str:
    return str(rng.choice(_columns(folder)))


def _all(folder: Folder, change: Callable[[dict[str, Array]], dict[str, Array]]) -> Tables:
    return {run: change(dict(table)) for run, table in folder.tables.items()}


def _one(folder: Folder, run: str, **columns: Array) -> Tables:
    return {**folder.tables, run: {**folder.tables[run], **columns}}


def _span(folder: Folder, column: str) -> tuple[float, float]:
    values = np.concatenate([t[column] for t in folder.tables.values()])
    return float(values.min()), float(values.max())


def _is_whole(folder: Folder, column: str) -> bool:
    return all((t[column] == np.round(t[column])).all() for t in folder.tables.values())


def wrapped_counts(folder: Folder, rng: Rng) -> Folder | None:
    """Counts modulo a power of two."""
    column = _drawn(folder, rng)
    low, high = _span(folder, column)
    if not _is_whole(folder, column):
        return None
    fits = [p for p in (1024.0, 2048.0, 4096.0, 8192.0, 16384.0, 65536.0) if p > high - low]
    period = float(rng.choice(fits[:3]))
    off = np.round(period - rng.uniform(0.3, 0.7) * (high - low) - low)
    half = 0.0 if rng.random() < 0.7 else period / 2.0
    return folder.changed(
        _all(folder, lambda t: {**t, column: np.mod(t[column] + off, period) - half})
    )


def wrapped_angle(folder: Folder, rng: Rng) -> Folder | None:
    """An angle modulo a turn."""
    column = _drawn(folder, rng)
    if not column.startswith("angle") and column not in ("present_deg",):
        return None
    period = 360.0 if column.endswith("_deg") else 2.0 * np.pi
    low, high = _span(folder, column)
    if high - low > 0.9 * period:
        return None
    half = 0.0 if rng.random() < 0.5 else period / 2.0
    off = period - rng.uniform(0.3, 0.7) * (high - low) - low
    return folder.changed(
        _all(folder, lambda t: {**t, column: np.mod(t[column] + off, period) - half})
    )


def sign_bit(folder: Folder, rng: Rng) -> Folder | None:
    """Sign and size in a word."""
    column = _drawn(folder, rng)
    low, high = _span(folder, column)
    if not _is_whole(folder, column) or low >= 0.0:
        return None
    least = int(np.ceil(np.log2(max(-low, high) + 1.0)))
    bit = int(rng.choice([b for b in (10, 11, 12, 15, 23) if b >= least]))
    return folder.changed(
        _all(
            folder,
            lambda t: {**t, column: np.where(t[column] < 0.0, 2.0**bit - t[column], t[column])},
        ),
    )


def read_unsigned(folder: Folder, rng: Rng) -> Folder | None:
    """A two's complement read without its sign."""
    column = _drawn(folder, rng)
    low, _ = _span(folder, column)
    if not _is_whole(folder, column) or low >= 0.0:
        return None
    bits = int(rng.choice([12, 16, 24]))
    return folder.changed(_all(folder, lambda t: {**t, column: np.mod(t[column], 2.0**bits)}))


def folded(folder: Folder, rng: Rng) -> Folder | None:
    """A size without its sign."""
    column = _drawn(folder, rng)
    low, high = _span(folder, column)
    if low > -0.3 * high or high < -0.3 * low or not folder.study["commands"]:
        return None
    return folder.changed(_all(folder, lambda t: {**t, column: np.abs(t[column])}))


def copied_column(folder: Folder, rng: Rng) -> Folder | None:
    """A channel whose column is a copy of another one, perhaps scaled."""
    column = _drawn(folder, rng)
    others = [c for c in (*_commands(folder), *_columns(folder)) if c != column]
    if not others:
        return None
    other = str(rng.choice(others))
    times = float(rng.choice([1.0, 1.0, 0.5, 10.0, -2.0]))
    return folder.changed(_all(folder, lambda t: {**t, column: times * t[other]}))


def law_of_controller(folder: Folder, rng: Rng) -> Folder | None:
    """A torque that was computed from goal and angle, and not measured."""
    if folder.rig != "arm":
        return None
    kp, kd = rng.uniform(20.0, 100.0), rng.uniform(0.0, 3.0)

    def change(t: dict[str, Array]) -> dict[str, Array]:
        q = t["angle_rad"]
        speed = np.append(0.0, np.diff(q)) / 0.01
        return {**t, "torque_Nm": kp * (t["goal_rad"] - q) - kd * speed}

    return folder.changed(_all(folder, change))


def higher_rate(folder: Folder, rng: Rng) -> Folder | None:
    """Rows on straight lines between those that were recorded."""
    if folder.rig == "bench":
        return None
    n = int(rng.integers(2, 9))
    kept = [*_columns(folder), *(_commands(folder) if rng.random() < 0.5 else ())]

    def change(t: dict[str, Array]) -> dict[str, Array]:
        rows = np.arange(len(t["time_s"]))
        old = rows[::n]
        lines = {c: np.interp(rows, old, t[c][::n]) for c in kept}
        return {**t, **lines}

    return folder.changed(_all(folder, change))


def slow_sensor(folder: Folder, rng: Rng) -> Folder | None:
    """A sensor that is slower than the rows: its readings are repeated until the next."""
    if folder.rig == "bench" or len(_columns(folder)) + len(_commands(folder)) < 2:
        return None
    column, rate = _drawn(folder, rng), rng.uniform(2.0, 8.0)

    def change(t: dict[str, Array]) -> dict[str, Array]:
        last = np.floor(np.floor(np.arange(len(t["time_s"])) / rate) * rate).astype(np.int64)
        return {**t, column: t[column][last]}

    return folder.changed(_all(folder, change))


def equal_stamps(folder: Folder, rng: Rng) -> Folder | None:
    """Rows that came twice, or a clock that counts too coarsely."""
    run = str(rng.choice(RUNS[:3]))
    t = dict(folder.tables[run])
    if rng.random() < 0.5:
        at = np.sort(rng.choice(len(t["time_s"]) - 1, int(rng.integers(1, 12)), replace=False))
        return folder.changed(
            {**folder.tables, run: {n: np.insert(c, at + 1, c[at]) for n, c in t.items()}}
        )
    tick = float(np.diff(t["time_s"])[0]) * rng.uniform(2.0, 6.0)
    return folder.changed(_one(folder, run, time_s=tick * np.floor(t["time_s"] / tick)))


def missing_stamps(folder: Folder, rng: Rng) -> Folder | None:
    """Cells of the clock that are empty."""
    run = str(rng.choice(RUNS[:3]))
    time = folder.tables[run]["time_s"].copy()
    time[rng.choice(np.arange(1, len(time) - 1), int(rng.integers(1, 20)), replace=False)] = np.nan
    return folder.changed(_one(folder, run, time_s=time))


def out_of_order(folder: Folder, rng: Rng) -> Folder | None:
    """Rows that were written later than others."""
    run = str(rng.choice(RUNS[:3]))
    order = np.arange(len(folder.tables[run]["time_s"]))
    for k in rng.choice(np.arange(1, len(order) - 6), int(rng.integers(1, 6)), replace=False):
        order[k : k + 2] = order[k : k + 2][::-1]
    table = {n: c[order] for n, c in folder.tables[run].items()}
    return folder.changed({**folder.tables, run: table})


def clock_set(folder: Folder, rng: Rng) -> Folder | None:
    """A clock that was set by an hour, or a minute, on or back."""
    run = str(rng.choice(RUNS[:3]))
    time = folder.tables[run]["time_s"].copy()
    jump = float(rng.choice([3600.0, -3600.0, 7200.0]))
    if abs(jump) < 200.0 * np.diff(time)[0]:
        return None
    time[int(rng.integers(len(time) // 5, 4 * len(time) // 5)) :] += jump
    return folder.changed(_one(folder, run, time_s=time))


def _lost(folder: Folder, rng: Rng) -> tuple[str, NDBool] | None:
    """A fit run whose command moves, and which rows are lost there."""
    if folder.rig == "bench" or not folder.study["commands"]:
        return None
    run, column = str(rng.choice(["a", "b"])), _commands(folder)[0]
    u = folder.tables[run][column]
    count = int(rng.integers(5, 25))
    moved = np.abs(u[count:] - u[:-count])
    there = np.flatnonzero(moved > 0.25 * np.ptp(u))
    there = there[(there > 10) & (there < len(u) - count - 10)]
    if not len(there):
        return None
    start = int(rng.choice(there))
    keep = np.ones(len(u), dtype=bool)
    keep[start + 1 : start + count] = False
    return run, keep


NDBool = Any


def dropped_rows(folder: Folder, rng: Rng) -> Folder | None:
    """Rows that are lost while a command moves; their stamps say so."""
    if (found := _lost(folder, rng)) is None:
        return None
    run, keep = found
    return folder.changed(
        {**folder.tables, run: {n: c[keep] for n, c in folder.tables[run].items()}}
    )


def dropped_unstamped(folder: Folder, rng: Rng) -> Folder | None:
    """Rows that are lost from files whose clock counts rows."""
    if (found := _lost(folder, rng)) is None:
        return None
    run, keep = found
    step = float(np.diff(folder.tables[run]["time_s"])[0])
    tables = {**folder.tables, run: {n: c[keep] for n, c in folder.tables[run].items()}}
    tables = {r: {n: c for n, c in t.items() if n != "time_s"} for r, t in tables.items()}
    return folder.changed(tables, time={"step": step})


def flat_tops(folder: Folder, rng: Rng) -> Folder | None:
    """A sensor that shows no more than this."""
    if folder.rig in ("bench", "servo", "servo_at_zero"):
        return None
    column = _drawn(folder, rng)
    values = np.concatenate([t[column] for t in folder.tables.values()])
    top = float(f"{np.quantile(values, rng.uniform(0.75, 0.95)):.3g}")
    return folder.changed(_all(folder, lambda t: {**t, column: np.minimum(t[column], top)}))


def far_values(folder: Folder, rng: Rng) -> Folder | None:
    """Values far outside of all others, at many rows or few."""
    column, run = _drawn(folder, rng), str(rng.choice(RUNS[:3]))
    low, high = _span(folder, column)
    x = folder.tables[run][column].copy()
    count = max(1, int(rng.choice([0.004, 0.02, 0.06, 0.15]) * len(x)))
    at = rng.choice(np.arange(2, len(x) - 2), count, replace=False)
    if rng.random() < 0.3:  # a burst of them
        at = int(rng.integers(4, len(x) - count - 4)) + np.arange(count)
    middle = 0.5 * (low + high)
    x[at] = middle + rng.choice([-1.0, 1.0], count) * (high - low) * rng.uniform(3.0, 30.0, count)
    x = np.round(x) if _is_whole(folder, column) else x
    return folder.changed(_one(folder, run, **{column: x}))


def missing_as_number(folder: Folder, rng: Rng) -> Folder | None:
    """Values that were not measured, written as a number."""
    column = _drawn(folder, rng)
    low, high = _span(folder, column)
    codes = [c for c in (-1.0, 0.0, -999.0, 9999.0, -99.0, 65535.0, -32768.0)
             if c < low - 0.3 * (high - low) or c > high + 0.3 * (high - low)]  # fmt: skip
    if not codes:
        return None
    code = float(rng.choice(codes))

    def change(t: dict[str, Array]) -> dict[str, Array]:
        x = t[column].copy()
        for start in rng.choice(len(x) - 12, int(rng.integers(1, 6)), replace=False):
            x[start : start + int(rng.integers(1, 12))] = code
        return {**t, column: x}

    return folder.changed(_all(folder, change))


def frozen(folder: Folder, rng: Rng) -> Folder | None:
    """A channel that stands still for a part of a run."""
    if folder.rig == "bench":
        return None
    column, run = _drawn(folder, rng), str(rng.choice(["a", "b"]))
    x = folder.tables[run][column].copy()
    count = int(rng.uniform(0.08, 0.3) * len(x))
    start = int(rng.integers(20, len(x) - count))
    x[start : start + count] = x[start]
    return folder.changed(_one(folder, run, **{column: x}))


def unit_of_run(folder: Folder, rng: Rng) -> Folder | None:
    """One run in another unit."""
    column, run = _drawn(folder, rng), str(rng.choice(RUNS[:3]))
    times = float(rng.choice(FACTORS)) ** float(rng.choice([-1.0, 1.0]))
    return folder.changed(_one(folder, run, **{column: times * folder.tables[run][column]}))


def turned_in_run(folder: Folder, rng: Rng) -> Folder | None:
    """A channel with a turned sign in one run of any use."""
    column, run = _drawn(folder, rng), str(rng.choice(RUNS))
    return folder.changed(_one(folder, run, **{column: -folder.tables[run][column]}))


def late_in_run(folder: Folder, rng: Rng) -> Folder | None:
    """Channels whose clock is late in one run of any use."""
    run = str(rng.choice(RUNS))
    table = folder.tables[run]
    rows = int(rng.uniform(0.04, 0.15) * len(table["time_s"]))
    before = {c: table[c][rows:0:-1] for c in _columns(folder)}  # it moved before, somehow
    late = {c: np.concatenate([x, table[c]])[: len(table[c])] for c, x in before.items()}
    return folder.changed(_one(folder, run, **late)) if _commands(folder) else None


def exchanged_in_run(folder: Folder, rng: Rng) -> Folder | None:
    """Two channels whose columns are exchanged in one run of any use."""
    names, run = _columns(folder), str(rng.choice(RUNS))
    if len(names) < 2:
        return None
    a, b = (str(n) for n in rng.choice(names, 2, replace=False))
    table = folder.tables[run]
    return folder.changed(_one(folder, run, **{a: table[b], b: table[a]}))


def doubled_rows(folder: Folder, rng: Rng) -> Folder | None:
    """Each row of a run twice, or a stretch of rows once more, under stamps that go on."""
    run = str(rng.choice(RUNS))
    table, count = folder.tables[run], len(folder.tables[run]["time_s"])
    first, length = int(rng.uniform(0.2, 0.6) * count), int(rng.uniform(0.05, 0.2) * count)
    again = [*range(first + length), *range(first, count)]
    rows = np.repeat(np.arange(count), 2) if rng.random() < 0.5 else np.array(again)
    times = np.diff(table["time_s"])[0] * np.arange(len(rows))
    return folder.changed(
        _one(folder, run, **{n: v[rows] for n, v in table.items()} | {"time_s": times})
    )


def unit_half_way(folder: Folder, rng: Rng) -> Folder | None:
    """A unit that changes within a run."""
    if folder.rig == "bench":
        return None
    column, run = _drawn(folder, rng), str(rng.choice(["a", "b"]))
    x = folder.tables[run][column].copy()
    times = float(rng.choice(FACTORS)) ** float(rng.choice([-1.0, 1.0]))
    x[int(rng.uniform(0.3, 0.7) * len(x)) :] *= times
    return folder.changed(_one(folder, run, **{column: x}))


def one_file_twice(folder: Folder, rng: Rng) -> Folder | None:
    """A run that is another one under a second name, perhaps a part of it."""
    source, copy = (str(r) for r in rng.choice(RUNS, 2, replace=False))
    table = dict(folder.tables[source])
    if rng.random() < 0.5:
        table = {n: c[: int(0.7 * len(c))] for n, c in table.items()}
    return folder.changed({**folder.tables, copy: table})


def shifted_cells(folder: Folder, rng: Rng) -> Folder | None:
    """Cells that stand one column further on, from some row of a run."""
    names = [*_commands(folder), *_columns(folder)]
    if len(names) < 2 or folder.rig == "bench":
        return None
    run = str(rng.choice(["a", "b"]))
    table = {n: c.copy() for n, c in folder.tables[run].items()}
    row = int(rng.uniform(0.3, 0.7) * len(table["time_s"]))
    order = [n for n in table if n != "time_s"]
    if not len({round(np.log10(np.ptp(table[n]) + 1e-9)) for n in order}) > 1:
        return None  # columns of one size: it takes the model
    for name, before in zip(order, (order[-1], *order[:-1]), strict=True):
        table[name][row:] = folder.tables[run][before][row:]
    return folder.changed({**folder.tables, run: table})


def drifting_clocks(folder: Folder, rng: Rng) -> Folder | None:
    """Commands and channels in files of their own, whose clocks run apart."""
    if folder.rig == "bench" or not folder.study["commands"]:
        return None
    ppm = float(rng.choice([-1.0, 1.0])) * rng.uniform(0.02, 0.06)
    measured, tables = _columns(folder), {}
    for run, t in folder.tables.items():
        tables[run] = {n: c for n, c in t.items() if n not in measured}
        own = {n: t[n] for n in measured}
        tables[f"{run}_sensor"] = {"time_s": t["time_s"] * (1.0 + ppm), **own}
    runs = [
        {**r, "file": [f"{r['name']}_sensor.csv", f"{r['name']}.csv"]} for r in folder.study["runs"]
    ]
    return folder.changed(tables, runs=runs)


def marker_moved(folder: Folder, rng: Rng) -> Folder | None:
    """A reading that jumps and stays, as of a marker that slipped."""
    column, run = _drawn(folder, rng), str(rng.choice(["a", "b"]))
    low, high = _span(folder, column)
    if folder.rig == "bench":
        return None
    x = folder.tables[run][column].copy()
    jump = rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 0.8) * (high - low)
    jump = np.round(jump) if _is_whole(folder, column) else jump
    x[int(rng.uniform(0.2, 0.8) * len(x)) :] += jump
    return folder.changed(_one(folder, run, **{column: x}))


def other_unit(folder: Folder, rng: Rng) -> Folder | None:
    """A channel in another unit than its command, though the study says the same."""
    channel, command = folder.study["channels"][0], folder.study["commands"]
    if not command or channel["unit"] != command[0]["unit"] or folder.rig == "plate":
        return None
    times = float(rng.choice([1000.0, 180.0 / np.pi])) ** float(rng.choice([-1.0, 1.0]))
    return folder.changed(
        _all(folder, lambda t: {**t, channel["column"]: times * t[channel["column"]]})
    )


def unit_everywhere(folder: Folder, rng: Rng) -> Folder | None:
    """A column in another unit in all runs, which only the model can tell."""
    column = str(rng.choice([*_columns(folder), *_commands(folder)]))
    times = float(rng.choice(FACTORS[:3])) ** float(rng.choice([-1.0, 1.0]))
    return folder.changed(_all(folder, lambda t: {**t, column: times * t[column]}))


def exchanged(folder: Folder, rng: Rng) -> Folder | None:
    """Two columns whose names are exchanged in all runs."""
    pairs = [names for names in (_columns(folder), _commands(folder)) if len(names) > 1]
    if not pairs:
        return None
    a, b = rng.choice(pairs[int(rng.integers(len(pairs)))], 2, replace=False)
    return folder.changed(_all(folder, lambda t: {**t, a: t[b], b: t[a]}))


DAMAGES = (
    Damage("wrapped_counts", r"wrap: |signed: ", wrapped_counts),
    Damage("wrapped_angle", r"wrap: ", wrapped_angle),
    Damage("sign_bit", r"sign_bit: ", sign_bit),
    Damage("read_unsigned", r"signed: |wrap: ", read_unsigned),
    Damage("folded", r"folded: ", folded),
    Damage("copied_column", r"`column:`", copied_column),
    Damage("law_of_controller", r"channels", law_of_controller),
    Damage("higher_rate", r"every: ", higher_rate),
    Damage("slow_sensor", r"repeats: drop", slow_sensor),
    Damage("equal_stamps", r"duplicates: ", equal_stamps),
    Damage("missing_stamps", r"missing: line", missing_stamps),
    Damage("out_of_order", r"backward: sort", out_of_order),
    Damage("clock_set", r"jumps: close", clock_set),
    Damage("dropped_rows", r"gaps: line", dropped_rows),
    Damage("dropped_unstamped", r"lost_rows: ", dropped_unstamped),
    Damage("flat_tops", r"ranges: ", flat_tops),
    Damage("far_values", r"valid: ", far_values),
    Damage("missing_as_number", r"missing: ", missing_as_number),
    Damage("frozen", r"missing_if: ", frozen),
    Damage("unit_of_run", r"unit: |scale: |formula: ", unit_of_run),
    Damage("turned_in_run", r"\*\(-1\)", turned_in_run),
    Damage("late_in_run", r"clocks of its file", late_in_run),
    Damage("exchanged_in_run", r"exchanged", exchanged_in_run),
    Damage("doubled_rows", r"mend the file", doubled_rows),
    Damage("unit_half_way", r"formula: ", unit_half_way),
    Damage("one_file_twice", r"leave it out|leave\s+one out", one_file_twice),
    Damage("shifted_cells", r"until_s: ", shifted_cells),
    Damage("drifting_clocks", r"drift: ", drifting_clocks),
    Damage("marker_moved", r"formula: |until_s: ", marker_moved),
    Damage("other_unit", r"unit: |scale: |`unit:`", other_unit),
    Damage("unit_everywhere", r"unit: |scale: |`unit:`", unit_everywhere),
    Damage("exchanged", r"`column:` of \w+ \w+ names the column of", exchanged),
)


def damaged(rng: Rng, damage: Damage) -> tuple[Folder, Folder] | None:
    """A drawn sound rig and its damaged copy; None where no rig was drawn that can have it."""
    for _ in range(TRIES):
        sound = SOUND[int(rng.integers(len(SOUND)))](rng)
        if (copy := damage.make(sound, rng)) is not None:
            return sound, copy
    return None
