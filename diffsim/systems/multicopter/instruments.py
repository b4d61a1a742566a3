"""Causes in single instruments of a flight: a camera that is late, a gyro whose scale is off.

With `sensor` stated, lateness, lag, scale and zero are judged for each sensor; drift, play and
curvature are where a study asks for them. What a vehicle has without a statement stays, but for the
delay of all cameras together.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass

from diffsim.causes.channel_groups import channel_groups
from diffsim.causes.readings import Instrument, pace, reading_causes, usual_sample
from diffsim.causes.row import spell_plainly
from diffsim.causes.scales import Scales
from diffsim.data.study import Channel, Study
from diffsim.identify.effect import Effect
from diffsim.systems.multicopter.candidates import SYSTEM
from diffsim.systems.multicopter.cutting import Cutter
from diffsim.systems.multicopter.flight import SENSORS

TURNS = ("attitude", "quaternion")  # what has no scale, no zero and no lag by itself
JUDGED = ("sensor_delay", "sensor_lag", "sensor_scale", "sensor_offset")
ALREADY = {  # causes of whole groups that every vehicle has
    "sensor_scale": ("position", "accelerometer"),
    "sensor_offset": ("position", "body_rates", "accelerometer", "acceleration"),
}
USUAL = {"m": 0.05, "m/s": 0.05, "rad/s": 0.02, "m/s^2": 0.1}  # a zero that is no surprise


@dataclass(frozen=True)
class _JudgedChannel:
    """A channel, its place among the channels, and the group of readings that it is of."""

    channel: Channel
    place: int
    group: str


def states_sensors(study: Study) -> bool:
    """Whether a channel says which sensor shows it."""
    return any(c.sensor is not None for c in study.channels)


def instrument_causes(
    study: Study,
    cutter: Cutter,
    clocks: Sequence[tuple[str, ...]],
    scales: Scales,
    causes: Container[str] = JUDGED,
) -> list[Effect]:
    """Causes in each stated sensor; none where no channel states one.

    Args:
        study: Study with the recordings.
        cutter: Which reading each channel is.
        clocks: Channels whose lateness is known or a base parameter, sensor by sensor.
        scales: Usual magnitudes.
        causes: Names of the rows that are tried.
    """
    if not states_sensors(study):
        return []
    by_name = {j.channel.name: j for j in _list_judged(study, cutter)}
    out: list[Effect] = []
    for group in channel_groups(study.channels, late_record=False):
        if len(group.channels) == len(by_name):
            continue  # of all channels: the clock of the commands
        own = [by_name[name] for name in group.channels]
        unit = own[0].channel.unit
        instrument = Instrument(
            tuple(j.channel for j in own),
            tuple(j.place for j in own),
            {**scales.of_channels(group.channels), "usual": USUAL.get(unit, 1.0)},
            f"_of_{spell_plainly(group.name)}",
            unit,
            tuple(
                name
                for name in group.causes
                if name in causes
                and not (name == "sensor_delay" and group.channels in clocks)
                and not (name != "sensor_delay" and any(j.group in TURNS for j in own))
                and not _is_there(name, own, by_name.values())
            ),
        )
        out += reading_causes(instrument, system=SYSTEM)
    return list(pace(out, usual_sample(study.runs)))


def _list_judged(study: Study, cutter: Cutter) -> list[_JudgedChannel]:
    groups = [group for group in cutter.sensors for _ in SENSORS[group]]
    columns = range(len(groups)) if cutter.columns is None else cutter.columns
    return [
        _JudgedChannel(channel, place, groups[column])
        for place, (channel, column) in enumerate(zip(study.channels, columns, strict=True))
    ]


def _is_there(cause: str, own: Sequence[_JudgedChannel], every: Iterable[_JudgedChannel]) -> bool:
    """Whether a vehicle has the cause anyway, of the whole group that these channels are."""
    groups = {j.group for j in own}
    if len(groups) != 1 or not groups <= set(ALREADY.get(cause, ())):
        return False
    return all(j in own for j in every if j.group in groups)


__all__ = ["instrument_causes", "states_sensors"]
