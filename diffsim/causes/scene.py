"""One run on its way to a simulator, and the five ports by which causes change it.

A cause acts on commands on their way to the actuators, on readings, on clocks, on numbers of the
system, or as a force at a place. A scene of any kind of system has all five, written here once:
each returns a changed copy. Signals are (..., width, num_times), one row for each command or
channel, points of the parameters in front. At size 0 a cause is the scene itself, also where its
response has a kink there.

A kind of system adds what its simulator needs beside, and ``simulate``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.channel_groups import delays_of
from diffsim.causes.signals import (
    Grid,
    SignalMap,
    after,
    change_rows,
    smoothly_delayed,
)
from diffsim.core.check import require_choice
from diffsim.core.checked import checked_methods
from diffsim.core.numbers import values_of
from diffsim.core.torch_names import is_in_forward_mode, is_in_func, on_constants
from diffsim.data.study import Command, Run

if TYPE_CHECKING:
    from typing_extensions import Self

PLAY_START = "play_start"  # number: where in a play of an instrument a run starts, -1 to 1


class LawFormula(Protocol):
    """A formula of ``diffsim.causes.ports.OF_FORCES``, on tensors and on plain numbers."""

    def __call__(self, values: Mapping[str, Tensor]) -> Tensor:
        """Its value, of the shape that position and speed have."""
        ...

    def on_floats(self, *names: str) -> Callable[..., float]:
        """The formula as a function of plain numbers."""
        ...


@dataclass(frozen=True, eq=False)
class ForceLaw:
    """A force of position, speed and usual speed, at a size."""

    formula: LawFormula
    size: Tensor  # () or (K,)
    shapes: tuple[Tensor, ...] = ()  # further numbers, likewise


@dataclass(frozen=True, eq=False)
class Instruments:
    """What instruments make of channels."""

    # channels by their indices, and what causes do to them, in the order in which they act: a map
    # of readings, or how late a clock is, () or (K,) [s]
    acts: tuple[tuple[tuple[int, ...], SignalMap | Tensor], ...] = ()

    @property
    def readings(self) -> tuple[tuple[tuple[int, ...], SignalMap], ...]:
        """Channels and the maps of their readings, in order."""
        return tuple((c, act) for c, act in self.acts if not isinstance(act, Tensor))

    @property
    def clocks(self) -> tuple[tuple[tuple[int, ...], Tensor], ...]:
        """Channels and how late they are [s]."""
        return tuple((c, act) for c, act in self.acts if isinstance(act, Tensor))

    def with_reading(self, channels: tuple[int, ...], change: SignalMap) -> Instruments:
        """A copy in which some channels are f(channels (..., width, num_times), grid)."""
        return replace(self, acts=(*self.acts, (channels, change)))

    def with_clock(self, channels: tuple[int, ...], delay: Tensor) -> Instruments:
        """A copy in which some channels show what was ``delay``, () or (K,), ago [s]."""
        return replace(self, acts=(*self.acts, (channels, delay)))

    @property
    def is_empty(self) -> bool:
        """Whether they show all as it is."""
        return not self.acts

    def num_points(self, num_channels: int) -> int:
        """Number of points K of what causes do; 0 where sizes have no axis of points.

        Args:
            num_channels: Number of channels that are read.
        """
        leads = [delay.shape for _, delay in self.clocks]
        for channels, change in self.readings:
            try_out = torch.zeros(len(channels) or num_channels, 2, dtype=torch.float64)
            leads.append(change(try_out, Grid.even(2, 1.0)).shape[:-2])
        return max((lead[0] for lead in leads if lead), default=0)

    def read(self, shown: Tensor, grid: Grid) -> Tensor:
        """What the instruments say, their clocks apart.

        Args:
            shown: What there is to be read, (..., num_samples, num_channels).
        """
        signals = shown.mT
        for channels, change in self.readings:
            signals = change_rows(signals, channels, change, grid)
        return signals.mT

    def read_late(self, shown: Tensor, grid: Grid) -> Tensor:
        """The same by clocks that are late, smooth between samples."""
        signals = self.read(shown, grid).mT
        for channels, delay in delays_of(self.clocks).items():
            signals = change_rows(signals, channels, _make_late(delay), grid)
        return signals.mT

    def read_in_order(self, shown: Tensor, grid: Grid) -> Tensor:
        """The same, what is late at its place among the other changes.

        Args:
            shown: What there is to be read, (..., num_samples, num_channels).
        """
        signals = shown.mT
        for channels, act in self.acts:
            change = _make_late(act) if isinstance(act, Tensor) else act
            signals = change_rows(signals, channels, change, grid)
        return signals.mT


@dataclass(frozen=True, eq=False)
class Commands:
    """Commands of a run, and what happens to them before the actuators hear them."""

    values: Tensor  # as recorded, (..., width, num_times), in the unit of each command
    rows: Mapping[str, tuple[int, ...]]  # rows of ``values`` that a name stands for
    # rows and the maps that change them, in the order in which they act
    changes: tuple[tuple[tuple[int, ...], Any], ...] = ()  # of SignalMap
    # values before the run, (width,), NaN where a row had its first one; None: all had
    before: Tensor | None = None

    @classmethod
    def named(
        cls,
        names: Sequence[str],
        values: Tensor,
        known: Iterable[Command] = (),
        usual: Mapping[str, float] = MappingProxyType({}),
    ) -> Commands:
        """A name for each row of the values; a name may stand for several, "" is no name.

        Args:
            values: (..., width, num_times).
            known: What the study says of its commands: their values before the run.
            usual: Of those of which it says nothing, where they had not their first ones.
        """
        rows = dict.fromkeys(name for name in names if name)
        found = {name: tuple(i for i, own in enumerate(names) if own == name) for name in rows}
        stated = {**usual, **{c.name: c.before for c in known if c.before is not None}}
        earlier = [stated.get(name, math.nan) for name in names]
        if all(map(math.isnan, earlier)):
            return cls(values, found)
        return cls(values, found, before=torch.tensor(earlier, dtype=torch.float64))

    def changed(self, names: Sequence[str], change: SignalMap) -> Commands:
        """The commands with one more map on their way.

        Args:
            names: Names of the commands; empty: all that have one.
            change: Function of them (..., width, num_times) and of the grid.

        Raises:
            ValueError: a name that no command has.
        """
        for name in names:
            require_choice("command", name, self.rows)
        every = {i for name in names or self.rows for i in self.rows[name]}
        if not every:
            return self
        return replace(self, changes=(*self.changes, (tuple(sorted(every)), change)))

    def heard(self, grid: Grid) -> Tensor:
        """What the actuators hear, (..., width, num_times)."""
        return self.pass_through(self.values, grid)

    def each_heard(self, grid: Grid) -> list[Tensor]:
        """The same row by row, (..., num_times) each: points of one row are not those of others."""
        changes = self.changes
        alike = self._find_alike() if changes else None
        if alike is not None:
            changes = tuple((rows, change.at_points(alike[0])) for rows, change in changes)
        rows = list(self.values.unbind(-2))
        for places, change in changes:
            parts = [places] if getattr(change, "is_joint", False) else [(k,) for k in places]
            for part in parts:
                given = torch.stack(torch.broadcast_tensors(*(rows[k] for k in part)), -2)
                changed = self.act(change, part, given, grid)
                for k, row in zip(part, changed.unbind(-2), strict=True):
                    rows[k] = row
        if alike is None:
            return rows
        return [row if row.ndim < 2 else row.index_select(0, alike[1]) for row in rows]

    def _find_alike(self) -> tuple[Tensor, Tensor] | None:
        """Points that differ in what changes the commands, and for each point which of these it is:
        most points of a linearization move other numbers. None: where that is not known."""
        # by their values, so where no slopes go with these
        if self.values.ndim != 2 or torch.is_grad_enabled() or is_in_func() or is_in_forward_mode():
            return None
        numbers: list[Tensor] = []
        for _, change in self.changes:
            own = getattr(change, "numbers", None)
            if own is None:
                return None
            numbers.extend(number for number in own if number.ndim > 1)
        if len({number.shape[:-1] for number in numbers}) != 1 or numbers[0].ndim != 2:
            return None
        keys = [row.tobytes() for row in torch.cat(numbers, -1).numpy()]
        first = dict(zip(reversed(keys), reversed(range(len(keys))), strict=True))
        place = {key: k for k, key in enumerate(first)}
        return torch.tensor(list(first.values())), torch.tensor([place[key] for key in keys])

    def act(self, change: SignalMap, rows: tuple[int, ...], u: Tensor, grid: Grid) -> Tensor:
        """What a change makes of commands, with what they were before the run.

        Args:
            change: Function of them and of the grid.
            u: Commands, (..., len(rows), num_times).
        """
        if self.before is None:
            return change(u, grid)
        return after(u, grid, change, self.before[list(rows)])

    def pass_through(self, values: Tensor, grid: Grid) -> Tensor:
        """What becomes of other values of the commands, such as those of a part of the run.

        Args:
            values: (..., width, num_times).
        """
        for rows, change in self.changes:
            values = change_rows(values, rows, partial(self.act, change, rows), grid)
        return values


_ZERO = torch.zeros((), dtype=torch.float64)
_NONE = Commands(torch.zeros(0, 0, dtype=torch.float64), {})


@checked_methods
@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """One run, ready to be simulated; causes return changed copies.

    Attributes:
        grid: Times of the commands, and of what instruments show [s].
        numbers: Numbers of the system by name, () or (K,) each at K points.
        zeros: Further numbers that causes may change, which are zero until one does.
        commands: What drives the system.
        forces: Place and law of each force that causes add, in order.
        instruments: What shows the channels.
    """

    grid: Grid
    numbers: Mapping[str, Tensor]
    zeros: Collection[str] = ()
    commands: Commands = _NONE
    forces: tuple[tuple[str, Any], ...] = ()
    instruments: Instruments = field(default_factory=Instruments)

    def simulate(self) -> Tensor:
        """Predicted channels, (num_samples, num_channels), with K in front for K points."""
        raise NotImplementedError

    @property
    def play_start(self) -> Tensor | None:
        """Where in a play the run starts, -1 to 1; None: not known, so in the middle."""
        return self.numbers.get(PLAY_START)

    def number(self, name: str) -> Tensor:
        """A number as it is in this run, () or (K,).

        Raises:
            ValueError: there is no such number.
        """
        if name in self.numbers:
            return self.numbers[name]
        if name not in self.zeros:
            require_choice("number", name, (*self.numbers, *self.zeros))
        return _ZERO

    def changed(self, **changes: Any) -> Self:
        """A copy with some entries replaced."""
        return replace(self, **changes)

    def with_command(self, names: tuple[str, ...], change: SignalMap) -> Self:
        """A copy in which some commands are f(commands (..., width, num_times), grid).

        Args:
            names: Names of the commands; empty: all.
            change: The function.
        """
        return replace(self, commands=self.commands.changed(names, change))

    def with_reading(self, channels: tuple[int, ...], change: SignalMap) -> Self:
        """A copy in which some channels are f(channels (..., width, num_times), grid).

        Args:
            channels: Their indices; empty: all.
            change: The function.
        """
        return replace(self, instruments=self.instruments.with_reading(channels, change))

    def with_clock(self, channels: tuple[int, ...], delay: Tensor) -> Self:
        """A copy in which some channels show what was ``delay`` ago.

        Args:
            channels: Their indices; empty: all.
            delay: () or (K,) [s].
        """
        return replace(self, instruments=self.instruments.with_clock(channels, delay))

    def with_number(self, name: str, change: Callable[[Tensor], Tensor]) -> Self:
        """A copy in which a number is f(number).

        Args:
            name: Name of the number.
            change: Function of its value, () or (K,).

        Raises:
            ValueError: there is no such number.
        """
        return replace(self, numbers={**self.numbers, name: change(self.number(name))})

    def with_force(self, place: str, law: ForceLaw) -> Self:
        """A copy with one more force.

        Args:
            place: Name of the place where it acts.
            law: Formula and size.
        """
        return replace(self, forces=(*self.forces, (place, law)))


def _make_late(delay: Tensor) -> SignalMap:
    return partial(smoothly_delayed, delay=delay[..., None])


def grid_of(run: Run) -> Grid:
    """Samples of a run and nothing in between."""
    return grid_at(torch.from_numpy(np.asarray(run.time_s, dtype=np.float64)))


def grid_at(times: Tensor) -> Grid:
    """Samples at times [s] and nothing in between."""
    times = values_of(times)  # data: within ``torch.func`` as outside
    with on_constants():
        return Grid(times, torch.arange(len(times)), times.numpy())
