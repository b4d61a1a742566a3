"""A co-design program in its free unknowns, and notes of a solver's progress on it."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from diffsim.copter.codesign.hessian import lagrangian_hessian
from diffsim.copter.codesign.program import Program
from diffsim.core.arrays import Array


class FreeProgram:
    """A program in its free unknowns only; the fixed ones stay where the start has them."""

    def __init__(self, program: Program, start: Array):
        self.program = program
        thrusts = np.arange(program.num_all) >= program.at["v"].start
        self.whole = np.where(thrusts & ~program.free, program.fixed_value, start)
        self.start = np.clip(self.whole[program.free], program.lower, program.upper)
        self._kept: dict[str, tuple[bytes, tuple[Any, ...]]] = {}

    def fill(self, y: Array) -> Array:
        """All unknowns of the free ones."""
        x = self.whole.copy()
        x[self.program.free] = y
        return x

    def _evaluate(self, name: str, y: Array) -> tuple[Any, ...]:
        key = y.tobytes()
        kept = self._kept.get(name)
        if kept is None or kept[0] != key:
            value, jacobian = getattr(self.program, name)(self.fill(y))
            kept = (key, (value, jacobian[..., self.program.free]))
            self._kept[name] = kept
        return kept[1]

    def objective(self, y: Array) -> tuple[float, Array]:
        """Value and gradient."""
        return self._evaluate("objective", y)

    def metric(self, y: Array) -> float:
        """Weighted relative metrics, without nearness."""
        return float(self.program.metric(self.fill(y))[0])

    def values(self, name: str, y: Array) -> Array:
        """Values of ``equalities`` or ``inequalities``."""
        return self._evaluate(name, y)[0]

    def jacobian(self, name: str, y: Array) -> Array:
        """Jacobian of ``equalities`` or ``inequalities``."""
        return self._evaluate(name, y)[1]

    def hessian(
        self,
        y: Array,
        of_objective: float,
        equalities: Array | None = None,
        inequalities: Array | None = None,
    ) -> Array:
        """Hessian of the Lagrangian with these multipliers (None: zeros)."""
        x, keep = self.fill(y), self.program.free
        if equalities is None:
            equalities = np.zeros(len(self.values("equalities", y)))
        if inequalities is None:
            inequalities = np.zeros(len(self.values("inequalities", y)))
        full = lagrangian_hessian(self.program, x, equalities, inequalities, of_objective)
        return full[np.ix_(keep, keep)]

    def violation(self, y: Array) -> float:
        """Largest violation of any constraint, relative."""
        equal = np.abs(self.values("equalities", y)).max(initial=0.0)
        unequal = (-self.values("inequalities", y)).max(initial=0.0)
        p = self.program
        bounds = max((p.lower - y).max(initial=0.0), (y - p.upper).max(initial=0.0))
        return float(max(equal, unequal, bounds))


class Notes:
    """Objective, violation and wall time after each iteration."""

    def __init__(self, free: FreeProgram):
        self.free, self.began = free, time.perf_counter()
        self.values: list[float] = []
        self.violations: list[float] = []
        self.seconds: list[float] = []
        self(free.start)

    def __call__(self, y: Array, *_: object) -> None:
        self.values.append(self.free.metric(y))
        self.violations.append(self.free.violation(y))
        self.seconds.append(time.perf_counter() - self.began)
