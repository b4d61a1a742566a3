"""Hooks of an outside simulator: which commands, places and sensors causes may act on."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.causes.channel_groups import WHOLE, channel_groups
from diffsim.data.study import Run, Study

Array = NDArray[np.float64]
COMMANDS, OUTPUTS = "commands", "outputs"  # their places in a study's frame
SHARE = 0.05  # of a command's or channel's range: no surprise
PER_DISTANCE = {"N": "m", "N m": "rad"}


@dataclass(frozen=True)
class Group:
    """Commands that go the same way, or channels of one instrument.

    Attributes:
        name: Ending of the causes' names, as "_motor"; empty: none.
        columns: Names of the commands or channels.
        reach: Greatest value of a command in the study, in its unit; range of a channel.
        unit: Unit of the columns, if they share one, else "command" or "channel".
        one_sided: No command is ever below zero.
        longest_s: Duration of the longest run [s].
        causes: Causes in an instrument that are tried, without what they are of.
    """

    name: str
    columns: tuple[str, ...]
    reach: float
    unit: str
    one_sided: bool = False
    longest_s: float = 1.0
    causes: tuple[str, ...] = WHOLE


@dataclass(frozen=True)
class Place:
    """A place where a simulator can add a force, along one direction or about one axis.

    Attributes:
        name: Name of the place, as the simulator knows it.
        unit: "N", or "N m" for a moment.
        typical: Force that would be no surprise [unit].
        distance: Usual displacement from zero [m or rad]; None: not told, no springs.
        speed: Usual speed [m/s or rad/s]; None: not told, no friction or drag.
    """

    name: str
    unit: str
    typical: float
    distance: float | None = None
    speed: float | None = None

    @property
    def length(self) -> str:
        """Unit of the displacement."""
        return PER_DISTANCE[self.unit]


@dataclass(frozen=True)
class Hooks:
    """What causes may act on.

    Attributes:
        commands: Groups of commands on their way to the actuators.
        places: Places of forces.
        outputs: Channels by instrument.
    """

    commands: tuple[Group, ...] = ()
    places: tuple[Place, ...] = ()
    outputs: tuple[Group, ...] = ()


def command_groups(study: Study, by_name: Mapping[str, Sequence[str]] | None) -> tuple[Group, ...]:
    """Groups of a study's commands: those that are named, else all commands as one.

    Args:
        study: Recorded runs with their commands.
        by_name: Names of the commands of each group; None: one group of all.

    Raises:
        ValueError: a group without commands, or a command that no run has.
    """
    if COMMANDS in study.frame:
        return _kept(study.frame[COMMANDS])
    known = list(dict.fromkeys(name for run in study.runs for name in run.command))
    given = {"": known} if by_name is None else by_name
    out = []
    for name, columns in given.items():
        _require_all(f"hooks.command.{name}", columns, known)
        if columns:
            values = [_finite(run, c) for run in study.runs for c in columns]
            reach = max(float(np.abs(v).max(initial=0.0)) for v in values)
            one_sided = all((v >= 0.0).all() for v in values)
            out.append(Group(name, tuple(columns), reach or 1.0, "command", one_sided))
    return tuple(out)


def output_groups(study: Study, by_name: Mapping[str, Sequence[str]] | None) -> tuple[Group, ...]:
    """Channels by instrument: as named, else those of one sensor, kind, or one alone.

    Args:
        study: Recorded runs with their channels.
        by_name: Names of the channels of each instrument; None: as ``dials`` has it.

    Raises:
        ValueError: an instrument without channels, or a channel that the study lacks.
    """
    if OUTPUTS in study.frame:
        return _kept(study.frame[OUTPUTS])
    known = [c.name for c in study.channels]
    longest = max(float(run.time_s[-1] - run.time_s[0]) for run in study.runs)
    if by_name is None:
        # nobody knows what a simulator was commanded before: lateness of all is the commands'
        is_driven = any(run.command for run in study.runs)
        found = channel_groups(study.channels, late_record=not is_driven)
        given = {d.name or "record": (d.channels, d.causes) for d in found}
    else:
        given = {name: (tuple(columns), WHOLE) for name, columns in by_name.items()}
    out = []
    for name, (columns, causes) in given.items():
        _require_all(f"hooks.output.{name}", columns, known)
        if not columns:
            raise ValueError(f"hooks.output.{name} has no channels")
        idx = [known.index(c) for c in columns]
        units = {study.channels[i].unit for i in idx}
        reach = max(float(np.ptp(v[np.isfinite(v)])) for v in _columns(study, idx))
        out.append(
            Group(
                name,
                tuple(columns),
                reach or 1.0,
                units.pop() if len(units) == 1 else "channel",
                longest_s=longest,
                causes=causes,
            )
        )
    return tuple(out)


def without_clock(group: Group, known: Collection[tuple[str, ...]]) -> Group:
    """The group without the cause that it is late, if its clock is known or fitted already."""
    if group.columns not in known:
        return group
    return replace(group, causes=tuple(c for c in group.causes if c != "sensor_delay"))


def frame_of(hooks: Hooks) -> dict[str, list[dict[str, Any]]]:
    """What a study of other runs needs for the same groups, with the same reach."""
    return {
        COMMANDS: [asdict(group) for group in hooks.commands],
        OUTPUTS: [asdict(group) for group in hooks.outputs],
    }


def _kept(groups: Sequence[Mapping[str, Any]]) -> tuple[Group, ...]:
    lists = ("columns", "causes")  # YAML has no tuples
    out = []
    for group in groups:
        given: dict[str, Any] = {k: tuple(v) if k in lists else v for k, v in group.items()}
        out.append(Group(**given))
    return tuple(out)


def _finite(run: Run, command: str) -> Array:
    values = np.asarray(run.command.get(command, [0.0]), dtype=np.float64)
    return values[np.isfinite(values)]


def _columns(study: Study, idx: Sequence[int]) -> list[Array]:
    found = [run.measured[:, i] for run in study.runs for i in idx]
    return [v for v in found if np.isfinite(v).any()] or [np.zeros(1)]


def _require_all(where: str, names: Sequence[str], known: Sequence[str]) -> None:
    for name in names:
        if name not in known:
            raise ValueError(f"{where}: no {name!r}; the study has {', '.join(known) or 'none'}")
