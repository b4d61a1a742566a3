"""Poses of one run of a rod, ready to be simulated: numbers that causes may change."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffsim.causes.instruments import InstrumentedScene
from diffsim.causes.ports import SignalMap
from diffsim.causes.signals import Grid, change_rows
from diffsim.systems.rod.assembly import Numbers, rod_of
from diffsim.systems.rod.layout import RodLayout
from diffsim.systems.rod.statics import RodStatics, equilibrium, nearby

_ZERO = torch.zeros((), dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class RodPoses:
    """Equilibria of one rod.

    Attributes:
        strains: Twist and bends of the elements, (num_samples, N, 3) [1/m].
        slopes: Of the residual there, (num_samples, 3 N, 3 N).
    """

    strains: Tensor
    slopes: Tensor


@dataclass(frozen=True, eq=False)
class RodScene(InstrumentedScene):
    """A rod under the tensions of a run; each sample is a pose.

    Attributes:
        layout: What does not change with a number: elements, markers, paths.
        numbers: Numbers by name, () or (K,) for K points; what nobody gave is 0.
        command: Commanded tensions, (..., num_samples, num_tendons) [N].
        tolerance: Turn of the solver's last step [rad].
        drives: Name of the command of each tendon.
        grid: Times of the samples.
        guess: Known poses to start from; None: straight, without tension.
    """

    layout: RodLayout
    numbers: Mapping[str, Tensor]
    command: Tensor
    tolerance: float
    drives: tuple[str, ...]
    grid: Grid
    guess: RodPoses | None = None

    def with_number(self, name: str, change: Callable[[Tensor], Tensor]) -> RodScene:
        """A copy in which a number is f(number), () or (K,)."""
        return replace(self, numbers={**self.numbers, name: change(self.numbers.get(name, _ZERO))})

    def with_command(self, names: tuple[str, ...], change: SignalMap) -> RodScene:
        """A copy in which some commands are f(commands (..., width, num_samples), grid)."""
        own = [i for i, drive in enumerate(self.drives) if not names or drive in names]
        changed = change_rows(self.command.mT, own, change, self.grid)
        return replace(self, command=changed.mT)

    def simulate(self) -> Tensor:
        """Predicted channels, (num_samples, num_channels), with K in front for K points."""
        rod, count = rod_of(self.layout, self.numbers, self.command)
        u = self._solve_strains(rod, count)
        markers, numbers = self.layout.markers, Numbers.of(self.numbers)
        ways = [f"{m}_{way}" for m in markers.names for way in ("along", "y", "z")]
        offset = markers.offset + numbers.stacked(*ways).unflatten(-1, (-1, 3))
        shown = rod.at_points(markers, offset, u).flatten(-2)[..., self.layout.columns]
        is_one = self.command.ndim == 2 and not any(v.ndim for v in self.numbers.values())
        return self.instruments.read_late(shown[0] if is_one else shown, self.grid)

    def poses(self) -> RodPoses:
        """Equilibria at the first point."""
        with torch.no_grad():
            rod, count = rod_of(self.layout, self.numbers, self.command)
            found, slopes = self._find_strains(rod, count, slopes_of_all=True)
        assert slopes is not None
        return RodPoses(found[0], slopes[0])

    def course(self) -> tuple[Tensor, Tensor]:
        """Rotations (num_samples, N + 1, 3, 3) and places (num_samples, N + 1, 3) [m] of the
        sections at the ends of the elements, at the first point."""
        rod, count = rod_of(self.layout, self.numbers, self.command)
        frames, places = rod.course(self._solve_strains(rod, count))
        return frames[0], places[0]

    def _solve_strains(self, rod: RodStatics, count: int) -> Tensor:
        """(K, num_samples, N, 3) in equilibrium [1/m]; differentiable in the numbers."""
        slopes_of_all = torch.is_grad_enabled() and any(
            v.requires_grad for v in (self.command, *self.numbers.values())
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
            start = torch.zeros(self.command.shape[-2], len(lengths), 3, dtype=torch.float64)
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


__all__ = ["RodPoses", "RodScene"]
