"""Causes between the system and what was recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from torch import Tensor

from diffsim.data.study import Channel, Run
from diffsim.identify.effect import Effect
from diffsim.systems.grid import Grid, SizedMap
from diffsim.systems.instrument import sensor_causes
from diffsim.systems.ode.library import Library
from diffsim.systems.ode.scene import OdeScene

SHARE = 0.02  # of what a channel shows: offset and drift that are no surprise
PER_CHANNEL = ("sensor_offset", "sensor_drift")


def sensor_effects(library: Library) -> tuple[Effect, ...]:
    """Causes of every kind of sensor; offset and drift for each channel."""
    kinds: dict[str, list[Channel]] = {}
    for channel in library.study.channels:
        kinds.setdefault(channel.kind, []).append(channel)
    out = []
    for kind, own in kinds.items():
        indices = [list(library.study.channels).index(c) for c in own]
        usual = SHARE * max(library.spread(i) for i in indices)
        names = [c.name for c in own]
        for model, change in sensor_causes(names, own[0].unit, usual, library.longest):
            if model.name == "sensor_delay" and len(kinds) == 1 and library.held:
                continue  # of all channels alike it is a delay of the inputs, seen from the clock
            tail = f"_of_{kind}" if len(kinds) > 1 or model.name in PER_CHANNEL else ""
            apply = partial(_read, channels=names, change=change)
            out.append(replace(model, name=model.name + tail, apply=apply))
        tail = f"_of_{kind}" if len(kinds) > 1 else ""
        bent = _bent(*_range_of(own, library))
        apply = partial(_read, channels=names, change=bent)
        out.append(replace(_CURVATURE, name=_CURVATURE.name + tail, apply=apply))
    return tuple(out)


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


def _refuse(*_: object) -> None:
    raise TypeError("a pattern of an effect, made for sensors by sensor_effects")


_CURVATURE = Effect(
    name="sensor_curvature",
    form="Readings are larger by the share size of the range at both of its ends, in the middle by "
    "nothing.",
    family="shape",
    kind="sensor",
    unit="-",
    typical=0.05,
    also_looks_like=("a stiffness or outflow that changes with the level",),
    apply=_refuse,
)
