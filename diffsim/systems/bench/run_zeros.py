"""A zero that is another one in each run: scales are tared by hand, amplifiers warm up in between.

Its components are called after the runs, as nuisances are ("...@run"). So a run that no fit has
seen tells its own, and nothing else is fitted to it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
from torch import Tensor

from diffsim.causes.readings import spell_plainly
from diffsim.data.study import Channel, Run, Study
from diffsim.identify.effect import Effect
from diffsim.systems.ode.scene import OdeScene

ZERO_SCALES = "zero_scales"  # place in a study's frame
SHARE = 0.02  # of what a channel shows: a zero that is no surprise
FEWEST = 3  # runs to fit: of two, one zero for both and their difference are alike


def zero_scales(study: Study) -> dict[str, float]:
    """Zero of each channel that would be no surprise [unit of the channel].

    A study with a ``frame`` has them from there.
    """
    kept = study.frame.get(ZERO_SCALES, {})
    return {c.name: float(kept.get(c.name) or _usual(study, i)) for i, c in _told(study)}


def run_zeros(study: Study, scales: Mapping[str, float]) -> tuple[Effect, ...]:
    """A cause for every channel: its zero in each run.

    Args:
        study: Study with the recordings.
        scales: Zero of each channel that would be no surprise (``zero_scales``).
    """
    return tuple(_run_zero(study, i, c, scales[c.name]) for i, c in _told(study))


def _told(study: Study) -> list[tuple[int, Channel]]:
    return list(enumerate(study.channels))


def _usual(study: Study, channel: int) -> float:
    seen = np.concatenate([r.measured[:, channel] for r in study.fit_runs or study.runs])
    seen = seen[np.isfinite(seen)]
    width = float(np.ptp(seen)) if len(seen) else 0.0
    return SHARE * width or 1.0


def _run_zero(study: Study, at: int, channel: Channel, typical: float) -> Effect:
    names = [r.name for r in study.runs if np.isfinite(r.measured[:, at]).any()]
    places = {name: k for k, name in enumerate(names)}
    return Effect(
        name=f"zero_per_run_of_{plain(channel.name)}",
        form=f"Readings of {channel.name} are larger by size, another one in each run.",
        family=f"zero_per_run_of_{channel.name}",
        kind="sensor",
        unit=channel.unit,
        shown_unit=channel.shown_unit,
        typical=typical,
        components=tuple(f"@{name}" for name in names) or ("size",),
        also_looks_like=("scale that is tared by hand", "temperature between runs"),
        apply=partial(_shifted, channel=channel.name, places=places),
        needs=partial(_enough, at=at),
    )


def _enough(study: Study, *, at: int) -> str | None:
    found = [r for r in study.fit_runs if np.isfinite(r.measured[:, at]).any()]
    return None if len(found) >= FEWEST else f"{FEWEST} runs to fit"


def _shifted(
    scene: OdeScene, size: Tensor, run: Run, *, channel: str, places: Mapping[str, int]
) -> OdeScene:
    if run.name not in places:
        return scene
    zero = size[..., places[run.name]]
    return scene.with_reading(channel, lambda y, grid: y + zero[..., None])


__all__ = ["ZERO_SCALES", "run_zeros", "zero_scales"]
