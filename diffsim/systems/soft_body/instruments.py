"""Causes in single instruments of a soft body: a camera that is late while an encoder is not.

What all channels share is in ``sensor``: the clock of the record, its scale, where it was placed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.channel_groups import channel_groups
from diffsim.causes.readings import named_of, paced, sample_of, sensor_causes
from diffsim.causes.signals import Grid, SizedMap
from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect
from diffsim.systems.soft_body.scene import SoftScene

INSTRUMENTS = "instruments"  # place in a study's frame
SHARE = 0.02  # of what a channel shows: offset and drift that are no surprise
OF_MACHINES = ("sensor_backlash", "sensor_curvature")  # of gears and levels, not of cameras
OF_TIME = ("sensor_delay", "sensor_lag", "sensor_drift")


def instrument_scales(study: Study) -> dict[str, Any]:
    """What each channel has shown, and for how long; of a study with a ``frame``, from there."""
    if kept := study.frame.get(INSTRUMENTS):
        return dict(kept)
    widths = {}
    for k, channel in enumerate(study.channels):
        seen = np.concatenate([r.measured[:, k] for r in study.fit_runs or study.runs])
        seen = seen[np.isfinite(seen)]
        widths[channel.name] = float(np.ptp(seen)) if len(seen) else 0.0
    longest = max(float(r.time_s[-1] - r.time_s[0]) for r in study.runs)
    return {"width": widths, "longest_s": longest or 1.0}


def instrument_effects(
    study: Study, *, timed: bool, clocks: Sequence[tuple[str, ...]], fitted: Mapping[str, set[str]]
) -> list[Effect]:
    """Causes in each stated sensor; none where no channel states one.

    Args:
        study: Study with the recordings.
        timed: Whether time matters.
        clocks: Channels whose lateness is known or a base parameter, sensor by sensor.
        fitted: Channels whose offset or scale is a base parameter, by cause.
    """
    if all(c.sensor is None for c in study.channels):
        return []
    scales, place = instrument_scales(study), {c.name: k for k, c in enumerate(study.channels)}
    out: list[Effect] = []
    for dial in channel_groups(study.channels, late_record=False):
        if len(dial.channels) == len(place):
            continue  # of all channels: causes of the whole record
        own = [study.channels[place[name]] for name in dial.channels]
        usual = SHARE * max(scales["width"][c.name] for c in own) or 1.0
        made = sensor_causes(dial.channels, own[0].unit, usual, scales["longest_s"])
        for model, change in made:
            if model.name not in dial.causes or model.name in OF_MACHINES:
                continue
            if not timed and model.name in OF_TIME:
                continue
            if model.name == "sensor_delay" and dial.channels in clocks:
                continue
            if set(dial.channels) <= fitted.get(model.name, set()):
                continue
            idx = tuple(place[name] for name in dial.channels)
            apply = partial(_shown, channels=idx, change=change)
            if model.name == "sensor_delay":
                apply = partial(_late, channels=idx)
            out.append(named_of(model, dial.name, own, apply))
    return list(paced(out, sample_of(study.runs)))


def _late(scene: SoftScene, size: Tensor, run: Run, *, channels: tuple[int, ...]) -> SoftScene:
    return scene.with_late(channels, size[0])


def _shown(
    scene: SoftScene, size: Tensor, run: Run, *, channels: tuple[int, ...], change: SizedMap
) -> SoftScene:
    own = size.expand(len(channels)).unbind(-1)

    def changed(y: Tensor, times: Tensor) -> Tensor:
        grid = Grid(times, torch.arange(len(times)), times.detach().numpy())
        columns = list(y.unbind(-1))
        for k, amount in zip(channels, own, strict=True):
            columns[k] = change(columns[k], grid, amount)
        return torch.stack(columns, -1)

    return scene.with_output(changed)


__all__ = ["INSTRUMENTS", "instrument_effects", "instrument_scales"]
