"""How a row acts through each of the five ports of a scene (``diffsim.causes.scene``).

Between sessions of recording somebody may have changed something: a size for each.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import torch
from torch import Tensor

from diffsim.causes.row import ANY, Row
from diffsim.causes.scene import ForceLaw, Scene
from diffsim.causes.signals import JOINT, MAPS, Between, Grid, SizedMap
from diffsim.core.checked import checked
from diffsim.core.expression import Expression, parse_expression
from diffsim.data.study import Run, Study
from diffsim.identify.effect import Apply

PLAY = "with_play"  # the map that depends on where a run starts
OF_SIGNALS = ("u", "size", "t")  # names of a formula that maps signals
OF_FORCES = ("size", "x", "v", "w")  # size, position, speed, speed below which friction fades
FADE_SHARE = 0.01  # of the usual speed: below it dry friction fades


@dataclass(frozen=True, eq=False)
class SignalChange:
    """A map of signals at a size: f(signals (..., width, num_times), grid)."""

    map: Callable[..., Tensor]  # function (signals, grid, size, *shapes)
    size: Tensor  # (..., 1), or (..., width) where each signal has its own
    is_kinked: bool = False  # whether the map has a kink at size 0
    is_joint: bool = False  # whether a signal depends on the others
    shapes: tuple[Tensor, ...] = ()  # further numbers of the map, (..., 1) each
    start: Tensor | None = None  # where in a play the run begins, (..., 1)
    is_plain: bool = False  # whether the map depends on these numbers alone

    def __call__(self, u: Tensor, grid: Grid) -> Tensor:
        begins = {} if self.start is None else {"start": self.start}
        changed = torch.as_tensor(self.map(u, grid, self.size, *self.shapes, **begins))
        if not self.is_kinked:
            return changed
        return torch.where(self.size[..., None] != 0.0, changed, u)

    @property
    def numbers(self) -> tuple[Tensor, ...] | None:
        """All that tells points apart; None: the map knows more."""
        if not self.is_plain:
            return None
        return (self.size, *self.shapes, *([] if self.start is None else [self.start]))

    def at_points(self, points: Tensor) -> SignalChange:
        """The change at some of its points, by their indices."""

        def taken(number: Tensor) -> Tensor:
            return number if number.ndim < 2 else number.index_select(0, points)

        shapes = tuple(taken(shape) for shape in self.shapes)
        start = None if self.start is None else taken(self.start)
        return replace(self, size=taken(self.size), shapes=shapes, start=start)

    @property
    def is_none(self) -> bool:
        """Whether it leaves all signals as they are."""
        return not bool(self.size.detach().any())


@dataclass(frozen=True, eq=False)
class SignalMapper:
    """What a row does to signals, before a scene and a size are known."""

    map: SizedMap  # function (signals, grid, size)
    is_kinked: bool  # whether the map has a kink at size 0
    has_start: bool  # whether it depends on where the run starts in a play
    is_joint: bool = False  # whether a signal depends on the others
    num_shapes: int = 0  # how many further numbers the map has, which stand behind the sizes

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
            is_kinked = row.said("kink", system)
            made = MAPS[text][between]
            return cls(made, is_kinked, text == PLAY, text in JOINT, len(row.shapes))
        own = tuple(row.shapes)
        formula = parse_expression(text, (*OF_SIGNALS, *own, *scales))
        used = tuple((n, scales[n]) for n in sorted(formula.names) if n in scales)
        made = partial(_evaluate, text=text, own=own, scales=used)
        return cls(made, row.said("kink", system), False, num_shapes=len(own))

    def at(self, scene: Any, size: Tensor) -> SignalChange:
        """The change of a scene's signals; a play begins where the run does, if the scene says
        where, else in its middle.

        Args:
            scene: Scene with ``play_start``.
            size: (..., 1), or (..., width) where each signal has its own.
        """
        count = size.shape[-1] - self.num_shapes
        start = scene.play_start if self.has_start else None
        return SignalChange(
            self.map,
            size[..., :count],
            self.is_kinked,
            self.is_joint,
            shapes=size[..., count:].split(1, -1) if self.num_shapes else (),
            start=None if start is None else start[..., None],
            is_plain=True,
        )


@lru_cache(maxsize=256)
def _formula(text: str, names: tuple[str, ...]) -> Expression:
    return parse_expression(text, names)


def _evaluate(
    u: Tensor,
    grid: Grid,
    size: Tensor,
    *shapes: Tensor,
    text: str,
    own: tuple[str, ...],
    scales: tuple[tuple[str, float], ...],
) -> Tensor:
    """A formula of signals, of sizes (..., 1 or width), shapes and of the time since the start."""
    values = {name: torch.tensor(value, dtype=u.dtype) for name, value in scales}
    values |= {name: shape[..., None] for name, shape in zip(own, shapes, strict=True)}
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
        scales: Numbers that its formula may use.
        between: What the commands do between samples.
    """
    mapper = SignalMapper.of(row, scales or {}, between, system)
    return partial(_change_commands, names=tuple(names), mapper=mapper)


