"""Channels and commands as the files hold them: what the rules of the record look at."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from diffsim.core.arrays import Array, IntArray
from diffsim.data.signal import ROUND, scatter, step_of
from diffsim.data.study import Channel, Command, Run, Study

FOLLOWS = 0.4  # least correlation of ranks with a command: who misses one goal of four has half
PROBES = 20_000  # samples that tell it
FEW = 12  # samples of which a rule can tell nothing


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of a signal in one run, those that are not finite left out."""

    run: str  # name of the run
    at: IntArray  # places in the run, (num,)
    times: Array  # times of the samples, (num,) [s]
    values: Array  # (num,) as the file has them

    def __len__(self) -> int:
        return len(self.values)

    @cached_property
    def changes(self) -> Array:
        """(num - 1,)."""
        return np.diff(self.values)

    @cached_property
    def low(self) -> float:
        """Least value."""
        return float(self.values.min())

    @cached_property
    def high(self) -> float:
        """Largest value."""
        return float(self.values.max())

    @property
    def range(self) -> float:
        """From the least to the largest value."""
        return self.high - self.low

    @cached_property
    def largest_change(self) -> float:
        """From sample to sample."""
        return float(np.abs(self.changes).max(initial=0.0))

    @cached_property
    def usual_change(self) -> float:
        """Median of the changes that are not nothing; 0 of a constant."""
        moved = np.abs(self.changes)
        moved = moved[moved > ROUND * self.range]
        return float(np.median(moved)) if len(moved) else 0.0

    @cached_property
    def noise(self) -> float:
        """Scatter from sample to sample, blind to slow motion."""
        return float(scatter(np.diff(self.changes), 2)) if len(self) > 2 else 0.0

    @cached_property
    def shares_equal(self) -> float:
        """Share of samples that equal the one before."""
        return float(np.mean(self.changes == 0.0)) if len(self) > 1 else 0.0

    @cached_property
    def digit(self) -> float:
        """Smallest difference of two values: of the sensor, a converter or the file; 0 of none."""
        gaps = np.diff(np.unique(self.values))
        gaps = gaps[gaps > 1e-12 * max(abs(self.low), abs(self.high))]
        return float(gaps.min()) if len(gaps) else 0.0

    @cached_property
    def step(self) -> float | None:
        """Step on whole numbers of which all values lie; None: there is none."""
        return step_of(self.values)

    def around(self, k: int, width: int = 3) -> Array:
        """Changes near the k-th, that one left out."""
        return np.concatenate(
            [self.changes[max(k - width, 0) : k], self.changes[k + 1 : k + 1 + width]]
        )


@dataclass(frozen=True, eq=False)
class Signal:
    """A channel or a command."""

    name: str
    role: str  # "channel" or "command"
    column: str  # column of the files; the name, where a formula has several
    unit: str | None  # SI unit of the channel or command; None: not stated
    runs: tuple[Samples, ...]
    # SI value of one in the file's unit, where it is a multiple; None: it is not
    scale: float | None = 1.0
    sd: float = 0.0  # noise that is stated, in the file's unit; 0: none
    is_measured: bool = True  # whether it was measured

    @property
    def where(self) -> str:
        """What messages call it."""
        return f"{self.role} {self.name}"

    @cached_property
    def all_values(self) -> Array:
        """Of all runs."""
        return np.concatenate([s.values for s in self.runs] or [np.empty(0)])

    @cached_property
    def low(self) -> float:
        """Least value of all runs."""
        return min((s.low for s in self.runs), default=0.0)

    @cached_property
    def high(self) -> float:
        """Largest value of all runs."""
        return max((s.high for s in self.runs), default=0.0)

    @property
    def range(self) -> float:
        """From the least to the largest value."""
        return self.high - self.low

    @cached_property
    def whole_step(self) -> float | None:
        """Number of which all values are whole multiples; None: there is none."""
        values = self.all_values
        if len(values) and (values == np.round(values)).all():
            return 1.0
        step = step_of(values)
        if step is None:
            return None
        places = values / step
        return step if np.abs(places - np.round(places)).max() < 0.1 else None

    def of_run(self, name: str) -> Samples | None:
        """Its samples in a run."""
        return next((s for s in self.runs if s.run == name), None)


