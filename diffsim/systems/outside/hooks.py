"""Hooks of an outside simulator: which commands, places and sensors causes may act on."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from diffsim.causes import plant
from diffsim.causes.channel_groups import CLOCK, WHOLE, channel_groups
from diffsim.causes.commands import CommandGroup
from diffsim.causes.readings import Instrument, usual_sample
from diffsim.causes.row import spell_plainly
from diffsim.causes.scales import Scales
from diffsim.causes.signals import Between
from diffsim.core.checked import checked
from diffsim.data.study import Study

_PER_DISTANCE = {"N": "m", "N m": "rad"}


@checked(kinds_only=True)
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
    def of_plant(self) -> plant.Place:
        """The place as causes see it."""
        stated = {"distance": self.distance, "speed": self.speed}
        usual = {"push": self.typical, **{name: value or 1.0 for name, value in stated.items()}}
        known = tuple(name for name, value in stated.items() if value is not None)
        return plant.Place(usual, known, self.unit, _PER_DISTANCE[self.unit])


@checked
def command_groups(
    study: Study,
    by_name: Mapping[str, Sequence[str]] | None,
    scales: Scales | None = None,
    between: Between = "smooth",
) -> tuple[CommandGroup, ...]:
    """Groups of a study's commands: those that are named, else all commands as one.

    Args:
        study: Recorded runs with their commands.
        by_name: Names of the commands of each group; None: one group of all.
        scales: Usual magnitudes; None: of the study.
        between: What commands do between samples; the simulator hears samples alone.

    Raises:
        ValueError: a group without commands, or a command that no run has.
    """
    scales = scales or Scales.of_runs(study)
    known = list(dict.fromkeys(name for run in study.runs for name in run.command))
    given = {"": known} if by_name is None else by_name
    for name, columns in given.items():
        _require_all(f"hooks.command.{name}", columns, known)
    units = {c.name: (c.unit, c.shown_unit) for c in study.commands}

    def unit_of(columns: Sequence[str]) -> tuple[str | None, str | None]:
        """Unit of commands and the one that is shown, where they share them."""
        own = {units.get(name, (None, None)) for name in columns}
        return own.pop() if len(own) == 1 else (None, None)

    return tuple(
        CommandGroup(
            tuple(columns),
            scales.of_commands(columns),
            between,
            scales.is_one_sided(columns),
            f"_of_{spell_plainly(name)}" if name else "",
            *unit_of(columns),
            sample_s=usual_sample(study.runs),
        )
        for name, columns in given.items()
        if columns
    )


@checked
def instruments(
    study: Study,
    by_name: Mapping[str, Sequence[str]] | None,
    scales: Scales | None = None,
    clocks: Collection[tuple[str, ...]] = (),
) -> tuple[Instrument, ...]:
    """Channels by instrument: as named, else those of one sensor, kind, or one alone.

    Args:
        study: Recorded runs with their channels.
        by_name: Names of the channels of each instrument; None: as ``channel_groups`` has it.
        scales: Usual magnitudes; None: of the study.
        clocks: Channels whose lateness is known or fitted already, sensor by sensor.

    Raises:
        ValueError: an instrument without channels, or a channel that the study lacks.
    """
    scales = scales or Scales.of_runs(study)
    known = [c.name for c in study.channels]
    is_driven = any(run.command for run in study.runs)
    if by_name is None:
        # nobody knows what a simulator was commanded before: lateness of all is the commands'
        found = channel_groups(study.channels, late_record=not is_driven)
        given = {g.name or "record": (g.channels, g.causes) for g in found}
    else:
        given = {name: (tuple(columns), WHOLE) for name, columns in by_name.items()}
    out = []
    for name, (columns, causes) in given.items():
        _require_all(f"hooks.output.{name}", columns, known)
        if not columns:
            raise ValueError(f"hooks.output.{name} has no channels")
        # of all channels, and at rest before, a late instrument is a late command
        is_late_command = set(columns) == set(known) and is_driven
        left_out = CLOCK if is_late_command else ("sensor_delay",) if columns in clocks else ()
        own = tuple(study.channels[known.index(c)] for c in columns)
        units = {c.unit for c in own}
        out.append(
            Instrument(
                own,
                tuple(known.index(c) for c in columns),
                scales.of_channels(columns),
                f"_of_{spell_plainly(name)}",
                units.pop() if len(units) == 1 else "channel",
                tuple(c for c in causes if c not in left_out),
            )
        )
    return tuple(out)


def _require_all(where: str, names: Sequence[str], known: Sequence[str]) -> None:
    for name in names:
        if name not in known:
            raise ValueError(f"{where}: no {name!r}; the study has {', '.join(known) or 'none'}")
