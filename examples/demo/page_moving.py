"""The beam in motion: models side by side, to turn and play, with the measured markers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from diffsim.viz import report as rp
from diffsim.viz.figures import COLORS
from diffsim.viz.frames import triangles
from diffsim.viz.moving import Deforming, Moving
from examples.data.beam import TIP_MARKERS, BeamStudy
from examples.demo.ladder import Rung, run_of
from examples.demo.recording import ASIDE_M, ROLE

_MARKER_M = 0.002  # half the size of a marker's cube
_CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * _MARKER_M
_SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4],
                   [1, 5, 7, 3]])  # fmt: skip


def section(
    study: BeamStudy, results: Mapping[str, Any], models: Sequence[Rung]
) -> list[rp.Section]:
    """A section with the last case, the weighted beam; none where no surface was kept."""
    case, trials = list(study.repeats().items())[-1]
    kept: list[tuple[Rung, Any]] = []
    for rung in models:
        if rung.name in results["simulated"] and rung.name in ROLE:
            run = run_of(results["simulated"], rung, case)
            if "surface" in run:
                kept.append((rung, np.load(run["surface"])))
    if not kept:
        return []
    clock = np.asarray(kept[0][1]["time_s"], dtype=np.float64)
    parts = []
    for column, (rung, surface) in enumerate(kept):
        aside = np.array([0.0, ASIDE_M * column, 0.0])
        nearest = np.abs(np.asarray(surface["time_s"])[None, :] - clock[:, None]).argmin(1)
        parts.append(
            Deforming(
                name=rung.title,
                color=COLORS[ROLE[rung.name]],
                triangles=triangles(surface["quads"]),
                nodes_m=surface["nodes_m"][nearest] + aside,
            )
        )
        parts.append(_markers(study, trials[-1], clock, aside))
    caption = (
        "Red: the measured tip markers, beside every model. Drag to turn, wheel to zoom; a button "
        "hides what it names."
    )
    view = Moving(time_s=clock, parts=parts, caption=caption)
    return [rp.Section(title="The beam in motion", content=[view])]


def _markers(study: BeamStudy, trial: Any, clock: np.ndarray, aside: np.ndarray) -> Deforming:
    """Cubes at the nominal places of the tip markers plus their measured displacement."""
    nearest = np.abs(trial.time_s[None, :] - clock[:, None]).argmin(1)
    nominal = np.array([study.geometry.marker_place_m[name] for name in TIP_MARKERS])
    places = nominal + trial.marker_displacement_m[nearest] + aside  # (T, markers, 3)
    count = places.shape[1]
    nodes = (places[:, :, None, :] + _CUBE).reshape(len(clock), -1, 3)
    sides = triangles((_SIDES[None] + 8 * np.arange(count)[:, None, None]).reshape(-1, 4))
    return Deforming(name="measured", color=COLORS["bad"], triangles=sides, nodes_m=nodes)
