"""What a kind of system tells of itself, from which its causes follow by rule (``listing``).

A plant is a record: commands, numbers, places, parts and facts of one described system. It lists no
causes; which rows of the tables suit it is said by the rows.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from diffsim.causes.commands import CommandGroup
from diffsim.causes.ports import Sessions, on_place
from diffsim.causes.scales import Scales
from diffsim.core.checked import checked
from diffsim.data.study import Channel
from diffsim.identify.effect import Apply

if TYPE_CHECKING:
    from diffsim.causes.readings import Instrument
    from diffsim.causes.row import Row
    from diffsim.causes.signals import Between

IN_TIME = "in_time"  # fact: samples of a run follow each other in time
LATE_RECORD = "late_record"  # fact: a record that is late as a whole shows as no late command does


@checked(kinds_only=True)
@dataclass(frozen=True)
class Place:
    """A place at which a force may act.

    Attributes:
        magnitudes: Usual magnitudes by the names that rows of forces use: ``push``, a force that
            would be no surprise, ``distance`` and ``speed``.
        facts: What is known of it, as rows ask for it: "distance" (springs), "speed" (friction).
        unit: Unit of the force.
        length: Unit of the displacement.
        ending: What names of its causes end with; None: "_at_" and its name.
    """

    magnitudes: Mapping[str, float]
    facts: tuple[str, ...] = ("distance", "speed")
    unit: str = "N"
    length: str = "m"
    ending: str | None = None


@dataclass(frozen=True)
class Store:
    """What fills and empties."""

    # usual magnitudes by the names that rows of stores use: ``flow`` and ``level``
    magnitudes: Mapping[str, float]
    unit: str = "-"  # unit of the level
    ending: str = ""  # what names of its causes end with, such as "_of_upper"
    # unit of what a flow is divided by to give the level's rate; None: a flow is that rate
    area: str | None = None


@checked(kinds_only=True)
@dataclass(frozen=True, kw_only=True, eq=False)
class Plant:
    """A described system, as causes of the library, causes of a user and laws see it.

    Attributes:
        kind: Kind of system, by which rows may say something of their own.
        scales: Usual magnitudes of the recordings.
        channels: Channels of the study, in order.
        commands: What each command does between samples, by name.
        ways: Commands that go the same way, group by group: causes change them alike.
        numbers: Names of the numbers that may be changed.
        fitted: Those among them that are base parameters already: a cause beside one could not be
            told from it.
        places: Where forces may act, by name.
        stores: What fills and empties, by name.
        facts: What holds of the system, by the names that rows ask for; what is not there does not.
        parts: Parts that are alike, such as tendons: of each kind their names, and what stands for
            them in names of numbers.
        functions: What rows ``at: scene`` do, by name of the row, or of the cause in one part; by
            the row of parts, a function of what stands for the part and of the cause's name.
        magnitudes: What ``typical`` of rows may use, beside magnitudes of commands.
        sessions: Groups of runs between which something may have changed; None: there are none.
        instruments: What shows the channels, where a study says which; None: by their sensors and
            kinds.
        record: All channels as one instrument, for rows of the whole record; None: none is judged.
        unwatched: Channels that no instrument shows, such as a height at rest.
        clocks: Channels whose lateness is known or a base parameter, sensor by sensor.
        sample_s: Usual time between two samples; instruments may be late by half of it without
            surprise; 0: their rows say what is usual [s].
        push: Function (row, place) -> how a force acts, whose effect has the row's name; other than
            through the scene's port where a system writes forces into its formulas.
        flow: Function (row, store) -> how what a store gains acts, likewise.
    """

    kind: str
    scales: Scales
    channels: tuple[Channel, ...]
    commands: Mapping[str, Between] = field(default_factory=dict)
    ways: tuple[CommandGroup, ...] = ()
    numbers: tuple[str, ...] = ()
    fitted: Collection[str] = ()
    places: Mapping[str, Place] = field(default_factory=dict)
    stores: Mapping[str, Store] = field(default_factory=dict)
    facts: Mapping[str, bool] = field(default_factory=dict)
    parts: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    functions: Mapping[str, Any] = field(default_factory=dict)
    magnitudes: Mapping[str, float] = field(default_factory=dict)
    sessions: Sessions | None = None
    instruments: tuple[Instrument, ...] | None = None
    record: Instrument | None = None
    unwatched: Collection[str] = ()
    clocks: Collection[tuple[str, ...]] = ()
    sample_s: float = 0.0
    push: Callable[[Row, str], Apply] = on_place
    flow: Callable[[Row, str], Apply] | None = None

    @property
    def is_in_time(self) -> bool:
        """Whether samples of a run follow each other in time, so that something may be late."""
        return bool(self.facts.get(IN_TIME))

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels, in order."""
        return tuple(c.name for c in self.channels)
