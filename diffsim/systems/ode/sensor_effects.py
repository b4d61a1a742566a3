"""Causes between the system and what was recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from torch import Tensor

from diffsim.causes.channel_groups import channel_groups
from diffsim.causes.readings import PLAY_START, spell_plainly, sensor_causes
from diffsim.causes.signals import Grid, SizedMap, with_play
from diffsim.data.study import Channel, Run
from diffsim.identify.effect import Effect
from diffsim.systems.ode.library import Library
from diffsim.systems.ode.scene import OdeScene

SHARE = 0.02  # of what a channel shows: offset and drift that are no surprise
PER_CHANNEL = ("sensor_offset", "sensor_drift")


def sensor_effects(library: Library) -> tuple[Effect, ...]:
    """Causes of every instrument; offset and drift for each channel."""
    by_name = {c.name: c for c in library.study.channels}
    late_record = library.scales.begins_moving or not library.held
    found = channel_groups(library.study.channels, late_record=late_record)
    kinds = {c.kind for c in library.study.channels}
    out = []
    for dial in found:
        own = [by_name[name] for name in dial.channels]
        is_whole = not dial.name or len(own) == len(by_name)
        for model, change in _causes(library, own):
            if model.name not in dial.causes:
                continue
            if model.name == "sensor_delay" and dial.channels in library.clocks:
                continue
            is_named = not is_whole or (model.name in PER_CHANNEL and len(kinds) == 1)
            tail = f"_of_{plain(dial.name)}" if is_named else ""
            shown = partial(_read, channels=dial.channels, change=change)
            if model.name == "sensor_backlash":
                shown = partial(_played, channels=dial.channels)
            units = {c.shown_unit for c in own} if model.unit == own[0].unit else {model.shown_unit}
            read = units.pop() if len(units) == 1 else None
            out.append(replace(model, name=model.name + tail, apply=shown, shown_unit=read))
    return tuple(out)


def _causes(library: Library, own: Sequence[Channel]) -> list[tuple[Effect, SizedMap]]:
    """Causes in the instrument of some channels, each with its map of one channel."""
    names = [c.name for c in own]
    usual = SHARE * max(library.spread_of(name) for name in names)
    bent = _bent(*_range_of(own, library))
    return [*sensor_causes(names, own[0].unit, usual, library.longest), (_CURVATURE, bent)]


def _bent(middle: float, width: float) -> SizedMap:
    """A scale that is straight in the middle of its range, more and more off towards its ends."""

    def change(y: Tensor, grid: Grid, size: Tensor) -> Tensor:
        away = (y - middle) / (0.5 * width)
        return y + size[..., None] * width * away * away

    return change


def _range_of(channels: Sequence[Channel], library: Library) -> tuple[float, float]:
    """Middle and width of what channels have shown in the runs to fit."""
    ends = [library.scales.ranges[c.name] for c in channels]
    low, high = min(e[0] for e in ends), max(e[1] for e in ends)
    return 0.5 * (low + high), high - low


def _read(
    scene: OdeScene, size: Tensor, run: Run, *, channels: Sequence[str], change: SizedMap
) -> OdeScene:
    """Channels changed alike, or each by a size of its own."""
    own = size.expand(*size.shape[:-1], len(channels)).unbind(-1)
    for channel, k in zip(channels, own, strict=True):
        scene = scene.with_reading(channel, lambda y, grid, k=k: change(y, grid, k))  # type: ignore[misc]
    return scene


def _played(scene: OdeScene, size: Tensor, run: Run, *, channels: Sequence[str]) -> OdeScene:
    """Channels behind a play, each from where it is in the play at the start."""
    start = scene.values.get(PLAY_START)
    for channel in channels:
        scene = scene.with_reading(channel, lambda y, grid: with_play(y, grid, size[..., 0], start))
    return scene


def _refuse(*_: object) -> None:
    raise TypeError("a pattern of an effect, made for sensors by sensor_effects")


_CURVATURE = Effect(
    name="sensor_curvature",
    form="Readings are larger by the share size of the range at both of its ends, in the middle by "
    "nothing.",
    family="shape",
    kind="sensor",
    unit="-",
    shown_unit="%",
    typical=0.05,
    also_looks_like=("a stiffness or outflow that changes with the level",),
    apply=_refuse,
)
