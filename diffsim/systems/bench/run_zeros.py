"""A zero that is another one in each run: scales are tared by hand, amplifiers warm up in between.

Its components are called after the runs, as nuisances are ("...@run"). So a run that no fit has
seen tells its own, and nothing else is fitted to it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
from torch import Tensor

from diffsim.causes.catalogue import rows
from diffsim.causes.row import spell_plainly
from diffsim.causes.scales import Scales
from diffsim.core.schema import fill_in
from diffsim.data.study import Channel, Run, Study
from diffsim.identify.effect import Effect
from diffsim.systems.ode.scene import OdeScene

FEWEST = 3  # runs to fit: of two, one zero for both and their difference are alike


def run_zeros(study: Study, scales: Scales) -> tuple[Effect, ...]:
    """A cause for every channel: its zero in each run.

    Args:
        study: Study with the recordings.
        scales: Usual magnitudes of the channels.
    """
    return tuple(_run_zero(study, i, c, scales) for i, c in enumerate(study.channels))


def _run_zero(study: Study, at: int, channel: Channel, scales: Scales) -> Effect:
    names = [r.name for r in study.runs if np.isfinite(r.measured[:, at]).any()]
    places = {name: k for k, name in enumerate(names)}
    row = rows("ode")["zero_per_run"]
    return row.effect(
        partial(_shift_run, channel=at, places=places),
        scales.of_channels((channel.name,)),
        ending=f"_of_{spell_plainly(channel.name)}",
        form=fill_in(row.form, {"channel": channel.name}),
        family=f"{row.family}_of_{channel.name}",
        unit=channel.unit,
        shown_unit=None if channel.shown_formula else channel.shown_unit,
        components=tuple(f"@{name}" for name in names) or ("size",),
        needs=partial(_need_runs, at=at),
    )


def _need_runs(study: Study, *, at: int) -> str | None:
    found = [r for r in study.fit_runs if np.isfinite(r.measured[:, at]).any()]
    return None if len(found) >= FEWEST else f"{FEWEST} runs to fit"


def _shift_run(
    scene: OdeScene, size: Tensor, run: Run, *, channel: int, places: Mapping[str, int]
) -> OdeScene:
    if run.name not in places:
        return scene
    zero = size[..., places[run.name], None, None]
    return scene.with_reading((channel,), lambda y, grid: y + zero)


__all__ = ["run_zeros"]
