"""Causes between the system and what was recorded."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.data.study import Channel, Run
from diffsim.identify.effect import Effect
from diffsim.systems.ode import grid as signals
from diffsim.systems.ode.applying import by_reading
from diffsim.systems.ode.grid import Grid
from diffsim.systems.ode.library import Library
from diffsim.systems.ode.scene import OdeScene


def sensor_effects(library: Library) -> tuple[Effect, ...]:
    """Causes of every kind of sensor; offset and drift for each channel."""
    channels = library.study.channels
    kinds: dict[str, list[Channel]] = {}
    for channel in channels:
        kinds.setdefault(channel.kind, []).append(channel)
    out = []
    for kind, own in kinds.items():
        tail = "" if len(kinds) == 1 else f"_of_{kind}"
        names = [c.name for c in own]
        out += [
            replace(_SCALE, name=_SCALE.name + tail, apply=by_reading(names, _scaled)),
            replace(_LAG, name=_LAG.name + tail, apply=by_reading(names, signals.lagged)),
            _curvature(own, library, tail),
            _offset("sensor_offset", own, library),
            _offset("sensor_drift", own, library),
        ]
        if len(kinds) > 1 or not library.held:
            # of all channels alike it is a delay of the inputs, seen from the clock
            delay = by_reading(names, signals.smoothly_delayed)
            out.append(replace(_DELAY, name=_DELAY.name + tail, apply=delay))
    return tuple(out)


def _scaled(y: Tensor, grid: Grid, size: Tensor) -> Tensor:
    return y * (1.0 + size[..., None])


def _curvature(channels: list[Channel], library: Library, tail: str) -> Effect:
    """A scale that is bent: straight in the middle of the range, more and more off to its ends."""
    middle, spread = _range_of(channels, library)

    def bent(y: Tensor, grid: Grid, size: Tensor) -> Tensor:
        away = (y - middle) / (0.5 * spread)
        return y + size[..., None] * spread * away * away

    names = [c.name for c in channels]
    return replace(_CURVATURE, name=_CURVATURE.name + tail, apply=by_reading(names, bent))


def _range_of(channels: list[Channel], library: Library) -> tuple[float, float]:
    """Middle and width of what channels have shown in the runs to fit."""
    indices = [list(library.study.channels).index(c) for c in channels]
    runs = library.study.fit_runs or library.study.runs
    seen = np.concatenate([run.measured[:, indices].ravel() for run in runs])
    seen = seen[np.isfinite(seen)]
    if not len(seen) or np.ptp(seen) == 0.0:
        return 0.0, 1.0
    return 0.5 * float(seen.min() + seen.max()), float(np.ptp(seen))


def _offset(name: str, channels: list[Channel], library: Library) -> Effect:
    """A shift, or one that grows over each run, one component per channel of a unit."""
    indices = [list(library.study.channels).index(c) for c in channels]
    spread = max(library.spread(i) for i in indices)
    drifts = name == "sensor_drift"
    unit = channels[0].unit
    pattern = Effect(
        name=f"{name}_of_{channels[0].kind}",
        form="Readings rise by size over the longest run."
        if drifts
        else "Readings are larger by size.",
        family="drift" if drifts else "zero",
        kind="sensor",
        unit=unit,
        typical=0.02 * spread,
        components=tuple(c.name for c in channels) if len(channels) > 1 else ("size",),
        also_looks_like=("zero of the sensor", "constant force", "start value"),
        apply=lambda scene, size, run: _shifted(
            scene, size, run, [c.name for c in channels], library.longest if drifts else None
        ),
    )
    return pattern


def _shifted(
    scene: OdeScene, size: Tensor, run: Run, channels: list[str], longest: float | None
) -> OdeScene:
    since = scene.grid.times - scene.grid.times[0]
    shape = torch.ones_like(since) if longest is None else since / longest
    for i, channel in enumerate(channels):
        own = size[..., i : i + 1]
        scene = scene.with_reading(channel, lambda y, grid, own=own: y + own * shape)  # type: ignore[misc]
    return scene


def _refuse(*_: Any) -> None:
    raise TypeError("a pattern of an effect, made for sensors by sensor_effects")


_SCALE = Effect(
    name="sensor_scale",
    form="Readings are 1 + size times too large.",
    family="sensor",
    kind="sensor",
    unit="-",
    typical=0.03,
    also_looks_like=("gain of the drive",),
    apply=_refuse,
)
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
_LAG = Effect(
    name="sensor_lag",
    form="Readings pass a first-order lag with the time constant size.",
    family="timing",
    kind="sensor",
    unit="s",
    typical=0.02,
    signed=False,
    also_looks_like=("filter of the recorder", "lag of the drive"),
    apply=_refuse,
)
_DELAY = Effect(
    name="sensor_delay",
    form="Readings come size later.",
    family="timing",
    kind="sensor",
    unit="s",
    typical=0.02,
    also_looks_like=("offset of the recorder's clock",),
    apply=_refuse,
)
