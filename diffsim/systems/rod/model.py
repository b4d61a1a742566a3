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
from diffsim.systems.rod.statics import RodStatics, equilibrium, nearby

if TYPE_CHECKING:
    from diffsim.data.study import Run
    from diffsim.identify.effect import Effect
    from diffsim.identify.shape import MovingShape
    from diffsim.systems.description import BaseParameters
    from diffsim.systems.rod.keys import RodKeys

MOST_GUESSES = 1024  # a run's poses at the best guess beforehand
EQUILIBRIUM = 1000.0  # weighted steps of a pose


@dataclass(frozen=True, eq=False)
class RodPoses:
    """Equilibria of one rod.

    Attributes:
        strains: Twist and bends of the elements, (num_samples, N, 3) [1/m].
        slopes: Of the residual there, (num_samples, 3 N, 3 N).
    """

    strains: Tensor
    slopes: Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class RodScene(Scene):
    """A rod under the tensions of a run; each sample is a pose.

    Attributes:
        layout: What does not change with a number: elements, markers, paths.
        tolerance: Turn of the solver's last step [rad].
        guess: Known poses to start from; None: straight, without tension.
    """

    layout: RodLayout
    tolerance: float
    guess: RodPoses | None = None

    @property
    def tensions(self) -> Tensor:
        """Commanded tensions as the tendons hear them, (..., num_samples, num_tendons) [N]."""
        return self.commands.heard(self.grid).mT

    def simulate(self) -> Tensor:
        """Predicted channels, (num_samples, num_channels), with K in front for K points."""
        tensions = self.tensions
        rod, count = rod_of(self.layout, self.numbers, tensions)
        u = self._solve_strains(rod, count, tensions)
        markers, numbers = self.layout.markers, Numbers.of(self.numbers)
        ways = [f"{m}_{way}" for m in markers.names for way in ("along", "y", "z")]
        offset = markers.offset + numbers.stacked(*ways).unflatten(-1, (-1, 3))
        shown = rod.at_points(markers, offset, u).flatten(-2)[..., self.layout.columns]
        is_one = tensions.ndim == 2 and not any(v.ndim for v in self.numbers.values())
        return self.instruments.read_late(shown[0] if is_one else shown, self.grid)

    def poses(self) -> RodPoses:
        """Equilibria at the first point."""
        with torch.no_grad():
            rod, count = rod_of(self.layout, self.numbers, self.tensions)
            found, slopes = self._find_strains(rod, count, slopes_of_all=True)
        assert slopes is not None
        return RodPoses(found[0], slopes[0])

    def course(self) -> tuple[Tensor, Tensor]:
        """Rotations (num_samples, N + 1, 3, 3) and places (num_samples, N + 1, 3) [m] of the
        sections at the ends of the elements, at the first point."""
        tensions = self.tensions
        rod, count = rod_of(self.layout, self.numbers, tensions)
        frames, places = rod.course(self._solve_strains(rod, count, tensions))
        return frames[0], places[0]

    def skin(self) -> MovingShape:
        """The rod in every pose; what causes change in channels is left out."""
        with torch.no_grad():
            added = float(self.numbers.get("radius_offset", torch.zeros(())))
            return skin_of(self.layout, *self.course(), added)

    def _solve_strains(self, rod: RodStatics, count: int, tensions: Tensor) -> Tensor:
        """(K, num_samples, N, 3) in equilibrium [1/m]; differentiable in the numbers."""
        slopes_of_all = torch.is_grad_enabled() and any(
            v.requires_grad for v in (tensions, *self.numbers.values())
        )
        with torch.no_grad():
            found, slopes = self._find_strains(rod, count, slopes_of_all)
        if not slopes_of_all:
            return found
        # one step more, which moves nothing, carries derivatives: u = u - J^-1 residual(numbers)
        assert slopes is not None
        left = rod.residual(found).flatten(2)[..., None]
        return found - torch.linalg.solve(slopes, left).reshape(found.shape)

    def _find_strains(
        self, rod: RodStatics, count: int, slopes_of_all: bool
    ) -> tuple[Tensor, Tensor | None]:
        """Strains, and slopes of the residual there (K, num_samples, 3 N, 3 N) if asked for."""
        lengths, guess = self.layout.shape.lengths, self.guess
        if guess is None:
            poses = self.commands.values.shape[-1]
            start = torch.zeros(poses, len(lengths), 3, dtype=torch.float64)
        else:
            start = guess.strains
            if not slopes_of_all:  # slopes cost a hundred residuals
                many = start.expand(count, *start.shape)
                close = nearby(rod.residual, many, guess.slopes, lengths, self.tolerance)
                if close is not None:
                    return close, None
        known, slopes = equilibrium(rod.row(0), start, self.tolerance, straight=guess is None)
        if count == 1:
            return known[None], slopes[None]
        if not slopes_of_all:
            many = known.expand(count, *known.shape)
            close = nearby(rod.residual, many, slopes, lengths, self.tolerance)
            if close is not None:
                return close, None
        pairs = [equilibrium(rod.row(k), known, self.tolerance) for k in range(count)]
        return torch.stack([p[0] for p in pairs]), torch.stack([p[1] for p in pairs])


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
        self.step_cost = EQUILIBRIUM
        self._layout = lru_cache(maxsize=8)(lambda finer: layout_of(given, channels, finer))
        self._guesses: Memo[RodPoses] = Memo(MOST_GUESSES)
        super().__init__(self._build, parameters.base, "described rod", batched=True)

    def _build(self, values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> RodScene:
        """The scene of a run, which starts from the run's pose at the best guess beforehand."""
        scene = self._build_scene(self.parameters.in_run(values, run), run, numerics)
        pulls = (
            scene.commands.values.mT.numpy()
        )  # the first half of a run has its name, and fewer of them
        key = (run.name, len(pulls), pulls.tobytes(), numerics.mesh)
        guess = self._guesses(key, lambda: self._build_at_prior(run, numerics).poses())
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


__all__ = ["RodModel", "RodPoses", "RodScene"]