@dataclass(frozen=True, eq=False)
class Record:
    """A study as its rules see it.

    Attributes:
        channels: What was measured.
    """

    study: Study
    channels: tuple[Signal, ...]
    commands: tuple[Signal, ...]

    @classmethod
    def of(cls, study: Study) -> Record:
        """The record of a study."""
        runs = [run for run in study.runs if run.measured.shape[1:] == (len(study.channels),)]
        known = {c.name: c for c in study.commands}
        names = dict.fromkeys(name for run in runs for name in run.command)
        return cls(
            study,
            tuple(_of_channel(runs, i, c) for i, c in enumerate(study.channels)),
            tuple(_of_command(runs, known.get(name, Command(name))) for name in names),
        )

    @property
    def signals(self) -> Iterator[Signal]:
        """Channels, then commands."""
        yield from (*self.channels, *self.commands)

    def run(self, name: str) -> Run:
        """A run by its name."""
        return next(run for run in self.study.runs if run.name == name)

    def command_of(self, channel: Signal) -> Signal | None:
        """The command that a channel follows, by their ranks; None: it follows none."""
        found = [(_likeness(channel, command), k) for k, command in enumerate(self.commands)]
        best, place = max(found, default=(0.0, 0))
        return self.commands[place] if best > FOLLOWS else None

    def moving(self, run: str, start: float, end: float, but: Signal, last: float) -> Signal | None:
        """A signal that moves from one time of a run to another, by a tenth of its range or more,
        and does a tenth of that before a last time: what moves only then ends a rest.

        Commands go first.
        """
        for signal in (*self.commands, *self.channels):
            samples = signal.of_run(run)
            if signal is but or samples is None or not signal.range > 0.0:
                continue
            there = (samples.times >= start) & (samples.times <= end)
            part, before = samples.values[there], samples.values[there & (samples.times <= last)]
            moves = np.ptp(part) if len(before) else 0.0
            if moves > 0.1 * signal.range and np.ptp(before) > 0.1 * moves:
                return signal
        return None


def _likeness(a: Signal, b: Signal) -> float:
    """Correlation of the ranks of two signals, over all runs."""
    pairs = [(x.values, y.values) for x in a.runs if (y := b.of_run(x.run)) and len(x) == len(y)]
    if not pairs:
        return 0.0
    first, second = (np.concatenate(values) for values in zip(*pairs, strict=True))
    probe = slice(None, None, max(len(first) // PROBES, 1))
    ranks = np.argsort(np.argsort([first[probe], second[probe]], axis=1), axis=1)
    return float(np.asarray(np.corrcoef(ranks))[0, 1]) if ranks.shape[1] > FEW else 0.0


def _of_channel(runs: Sequence[Run], at: int, channel: Channel) -> Signal:
    column, given, scale = _as_recorded(runs, channel.name, [run.measured[:, at] for run in runs])
    sd = (channel.sd or 0.0) / abs(scale) if scale else 0.0
    return Signal(channel.name, "channel", column, channel.unit, _samples(runs, given), scale, sd)


def _of_command(runs: Sequence[Run], command: Command) -> Signal:
    runs = [
        run
        for run in runs
        if run.command.get(command.name, run.time_s[:0]).shape == run.time_s.shape
    ]
    used = [run.command[command.name] for run in runs]
    column, given, scale = _as_recorded(runs, command.name, used)
    return Signal(
        command.name,
        "command",
        column,
        command.unit,
        _samples(runs, given),
        scale,
        is_measured=command.is_measured,
    )


def _as_recorded(
    runs: Sequence[Run], name: str, used: Sequence[Array]
) -> tuple[str, list[Array], float | None]:
    """Column of a quantity, its values there by run, and the scale of what is used of it; what is
    used itself where runs have it in columns of different names, or in none."""
    raw = [run.raw.get(name) for run in runs]
    if len({None if r is None else r[0] for r in raw}) != 1:
        raw = [None] * len(raw)
    given = [values if r is None else r[1] for values, r in zip(used, raw, strict=True)]
    column = raw[0][0] if raw and raw[0] is not None else name
    return column, given, _scale(list(zip(given, used, strict=True)))


def _samples(runs: Sequence[Run], given: Sequence[Array]) -> tuple[Samples, ...]:
    out = []
    for run, values in zip(runs, given, strict=True):
        at = np.flatnonzero(np.isfinite(values))
        if len(at):
            out.append(Samples(run.name, at, run.time_s[at], values[at]))
    return tuple(out)


def _scale(pairs: Sequence[tuple[Array, Array]]) -> float | None:
    """Slope of the values in SI units against those of the files, where they lie on a line."""
    for raw, si in pairs:
        if raw is si:
            return 1.0
        good = np.isfinite(raw) & np.isfinite(si)
        if good.sum() < 2 or not np.ptp(raw[good]) > 0.0:
            continue
        x, y = raw[good], si[good]
        low, high = int(np.argmin(x)), int(np.argmax(x))
        slope = float((y[high] - y[low]) / (x[high] - x[low]))
        off = y - y[low] - slope * (x - x[low])
        return slope if np.abs(off).max() <= 1e-6 * np.ptp(y) else None
    return None
