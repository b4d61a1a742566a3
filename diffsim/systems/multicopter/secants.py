"""Gauss-Newton steps made longer by what they have shown of the bend beyond them.

Gauss-Newton leaves out second derivatives. Where misfit is left, each step so ends a share of the
way before the optimum: the map from states to those after a step, d -> G(d), has a slope J there.
Broyden's updates learn J from pairs of steps, and d + (I - J)^-1 (G(d) - d) has its fixed point at
the same place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

NUDGE = 1e-4  # of the spread, for slopes: less says nothing


@dataclass(frozen=True, eq=False)
class Secants:
    """Slope of the map from initial states to those after a Gauss-Newton step."""

    spread: Tensor  # of the initial states, (m,)
    slope: Tensor  # J by window, (num_windows, m, m), of states in units of the spread

    @classmethod
    def none(cls, windows: int, spread: Tensor) -> Secants:
        """Nothing is known yet: steps stay as they are."""
        return cls(spread, spread.new_zeros(windows, len(spread), len(spread)))

    def ahead(self, step: Tensor) -> Tensor:
        """(I - J)^-1 step, (num_windows, m); the step itself where that is far longer."""
        scaled = step / self.spread
        unit = torch.eye(len(self.spread), dtype=step.dtype)
        there, info = torch.linalg.solve_ex(unit - self.slope, scaled)
        # not a number, where there is no solution, is not below either
        is_near = there.norm(dim=-1, keepdim=True) < 3.0 * scaled.norm(dim=-1, keepdim=True)
        return torch.where(is_near & (info == 0)[:, None], there * self.spread, step)

    def learned(self, moved: Tensor, before: Tensor, after: Tensor) -> Secants:
        """With Broyden's update by two steps.

        Args:
            moved: From the states of the first to those of the second, (num_windows, m).
            before, after: Steps wanted at both, (num_windows, m).
        """
        d, change = moved / self.spread, (moved + after - before) / self.spread
        square = d.square().sum(-1)[:, None, None]
        missed = change[..., None] - self.slope @ d[..., None]
        update = missed * d[:, None] / square.clamp(min=NUDGE**2)
        return replace(self, slope=self.slope + update * (square > NUDGE**2))