def _change_commands(
    scene: Scene, size: Tensor, run: Run, *, names: tuple[str, ...], mapper: SignalMapper
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
    scene: Scene, size: Tensor, run: Run, *, channels: tuple[int, ...], mapper: SignalMapper
) -> Any:
    return scene.with_reading(channels, mapper.at(scene, size))


def on_clock(channels: Sequence[int], *, in_turn: bool = False) -> Apply:
    """How lateness acts on channels of one instrument.

    Args:
        in_turn: Whether each is late by one size more than the one before, the first by none.
    """
    if in_turn:
        return partial(_delay_in_turn, channels=tuple(channels[1:]))
    return partial(_delay_channels, channels=tuple(channels))


def _delay_channels(scene: Scene, size: Tensor, run: Run, *, channels: tuple[int, ...]) -> Any:
    return scene.with_clock(channels, size[..., 0])


def _delay_in_turn(scene: Scene, size: Tensor, run: Run, *, channels: tuple[int, ...]) -> Any:
    for place, channel in enumerate(channels, start=1):
        scene = scene.with_clock((channel,), place * size[..., 0])
    return scene


def on_numbers(row: Row) -> Apply:
    """How a cause acts on numbers of a system: equally many of each component share its size.

    Args:
        row: Cause with ``at: number``.
    """
    return partial(_change_numbers, names=row.add or row.scale, is_factor=bool(row.scale))


def _change_numbers(
    scene: Scene, size: Tensor, run: Run, *, names: tuple[str, ...], is_factor: bool
) -> Any:
    each = len(names) // size.shape[-1]
    for i, name in enumerate(names):
        own = size[..., i // each]
        scene = scene.with_number(name, partial(change_number, amount=own, is_factor=is_factor))
    return scene


def change_number(value: Tensor, amount: Tensor, is_factor: bool = False) -> Tensor:
    """A number with an amount added to it, or as much larger.

    Args:
        value, amount: () or (K,) each.
        is_factor: Whether the amount is a share of the number.
    """
    return value * (1.0 + amount) if is_factor else value + amount


def on_numbers_between(row: Row, sessions: Sessions) -> tuple[Apply, tuple[str, ...]]:
    """How a change of numbers between sessions acts, and the names of its sizes.

    Args:
        row: Cause with ``at: number`` and ``per: session``, a component for each number.
        sessions: Groups of runs, of which the first is as described.

    Returns:
        A size for each number in each later session.
    """
    later = sessions.labels[1:]
    several = len(later) > 1
    parts = tuple(f"{c} of {s}" if several else c for s in later for c in row.components)
    return partial(_change_in_session, names=row.add, sessions=sessions), parts


def _change_in_session(
    scene: Scene, size: Tensor, run: Run, *, names: tuple[str, ...], sessions: Sessions
) -> Any:
    session = sessions.index_of(run)
    if session is None:
        return scene
    for i, name in enumerate(names):
        own = size[..., session * len(names) + i]
        scene = scene.with_number(name, partial(change_number, amount=own))
    return scene


@checked(kinds_only=True)
def on_place(row: Row, place: str) -> Apply:
    """How a force acts at a place.

    Args:
        row: Cause with ``at: force``.
        place: Name of the place, as the scene knows it.
    """
    formula = parse_expression(row.said("law"), OF_FORCES)
    return partial(_push, place=place, formula=formula)


def _push(scene: Scene, size: Tensor, run: Run, *, place: str, formula: Expression) -> Any:
    return scene.with_force(place, ForceLaw(formula, size[..., 0], size[..., 1:].unbind(-1)))


SESSIONS = "sessions"  # place in a study's frame: labels of the runs that were fitted


@dataclass(frozen=True)
class Sessions:
    """Groups of runs between which somebody may have changed something."""

    fact: str  # fact of the runs' ``setup`` that says in which session they were recorded
    labels: tuple[str, ...]  # its values; the first session is as described

    @classmethod
    def of(cls, fact: str | None, study: Study) -> Sessions | None:
        """Sessions of a study's runs, those of the fitted ones where a frame says which they were;
        None: there are not two.

        Args:
            fact: Name of the fact; None: none is stated.
        """
        if fact is None:
            return None
        labels = study.frame.get(SESSIONS) or {
            str(run.setup[fact]) for run in study.runs if fact in run.setup
        }
        return cls(fact, tuple(sorted(labels))) if len(labels) > 1 else None

    def index_of(self, run: Run) -> int | None:
        """Place of a run's session among the later ones; None: the first, or one that was never
        fitted, which is as described.
        """
        label = str(run.setup.get(self.fact, self.labels[0]))
        return self.labels.index(label) - 1 if label in self.labels[1:] else None
