"""Windows of the recorded starfish: what its four markers do alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from diffsim.data.importers.starfish import COMMAND, MARKERS
from diffsim.data.study import Channel, Run, Study

SPACING = 0.0762  # of the markers m2 and m3, nominal [m]
MODES = ("leg_x_m", "leg_z_m", "travel_x_m")
LEGS = MODES[:2]
FIRST = 6  # samples that displacements are counted from
AS_IMPORTED = {f"{marker}_{axis}_m" for marker in MARKERS for axis in "xz"}


def modes(
    study: Study,
    *,
    windows: Mapping[str, Sequence[float]],
    holdout: Sequence[str],
    channels: Sequence[str] = MODES,
    sd_m: float | None = None,
) -> Study:
    """Symmetric part of the four markers' motion, in windows of the runs.

    Upper and lower leg are averaged, so that pitch of the robot and tilt of the camera drop out:
    ``leg_x_m`` and ``leg_z_m``, tips (m1, m4) against the middles of the legs (m2, m3), outwards
    for z; ``travel_x_m``, the middles. Displacements from the first 0.1 s of the window, scaled by
    the run's marker spacing.

    Args:
        study: Study as imported.
        windows: Name of the window, "baseline" or "baseline+15": run, and how much later it begins
            than 0.2 s before the command does; values are that delay and its length [s].
        holdout: Names of the windows that no fit sees.
        channels: Names of the channels, out of ``MODES``.
        sd_m: Standard deviation of the noise that differences between repeats are compared with
            [m]; None: the differences are taken as the noise.
    """
    columns = [MODES.index(c) for c in channels]

    def cut(name: str, later: float, length: float) -> Run:
        run = next(r for r in study.runs if r.name == name.partition("+")[0])
        inside = (run.time_s >= later - 0.2) & (run.time_s < later - 0.2 + length)
        places = run.measured[inside].reshape(int(inside.sum()), len(MARKERS), 2)
        return replace(
            run,
            name=name,
            group="water_sequence" if run.group.startswith("water_sequence") else name,
            time_s=run.time_s[inside] - run.time_s[inside][0],
            measured=symmetric(places, run.setup["marker_spacing_m2_m3_m"])[:, columns],
            command={COMMAND: run.command[COMMAND][inside]},
            use="test" if name in holdout else "fit",
        )

    runs = [cut(name, float(w[0]), float(w[1])) for name, w in windows.items()]
    runs = [replace(run, order=i) for i, run in enumerate(runs)]
    medium = {"air" if r.name.startswith("airtest") else "water" for r in runs}
    if len(medium) > 1:
        raise ValueError(f"windows must be all in water or all in air, got {sorted(windows)}")
    return replace(
        study,
        channels=tuple(Channel(c, "m", "position", sd_m) for c in channels),
        runs=tuple(runs),
        metadata={**study.metadata, "medium": medium.pop(), "setup": "starfish"},
    )


def symmetric(places: NDArray[np.float64], spacing_m: float) -> NDArray[np.float64]:
    """(n, 3) ``MODES`` from places (n, 4 markers, x and z) [m]."""
    moved = (SPACING / spacing_m) * (places - places[:FIRST].mean(0))
    lower, low, high, upper = np.moveaxis(moved, 1, 0)
    travel = 0.5 * (low + high)[:, 0]
    leg_x = 0.5 * (lower + upper)[:, 0] - travel
    leg_z = 0.5 * ((upper - high) - (lower - low))[:, 1]
    return np.stack([leg_x, leg_z, travel], 1)
