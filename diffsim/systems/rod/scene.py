"""Poses of one run of a rod, ready to be simulated: numbers that causes may change."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffsim.systems.rod.assembly import Numbers, rod_of
from diffsim.systems.rod.layout import Layout
from diffsim.systems.rod.statics import Rod, equilibrium, nearby

_ZERO = torch.zeros((), dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class RodScene:
    """A rod under the tensions of a run; each sample is a pose.

    Attributes:
        layout: What does not change with a number: elements, markers, paths.
        numbers: Numbers by name, () or (K,) for K points; what nobody gave is 0.
        command: Commanded tensions, (num_samples, num_tendons) [N].
        tolerance: Turn of the solver's last step [rad].
        guess: Bending strains to start from, (num_samples, N, 3); None: straight, without tension.
    """

    layout: Layout
    numbers: Mapping[str, Tensor]
    command: Tensor
    tolerance: float
    guess: Tensor | None = None

    def with_added(self, name: str, size: Tensor) -> RodScene:
        """The scene with a number larger by a size, () or (K,)."""
        return replace(self, numbers={**self.numbers, name: self.numbers.get(name, _ZERO) + size})

    def simulate(self) -> Tensor:
        """Predicted channels, (num_samples, num_channels), with K in front for K points."""
        rod, count = rod_of(self.layout, self.numbers, self.command)
        u = self._strains(rod, count)
        markers, numbers = self.layout.markers, Numbers.of(self.numbers)
        names = markers.names
        shift = [numbers.stacked(*(f"{m}_{way}" for m in names)) for way in ("along", "y", "z")]
        offset = markers.offset + torch.stack(shift, -1)
        shown = rod.at_points(markers, offset, u).flatten(-2)[..., self.layout.columns]
        return shown if any(v.ndim for v in self.numbers.values()) else shown[0]

    def strains(self) -> Tensor:
        """Twist and bends of the elements at the first point, (num_samples, N, 3) [1/m]."""
        return self._strains(*rod_of(self.layout, self.numbers, self.command))[0]

    def course(self) -> tuple[Tensor, Tensor]:
        """Rotations (num_samples, N + 1, 3, 3) and places (num_samples, N + 1, 3) [m] of the
        sections at the ends of the elements, at the first point."""
        rod, count = rod_of(self.layout, self.numbers, self.command)
        frames, places = rod.course(self._strains(rod, count))
        return frames[0], places[0]

    def _strains(self, rod: Rod, count: int) -> Tensor:
        """(K, num_samples, N, 3) in equilibrium [1/m]; differentiable in the numbers."""
        slopes_of_all = torch.is_grad_enabled() and any(
            v.requires_grad for v in self.numbers.values()
        )
        with torch.no_grad():
            found, slopes = self._found(rod, count, slopes_of_all)
        if not slopes_of_all:
            return found
        # one step more, which moves nothing, carries derivatives: u = u - J^-1 residual(numbers)
        left = rod.residual(found).flatten(2)[..., None]
        return found - torch.linalg.solve(slopes, left).reshape(found.shape)

    def _found(self, rod: Rod, count: int, slopes_of_all: bool) -> tuple[Tensor, Tensor]:
        """Strains, and slopes of the residual there (K or 1, num_samples, 3 N, 3 N)."""
        from_straight = self.guess is None
        shape = (len(self.command), len(self.layout.shape.radius), 3)
        start = torch.zeros(shape, dtype=torch.float64) if self.guess is None else self.guess
        known, slopes = equilibrium(rod.row(0), start, self.tolerance, straight=from_straight)
        if count == 1:
            return known[None], slopes[None]
        if not slopes_of_all:
            lengths = self.layout.shape.lengths
            start = known.expand(count, *known.shape)
            close = nearby(rod.residual, start, slopes, lengths, self.tolerance)
            if close is not None:
                return close, slopes[None]
        pairs = [equilibrium(rod.row(k), known, self.tolerance) for k in range(count)]
        return torch.stack([p[0] for p in pairs]), torch.stack([p[1] for p in pairs])


__all__ = ["RodScene"]
