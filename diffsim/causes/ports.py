"""Five ports that the scene of a run may offer to causes, and how a row acts through each.

A scene is whatever a model has made of a run. It offers a port by having the method:

- ``with_command(names, change)``: commands on their way to the actuators;
- ``with_reading(channels, change)``: what channels show, by their indices;
- ``with_clock(channels, delay)``: how late channels are;
- ``with_number(name, change)``: a number of the system;
- ``with_force(place, law)``: a force at a place.

Each returns a changed copy. Names and channels may be empty: all that the system has. Signals are
(..., width, num_times): one row for each command or channel, points of the parameters in front. At
size 0 a cause is the scene itself, also where its response has a kink there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, Protocol

import torch
from torch import Tensor

from diffsim.causes.row import ANY, Row
from diffsim.causes.signals import MAPS, Between, Grid, SignalMap, SizedMap
from diffsim.core.expression import Expression, parse_expression
from diffsim.data.study import Run
from diffsim.identify.effect import Apply

PLAY = "with_play"  # the map that depends on where a run starts
OF_SIGNALS = ("u", "size", "t")  # names of a formula that maps signals
OF_FORCES = ("size", "x", "v", "w")  # size, position, speed, speed below which friction fades


class TakesCommands(Protocol):
    """A scene whose commands can be changed on their way."""

    def with_command(self, names: tuple[str, ...], change: SignalMap) -> Any:
        """A copy in which some commands are f(commands (..., width, num_times), grid)."""
        ...


class TakesReadings(Protocol):
    """A scene whose readings can be changed."""

    def with_reading(self, channels: tuple[int, ...], change: SignalMap) -> Any:
        """A copy in which some channels are f(channels (..., width, num_times), grid)."""
        ...


class TakesClocks(Protocol):
    """A scene whose channels may be late."""

    def with_clock(self, channels: tuple[int, ...], delay: Tensor) -> Any:
        """A copy in which some channels show what was ``delay``, () or (K,), ago [s]."""
        ...


class TakesNumbers(Protocol):
    """A scene with numbers that can be changed."""

    def with_number(self, name: str, change: Callable[[Tensor], Tensor]) -> Any:
        """A copy in which a number is f(number)."""
        ...


class LawFormula(Protocol):
    """A formula of ``OF_FORCES``, on tensors and on plain numbers."""

    def __call__(self, values: Mapping[str, Tensor]) -> Tensor:
        """Its value, of the shape that position and speed have."""
        ...

    def on_floats(self, *names: str) -> Callable[..., float]:
        """The formula as a function of plain numbers."""
        ...


@dataclass(frozen=True, eq=False)
class ForceLaw:
    """A force of position, speed and usual speed, at a size.

    Attributes:
        formula: Formula of ``OF_FORCES``.
        size: () or (K,).
    """

    formula: LawFormula
    size: Tensor


class TakesForces(Protocol):
    """A scene with places at which forces may act."""

    def with_force(self, place: str, law: ForceLaw) -> Any:
        """A copy with one more force at a place."""
        ...


@dataclass(frozen=True, eq=False)
class SignalChange:
    """A map of signals at a size: f(signals (..., width, num_times), grid).

    Attributes:
        map: Function (signals, grid, size).
        size: (..., 1), or (..., width) where each signal has its own.
        is_kinked: Whether the map has a kink at size 0.
    """

    map: SizedMap
    size: Tensor
    is_kinked: bool = False

    def __call__(self, u: Tensor, grid: Grid) -> Tensor:
        changed = self.map(u, grid, self.size)
        if not self.is_kinked:
            return changed
        return torch.where(self.size[..., None] != 0.0, changed, u)

    @property
    def is_none(self) -> bool:
        """Whether it leaves all signals as they are."""
        return not bool(self.size.detach().any())


@dataclass(frozen=True, eq=False)
class SignalMapper:
    """What a row does to signals, before a scene and a size are known.

    Attributes:
        map: Function (signals, grid, size).
        is_kinked: Whether the map has a kink at size 0.
        has_start: Whether it depends on where the run starts in a play.
    """

    map: SizedMap
    is_kinked: bool
    has_start: bool

    @classmethod
    def of(
        cls,
        row: Row,
        scales: Mapping[str, float],
        between: Between = "straight",
        system: str = ANY,
    ) -> SignalMapper:
        """Of the map of signals that a row names or writes as a formula.

        Args:
            row: Cause of commands or readings.
            scales: Numbers that the formula may use, by name.
            between: What a command does between samples.
            system: Kind of system.

        Raises:
            ValueError: a formula with names that there are not.
        """
        text: str = row.said("map", system)
        if text in MAPS:
            return cls(MAPS[text][between], row.kink, text == PLAY)
        formula = parse_expression(text, (*OF_SIGNALS, *scales))
        used = tuple((n, scales[n]) for n in sorted(formula.names) if n not in OF_SIGNALS)
        return cls(partial(_evaluate, text=text, scales=used), row.kink, False)

    def at(self, scene: Any, size: Tensor) -> SignalChange:
        """The change of a scene's signals; a play begins where the run does, if the scene says
        where, else in its middle.

        Args:
            scene: Scene with ``play_start``.
            size: (..., 1), or (..., width) where each signal has its own.
        """
        change = self.map
        if self.has_start and (start := scene.play_start) is not None:
            change = partial(change, start=start[..., None])  # type: ignore[call-arg]  # a play's
        return SignalChange(change, size, self.is_kinked)


@lru_cache(maxsize=256)
def _formula(text: str, names: tuple[str, ...]) -> Expression:
    return parse_expression(text, names)


def _evaluate(
    u: Tensor, grid: Grid, size: Tensor, *, text: str, scales: tuple[tuple[str, float], ...]
) -> Tensor:
    """A formula of signals, of sizes (..., 1 or width) and of the time since the start."""
    values = {name: torch.tensor(value, dtype=u.dtype) for name, value in scales}
    formula = _formula(text, (*OF_SIGNALS, *values))
    return formula({**values, "u": u, "size": size[..., None], "t": grid.since_start})


def on_commands(
    row: Row,
    names: Sequence[str],
    scales: Mapping[str, float] | None = None,
    between: Between = "straight",
    system: str = ANY,
) -> Apply:
    """How a cause acts on commands that go the same way.

    Args:
        row: Cause with ``at: command``.
        names: Names of the commands.
        scales: Numbers that its formula may use.
        between: What the commands do between samples.
        system: Kind of system.
    """
    mapper = SignalMapper.of(row, scales or {}, between, system)
    return partial(_change_commands, names=tuple(names), mapper=mapper)


def _change_commands(
    scene: TakesCommands, size: Tensor, run: Run, *, names: tuple[str, ...], mapper: SignalMapper
) -> Any:
    return scene.with_command(names, mapper.at(scene, size))


def on_readings(
    row: Row, channels: Sequence[int], scales: Mapping[str, float] | None = None
) -> Apply:
    """How a cause acts on channels of one instrument.

    Args:
        row: Cause with ``at: reading``.
        channels: Indices of the channels; each has a size of its own where there are several.
        scales: Numbers that its formula may use.
    """
    mapper = SignalMapper.of(row, scales or {})
    return partial(_change_readings, channels=tuple(channels), mapper=mapper)


def _change_readings(
    scene: TakesReadings, size: Tensor, run: Run, *, channels: tuple[int, ...], mapper: SignalMapper
) -> Any:
    return scene.with_reading(channels, mapper.at(scene, size))


def on_clock(channels: Sequence[int]) -> Apply:
    """How lateness acts on channels of one instrument.

    Args:
        channels: Indices of the channels.
    """
    return partial(_delay_channels, channels=tuple(channels))


def _delay_channels(
    scene: TakesClocks, size: Tensor, run: Run, *, channels: tuple[int, ...]
) -> Any:
    return scene.with_clock(channels, size[..., 0])


def on_numbers(row: Row) -> Apply:
    """How a cause acts on numbers of a system: equally many of each component share its size.

    Args:
        row: Cause with ``at: number``.
    """
    return partial(_change_numbers, names=row.add or row.scale, is_factor=bool(row.scale))


def _change_numbers(
    scene: TakesNumbers, size: Tensor, run: Run, *, names: tuple[str, ...], is_factor: bool
) -> Any:
    each = len(names) // size.shape[-1]
    for i, name in enumerate(names):
        own = size[..., i // each]
        scene = scene.with_number(name, partial(_scale_by if is_factor else _add_to, size=own))
    return scene


def _add_to(value: Tensor, size: Tensor) -> Tensor:
    return value + size


def _scale_by(value: Tensor, size: Tensor) -> Tensor:
    return value * (1.0 + size)


def on_place(row: Row, place: str) -> Apply:
    """How a force acts at a place.

    Args:
        row: Cause with ``at: force``.
        place: Name of the place, as the scene knows it.
    """
    formula = parse_expression(row.said("law"), OF_FORCES)
    return partial(_push, place=place, formula=formula)


def _push(scene: TakesForces, size: Tensor, run: Run, *, place: str, formula: Expression) -> Any:
    return scene.with_force(place, ForceLaw(formula, size[..., 0]))


__all__ = [
    "ForceLaw",
    "LawFormula",
    "SignalChange",
    "SignalMap",
    "on_clock",
    "on_commands",
    "on_numbers",
    "on_place",
    "on_readings",
]
