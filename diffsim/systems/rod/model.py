"""A described rod as a model: its scenes, from values of its quantities to poses of runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.scene import Commands, Scene, grid_of
from diffsim.core.memo import Memo
from diffsim.identify.model import SimModel
from diffsim.identify.numerics import Numerics
from diffsim.systems.rod.assembly import Numbers, rod_of
from diffsim.systems.rod.figure import dots_of, skin_of
from diffsim.systems.rod.layout import RodLayout, layout_of
from diffsim.systems.rod.statics import RodStatics

if TYPE_CHECKING:
    from diffsim.data.study import Run
    from diffsim.identify.effect import Effect
    from diffsim.identify.shape import MovingShape
    from diffsim.systems.description import BaseParameters
    from diffsim.systems.rod.keys import RodKeys


@dataclass(frozen=True, kw_only=True, eq=False)
class RodScene(Scene):
    """A rod under the tensions of a run; each sample is a pose."""

    layout: RodLayout  # what does not change with a number: elements, markers, paths
    tolerance: float  # turn of the solver's last step [rad]
    # strains to start from, (num_samples, N, 3) [1/m]; None: from straight
    guess: Tensor | None = None

    @property
    def tensions(self) -> Tensor:
        """Commanded tensions as the tendons hear them, (..., num_samples, num_tendons) [N]."""
        return self.commands.heard(self.grid).mT

    def simulate(self) -> Tensor:
        """Predicted channels, (num_samples, num_channels), with K in front for K points."""
        numbers = Numbers.of(self.numbers)
        ways = [f"{m}_{way}" for m in self.layout.markers.names for way in ("along", "y", "z")]
        offset = self.layout.markers.offset + numbers.stacked(*ways).unflatten(-1, (-1, 3))
        shown = self._solve(self._rod, offset)[1].flatten(-2)[..., self.layout.columns]
        is_one = self.tensions.ndim == 2 and not any(v.ndim for v in self.numbers.values())
        return self.instruments.read_late(shown[0] if is_one else shown, self.grid)

    @property
    def _rod(self) -> RodStatics:
        return rod_of(self.layout, self.numbers, self.tensions)

    def strains(self) -> Tensor:
        """Twist and bends at the first point in equilibrium, (num_samples, N, 3) [1/m]."""
        with torch.no_grad():
            return self._solve(self._rod, self.layout.markers.offset)[0][0]

    def course(self) -> tuple[Tensor, Tensor]:
        """Rotations (num_samples, N + 1, 3, 3) and places (num_samples, N + 1, 3) [m] of the
        sections at the ends of the elements, at the first point."""
        rod = self._rod
        with torch.no_grad():
            found = rod.survey(self._solve(rod, self.layout.markers.offset)[0])
        return found.frames[0], found.nodes[0]

    def skin(self) -> MovingShape:
        """The rod in every pose; what causes change in channels is left out."""
        with torch.no_grad():
            added = float(self.numbers.get("radius_offset", torch.zeros(())))
            return skin_of(self.layout, *self.course(), added)

    def _solve(self, rod: RodStatics, offset: Tensor) -> tuple[Tensor, Tensor]:
        """Strains (K, num_samples, N, 3) [1/m] and places of the markers (K, num_samples, P, 3)."""
        start, straight = self.guess, self.guess is None
        if start is None:
            shape = self.commands.values.shape[-1], len(self.layout.shape.radius), 3
            start = torch.zeros(shape, dtype=torch.float64)
        start = start.expand(Numbers.of(self.numbers).count, *start.shape)
        return rod.solve(self.layout.markers, offset, start, self.tolerance, straight=straight)


class RodModel(SimModel):
    """The model of a described rod; many points are simulated at once.

    Args:
        given: Description.
        channels: Names of the channels, in the order of the study.
        parameters: Quantities of the description: base parameters, and values of a run.
        zeros: Numbers that causes alone change.
    """

    def __init__(
        self,
        given: RodKeys,
        channels: Sequence[str],
        parameters: BaseParameters,
        zeros: tuple[str, ...],
    ):
        self.given, self.parameters, self.zeros = given, parameters, zeros
        self.step_cost = 1000.0  # weighted steps of a pose
        self._layout = lru_cache(maxsize=8)(lambda finer: layout_of(given, channels, finer))
        self._guesses: Memo[Tensor] = Memo()
        super().__init__(self._build, parameters.base, "described rod", batched=True)

    def _build(self, values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> RodScene:
        """The scene of a run, which starts from the run's pose at the best guess beforehand."""
        scene = self._build_scene(self.parameters.in_run(values, run), run, numerics)
        pulls = (
            scene.commands.values.mT.numpy()
        )  # the first half of a run has its name, and fewer of them
        key = (run.name, len(pulls), pulls.tobytes(), numerics.mesh)
        guess = self._guesses(key, lambda: self._build_at_prior(run, numerics).strains())
        return scene.changed(guess=guess)

    def _build_at_prior(self, run: Run, numerics: Numerics) -> RodScene:
        values = {p.name: torch.tensor(p.value).double() for p in self.parameters.base}
        return self._build_scene(self.parameters.in_run(values, run), run, numerics)

    def _build_scene(self, numbers: Mapping[str, Tensor], run: Run, numerics: Numerics) -> RodScene:
        layout: RodLayout = self._layout(1.0 / numerics.mesh)
        drives = [t.command for t in self.given.tendons]
        columns = [np.asarray(run.command[drive], np.float64) for drive in drives]
        tensions = np.stack(columns, 1) if columns else np.zeros((len(run.time_s), 0))
        return RodScene(
            grid=grid_of(run),
            numbers=numbers,
            zeros=self.zeros,
            commands=Commands.named(drives, torch.from_numpy(tensions).mT),
            layout=layout,
            tolerance=self.given.numerics.tolerance * numerics.tolerance,
        )

    def shape_of(self, run: Run, channels: Tensor) -> MovingShape | None:
        """Markers where channels tell all their coordinates."""
        return dots_of(self._layout(1.0), channels)

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
        return scene.skin()
