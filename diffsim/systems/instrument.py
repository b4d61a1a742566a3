"""Causes in the instruments that show channels: the one home of them, whatever the system."""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.data.study import Channel, Run
from diffsim.identify.effect import Apply, Effect
from diffsim.systems import grid as signals
from diffsim.systems.actuator import scaled, shifted
from diffsim.systems.description import Quantity
from diffsim.systems.grid import Grid, SizedMap

PLAY_START = "play_start"  # base parameter: where in a play a run starts, -1 to 1
# anywhere in the play, as likely; it matters only while there is one
START_IN_PLAY = Quantity(value=0.0, sd=0.6, lower=-1.0, upper=1.0, per="run")


def with_play_start(values: Mapping[str, Tensor], run: Run) -> Mapping[str, Tensor]:
    """Values of base parameters; a run that the model was not made for starts in the middle."""
    name = f"{PLAY_START}@{run.name}"
    if name in values:
        return values
    middle = {name: torch.zeros((), dtype=torch.float64)}
    return ChainMap(middle, values)  # type: ignore[arg-type]  # it is only read


def plain(name: str) -> str:
    """A name as the names of causes are written: lower case, digits, underscores."""
    kept = "".join(c if c.isalnum() and c.isascii() else "_" for c in name.lower())
    return kept.strip("_") or "x"


def _risen(y: Tensor, grid: Grid, size: Tensor, *, longest_s: float) -> Tensor:
    return y + size[..., None] * ((grid.times - grid.times[0]) / longest_s)


def refuse(*_: Any) -> None:
    """The ``apply`` of a pattern, which has no scene of its own."""
    raise TypeError("a pattern of an effect; bind its map to a scene")


def paced(effects: Iterable[Effect], sample_s: float) -> tuple[Effect, ...]:
    """Delays and lags that may be as long as half a sample without surprise.

    What is read every two seconds is seldom late by milliseconds.

    Args:
        effects: Candidate causes.
        sample_s: Usual time between two samples [s].
    """
    least = 0.5 * sample_s
    return tuple(
        replace(e, typical=least) if e.unit == "s" and e.typical < least else e for e in effects
    )


def sample_of(runs: Iterable[Run]) -> float:
    """Usual time between two samples of runs [s]; 0 where none has two."""
    return max((float(np.median(np.diff(r.time_s))) for r in runs if len(r.time_s) > 1), default=0)


SENSOR_SCALE = Effect(
    name="sensor_scale",
    form="Readings are 1 + size times too large.",
    family="sensor",
    kind="sensor",
    unit="-",
    shown_unit="%",
    typical=0.03,
    also_looks_like=("gain of the drive", "calibration", "a length of the mechanism"),
    apply=refuse,
)
SENSOR_OFFSET = replace(
    SENSOR_SCALE,
    name="sensor_offset",
    form="Readings are larger by size.",
    shown_unit=None,
    family="zero",
    also_looks_like=("zero of the sensor", "constant force", "start value"),
)
SENSOR_DRIFT = replace(
    SENSOR_OFFSET,
    name="sensor_drift",
    form="Readings rise by size over the longest run.",
    family="drift",
    also_looks_like=("warming of the sensor", "creep", "start value"),
)
SENSOR_BACKLASH = replace(
    SENSOR_SCALE,
    name="sensor_backlash",
    form="Play between what moves and what is read, half its width on either side.",
    shown_unit=None,
    family="shape",
    signed=False,
    smooth=False,
    also_looks_like=("gear play before the encoder", "hysteresis of the sensor", "dry friction"),
)
SENSOR_DELAY = replace(
    SENSOR_SCALE,
    name="sensor_delay",
    form="Readings come size later.",
    family="timing",
    unit="s",
    shown_unit=None,
    typical=0.02,
    also_looks_like=("offset of the recorder's clock",),
)
SENSOR_LAG = replace(
    SENSOR_DELAY,
    name="sensor_lag",
    form="Readings pass a first-order lag with the time constant size.",
    signed=False,
    also_looks_like=("filter of the recorder", "lag of the drive"),
)


def named_of(model: Effect, dial: str, channels: Sequence[Channel], apply: Apply) -> Effect:
    """A cause in some channels, called after what they share, in the unit in which a user reads it.

    Args:
        model: The cause without what it is of.
        dial: Name of what the channels share.
        channels: These channels.
        apply: How it acts on a scene.
    """
    units = (
        {c.shown_unit for c in channels} if model.unit == channels[0].unit else {model.shown_unit}
    )
    shown = units.pop() if len(units) == 1 else None
    name = f"{model.name}_of_{plain(dial)}"
    return replace(model, name=name, apply=apply, shown_unit=shown)


def sensor_causes(
    channels: Sequence[str], unit: str, usual: float, longest_s: float
) -> list[tuple[Effect, SizedMap]]:
    """Causes in an instrument, each with its map of one channel.

    Args:
        channels: Names of its channels; offset and drift have a component for each.
        unit: Unit of the channels.
        usual: Offset that would be no surprise [unit].
        longest_s: Duration of the longest run [s].
    """
    each = tuple(channels) if len(channels) > 1 else ("size",)

    def own(model: Effect, components: tuple[str, ...]) -> Effect:
        return replace(model, unit=unit, typical=usual, components=components)

    return [
        (SENSOR_SCALE, scaled),
        (SENSOR_LAG, signals.lagged),
        (own(SENSOR_OFFSET, each), shifted),
        (own(SENSOR_DRIFT, each), partial(_risen, longest_s=longest_s)),
        (own(SENSOR_BACKLASH, ("size",)), signals.with_play),
        (SENSOR_DELAY, signals.smoothly_delayed),
    ]
