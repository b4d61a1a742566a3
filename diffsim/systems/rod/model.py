"""A described rod as a model: from values of its quantities to poses of runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.instruments import grid_of
from diffsim.core.memo import Memo
from diffsim.identify.model import SimModel
from diffsim.identify.numerics import Numerics
from diffsim.systems.rod.figure import dots_of, skin_of
from diffsim.systems.rod.layout import RodLayout, layout_of
from diffsim.systems.rod.scene import RodPoses, RodScene

if TYPE_CHECKING:
    from diffsim.data.study import Run
    from diffsim.identify.effect import Effect
    from diffsim.identify.shape import MovingShape
    from diffsim.systems.description import BaseParameters
    from diffsim.systems.rod.keys import RodKeys

MOST_GUESSES = 1024  # a run's poses at the best guess beforehand


class DescribedRod:
    """Makes scenes of a described rod.

    Args:
        given: Description.
        channels: Names of the channels, in the order of the study.
        parameters: Quantities of the description: base parameters, and values of a run.
    """

    def __init__(self, given: RodKeys, channels: Sequence[str], parameters: BaseParameters):
        self.given, self.parameters = given, parameters
        self._layout = lru_cache(maxsize=8)(lambda finer: layout_of(given, channels, finer))
        self._guesses: Memo[RodPoses] = Memo(MOST_GUESSES)

    def model(self) -> SimModel:
        """The model that is fitted; many points are simulated at once."""
        return RodModel(self)

    @property
    def layout(self) -> RodLayout:
        """What does not change with a number, on the elements as described."""
        return self._layout(1.0)

    def build(self, values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> RodScene:
        """The scene of a run, which starts from the run's pose at the best guess beforehand."""
        scene = self._build_scene(self.parameters.in_run(values, run), run, numerics)
        pulls = scene.command.numpy()  # the first half of a run has its name, and fewer of them
        key = (run.name, len(pulls), pulls.tobytes(), numerics.mesh)
        return replace(
            scene, guess=self._guesses(key, lambda: self._build_at_prior(run, numerics).poses())
        )

    def _build_at_prior(self, run: Run, numerics: Numerics) -> RodScene:
        values = {p.name: torch.tensor(p.value).double() for p in self.parameters.base}
        return self._build_scene(self.parameters.in_run(values, run), run, numerics)

    def _build_scene(self, numbers: Mapping[str, Tensor], run: Run, numerics: Numerics) -> RodScene:
        layout: RodLayout = self._layout(1.0 / numerics.mesh)
        columns = [np.asarray(run.command[t.command], np.float64) for t in self.given.tendons]
        command = np.stack(columns, 1) if columns else np.zeros((len(run.time_s), 0))
        tolerance = self.given.numerics.tolerance * numerics.tolerance
        drives = tuple(t.command for t in self.given.tendons)
        return RodScene(layout, numbers, torch.from_numpy(command), tolerance, drives, grid_of(run))


EQUILIBRIUM = 1000.0  # weighted steps of a pose


class RodModel(SimModel):
    """The model of a described rod, which shows it in space.

    Args:
        described: Makes its scenes.
    """

    def __init__(self, described: DescribedRod):
        self.described = described
        self.step_cost = EQUILIBRIUM
        super().__init__(described.build, described.parameters.base, "described rod", batched=True)

    def shape_of(self, run: Run, channels: Tensor) -> MovingShape | None:
        """Markers where channels tell all their coordinates."""
        return dots_of(self.described.layout, channels)

    def shape_at(
        self,
        run: Run,
        q: Tensor,
        sizes: Mapping[Effect, Tensor] | None = None,
        numerics: Numerics | None = None,
    ) -> MovingShape | None:
        """The skin of the rod in every pose."""
        scene = self.scene(run, q, sizes, numerics)
        assert isinstance(scene, RodScene)
        return skin_of(scene)


__all__ = ["DescribedRod", "RodModel"]
