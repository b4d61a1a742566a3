"""Coarse simulations that are told once what finer ones would say.

A first answer simulates with few cells and long steps. What these get wrong is mostly a shift of
parameters (coarse cells are too stiff, long steps too slow) and little else. So with base
parameters q and the sizes s of causes

    S(q, s) = S_0(q + sum_k shift_k, s) + sum_k d_k,
    d_k = S_k(x) - S_0(x + shift_k) at one point x,

with one finer simulation S_k of each run for every setting that is refined: finer cells need not
take shorter steps too. This is space mapping with an output correction (Bandler et al., IEEE Trans.
Microwave Theory Tech. 52, 2004). Shifts add up where records do not: a phase that is off twice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.core.arrays import Array
from diffsim.core.memo import Memo, memo_field
from diffsim.data.study import Run
from diffsim.identify.numerics import Numerics


@dataclass(frozen=True, eq=False)
class Finer:
    """One setting refined."""

    numerics: Numerics  # settings, finer than the coarse ones in one respect
    # what coarse simulations add to the base parameters for it, standardized, (num_base,)
    shift: Array
    # settings that are coarser than these; None: nothing is extrapolated
    before: Numerics | None = None
    # how much farther records go than from ``before`` to these, as a share of that
    beyond: float = 0.0
    like: Numerics | None = None  # settings whose own records are like those; None: ``numerics``

    def predict(self, problem: Any, run: Run, point: Tensor) -> Tensor:
        """Records of a run of a problem at a point, extrapolated, (num_samples, num_channels)."""
        return self._follow(
            lambda numerics: replace(problem, numerics=numerics).predict(run, point)
        )

    def record(self, problem: Any, x: Array) -> Array:
        """The same of all runs of a problem, (N,)."""
        return self._follow(lambda numerics: replace(problem, numerics=numerics).record(x))

    def _follow(self, simulate: Callable[[Numerics], Any]) -> Any:
        """What is simulated, to the limit of its last change."""
        found = simulate(self.numerics)
        if self.before is None:
            return found
        return found + self.beyond * (found - simulate(self.before))


@dataclass(frozen=True, eq=False)
class Correction:
    """What finer settings change of the records of a problem, told at one point.

    Attributes:
        problem: ``Problem`` with the coarse settings, without a correction.
        x: Point at which finer simulations are made, in its standardized coordinates, (n,).
        finer: Settings that were refined, one in each.
        told: What is added to the records of some runs, where that was simulated before.
    """

    problem: Any
    x: Array
    finer: tuple[Finer, ...]
    told: tuple[tuple[Run, Tensor], ...] = ()
    _kept: Memo[Tensor] = memo_field()

    @property
    def shift(self) -> Tensor:
        """What coarse simulations add to the base parameters, standardized, (num_base,)."""
        total = np.zeros(self.problem.num_base)
        for one in self.finer:
            total = total + one.shift
        return torch.from_numpy(total)

    @property
    def finest(self) -> Numerics:
        """The settings that the corrected records stand for."""
        made: Numerics = self.problem.numerics or Numerics()
        for one in self.finer:
            steps = zip(
                _factors(one.like or one.numerics), _factors(self.problem.numerics), strict=True
            )
            made = made.refined(Numerics(*(fine / coarse for fine, coarse in steps)))
        return made

    @property
    def key(self) -> tuple[object, ...]:
        """What tells it from others of the same problem."""
        told = ((f.numerics, f.shift.tobytes(), f.before, f.beyond) for f in self.finer)
        return (self.x.tobytes(), *told)

    def of(self, run: Run) -> Tensor:
        """What is added to the coarse record of a run, (num_samples, num_channels); simulated when
        it is first asked for."""
        for known, added in self.told:
            if known.name == run.name and known.measured is run.measured:
                return added
        return self._kept(run, lambda: self._simulate_correction(run))

    def over(self, runs: Sequence[Run]) -> Array:
        """The same for several runs in a row, (N,)."""
        return np.concatenate([self.of(run).numpy().ravel() for run in runs])

    def known(self, runs: Sequence[Run], added: Array) -> Correction:
        """The correction with what is added to some runs, (N,), where that was simulated before."""
        parts = np.split(added, np.cumsum([run.measured.size for run in runs])[:-1])
        values = (
            torch.from_numpy(part.reshape(run.measured.shape).copy())
            for run, part in zip(runs, parts, strict=True)
        )
        return replace(self, told=tuple(zip(runs, values, strict=True)))

    @torch.no_grad()
    def _simulate_correction(self, run: Run) -> Tensor:
        point = torch.from_numpy(np.array(self.x))
        total = torch.zeros(run.measured.shape, dtype=torch.float64)
        for one in self.finer:
            moved = point.clone()
            moved[: len(one.shift)] += torch.from_numpy(one.shift)
            fine = one.predict(self.problem, run, point)
            total = total + fine - self.problem.predict(run, moved)
        return total


def _factors(numerics: Numerics | None) -> tuple[float, float, float]:
    factors = numerics or Numerics()
    return factors.time_step, factors.mesh, factors.tolerance
