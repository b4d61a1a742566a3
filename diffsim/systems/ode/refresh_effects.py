"""Sensors that are refreshed by a clock of their own: judged where the records show one."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
import torch
from torch import Tensor

from diffsim.causes._ops_signals import read_lines
from diffsim.causes.catalogue import rows
from diffsim.causes.signals import Grid
from diffsim.data.refresh import age, phase_of, refresh_period
from diffsim.data.study import Run, Study
from diffsim.identify.effect import Effect, needs_nothing
from diffsim.systems.ode.library import Library
from diffsim.systems.ode.scene import OdeScene

REFRESH = "refresh"  # place in a study's frame: periods by channel [s], 0 where there is none


def _name_of(channel: str) -> str:
    return f"own_clock_of_{channel}"


def refresh_periods(study: Study, only: Collection[str] | None = None) -> Mapping[str, float]:
    """Period of each channel's own clock [s], 0 where the runs to fit show none.

    A study with a ``frame`` has them from there.

    Args:
        only: Names of the causes that are judged; None: all. For others no clock is looked for.
    """
    if (kept := study.frame.get(REFRESH)) is not None:
        return {name: float(period) for name, period in kept.items()}
    periods = dict.fromkeys((c.name for c in study.channels), 0.0)
    for i, name in enumerate(periods):
        if only is None or _name_of(name) in only:
            records = ((r.time_s, r.measured[:, i]) for r in study.fit_runs)
            periods[name] = refresh_period(records) or 0.0
    return periods


def refresh_effects(library: Library, periods: Mapping[str, float]) -> tuple[Effect, ...]:
    """A clock of its own for each channel whose records show one.

    Args:
        periods: Period of each channel's clock [s]; 0 where there is none: the causes of which the
            study speaks are not judged there.
    """
    choice, out = library.system.keys.effects, []
    asked = {*(choice.only or ()), *choice.without, *choice.typical}
    for place, channel in enumerate(library.study.channels):
        name, period = _name_of(channel.name), periods.get(channel.name, 0.0)
        if not period and name not in asked:
            continue
        apply = partial(_read_at_ticks, place=place, period=period)
        found = rows("ode")["own_clock"].effect(apply, {"period": 1e3 * period})
        needs = needs_nothing if period else _lacks_a_clock
        out.append(replace(found, name=name, needs=needs))
    return tuple(out)


def _lacks_a_clock(study: Study) -> str:
    return "readings that lag by the age that a clock of the sensor's own gives them"


def _read_at_ticks(
    scene: OdeScene, size: Tensor, run: Run, *, place: int, period: float
) -> OdeScene:
    if not period:
        return scene
    readings = np.ascontiguousarray(run.measured[:, place], dtype=np.float64)
    times = np.ascontiguousarray(run.time_s, dtype=np.float64)
    phase = _phase(times.tobytes(), readings.tobytes(), period)
    share = size[..., 0, None, None]

    def held(signal: Tensor, grid: Grid) -> Tensor:
        """Some of a signal (..., width, num_times) as of the last tick, the rest as it is."""
        ticks = _last_ticks(grid.times.numpy().tobytes(), period, phase)
        return signal + share * (read_lines(signal, grid.times, ticks) - signal)

    return scene.with_reading((place,), held)


@lru_cache(maxsize=512)
def _last_ticks(times: bytes, period: float, phase: float) -> Tensor:
    """Time of the last tick at or before each time, the first one before any."""
    seconds = np.frombuffer(times)
    return torch.from_numpy(np.maximum(seconds - age(seconds, period, phase), seconds[0]))


@lru_cache(maxsize=512)
def _phase(times: bytes, readings: bytes, period: float) -> float:
    return phase_of(np.frombuffer(times), np.frombuffer(readings), period)
