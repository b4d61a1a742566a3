"""The feasible set of a design: elimination of equalities, bounds, the closest point.

A composed design is the union of its parts' parameters and the intersection of their feasible sets
(thesis 3.2.2). The equalities are eliminated, x = offset + basis @ s, with free parameters s that
are entries of x themselves: they keep name, unit and meaning.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse
from scipy.optimize import linprog

from diffsim.copter.design.constraints import (
    Constraint,
    InfeasibleDesignError,
    irreducible_conflict,
    matrix,
    satisfiable,
)
from diffsim.core.arrays import Array, IntArray
from diffsim.core.errors import ConvergenceError
from diffsim.core.optional import optional

_RANK_TOL = 1e-9  # coefficients are lengths' multiples, of order one
_FEASIBLE = 1e-7  # [m], a tenth of a micrometer


@dataclass(frozen=True, eq=False)
class FeasibleSet:
    """Parameters x with equalities and inequalities, and free parameters s of the same."""

    names: tuple[str, ...]  # names of all parameters x, (n,)
    equalities: tuple[Constraint, ...]
    inequalities: tuple[Constraint, ...]
    free_idx: IntArray  # indices of the free entries of x, (n_free,)
    offset: Array  # (n,); basis: (n, n_free): x = offset + basis @ s
    basis: Array

    @cached_property
    def _reduced_rows(self) -> tuple[Array, Array, tuple[str, ...]]:
        a, b = matrix(self.names, self.inequalities)
        reduced, rest = _without_dust(a @ self.basis), b - a @ self.offset
        keep = np.abs(reduced).max(axis=1, initial=0.0) > _RANK_TOL
        labels = tuple(c.label for c, k in zip(self.inequalities, keep, strict=True) if k)
        return reduced[keep], rest[keep], labels

    @property
    def inequality_matrix(self) -> Array:
        """A of A s <= b, (num_rows, n_free); rows that no free parameter moves are left out."""
        return self._reduced_rows[0]

    @property
    def inequality_bound(self) -> Array:
        """b of A s <= b, (num_rows,)."""
        return self._reduced_rows[1]

    @property
    def inequality_labels(self) -> tuple[str, ...]:
        """What the rows of A s <= b are."""
        return self._reduced_rows[2]

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Least and greatest value of each free parameter over the set, infinite if none."""
        n = len(self.free_idx)
        result = np.full((2, n), np.inf)
        for i in range(n):
            for k, sign in enumerate((1.0, -1.0)):
                solution = linprog(
                    sign * np.eye(n)[i], *self._reduced_rows[:2], bounds=(None, None)
                )
                if solution.status == 0:
                    result[k, i] = solution.fun
        return result[0], -result[1]

    def violation(self, s: Array) -> float:
        """Greatest excess of A s - b, at least 0."""
        return float((self.inequality_matrix @ s - self.inequality_bound).max(initial=0.0))

    def require_feasible(self, extra: Sequence[Constraint] = ()) -> None:
        """Raises InfeasibleDesignError with an irreducible conflict if there is no point."""
        constraints = [*self.equalities, *self.inequalities, *extra]
        if not satisfiable(self.names, constraints):
            raise InfeasibleDesignError(irreducible_conflict(self.names, constraints))

    def closest(
        self, target: Array, weights: Array, pinned: Mapping[str, float] | None = None
    ) -> Array:
        """Free parameters of the feasible point closest to a target.

        min sum w (x - target)^2 s.t. x = offset + basis @ s, A s <= b, x[pinned] = value
        (thesis 3.2.2), solved by osqp.

        Args:
            target: (n,) in all parameters.
            weights: w, (n,), not negative.
            pinned: Values that must be met exactly, by name.

        Raises:
            InfeasibleDesignError: no such point; names the conflict.
            ConvergenceError: the QP's solver stopped early.
        """
        pins = [
            Constraint(f"asked for: {name} = {value:g}", {name: 1.0}, value, "==")
            for name, value in (pinned or {}).items()
        ]
        self.require_feasible(pins)
        p, q = matrix(self.names, pins)
        rows = np.concatenate([self.inequality_matrix, p @ self.basis])
        upper = np.concatenate([self.inequality_bound, q - p @ self.offset])
        lower = np.concatenate([np.full(len(self.inequality_bound), -np.inf), q - p @ self.offset])
        weighted = self.basis.T * weights
        gradient = weighted @ (self.offset - target)
        s = solve_qp(weighted @ self.basis, gradient, rows, lower, upper)
        missed = np.abs(p @ (self.offset + self.basis @ s) - q).max(initial=0.0)
        excess = max(self.violation(s), float(missed))
        if excess > _FEASIBLE:
            raise ConvergenceError(
                f"the closest design misses its constraints by {excess:.1e} m, needed "
                f"{_FEASIBLE:.0e} m; ask for a smaller change",
                residual_norm=excess,
                tolerance=_FEASIBLE,
                num_iters=0,
            )
        return s


def eliminate(
    names: Sequence[str], constraints: Sequence[Constraint], preference: Array
) -> FeasibleSet:
    """Free parameters and basis of the equalities' solutions.

    Args:
        preference: Per parameter; among choices the ones with the highest preference become free.

    Raises:
        InfeasibleDesignError: the equalities contradict each other, or leave nothing feasible.
    """
    equalities = tuple(c for c in constraints if c.relation == "==")
    inequalities = tuple(c for c in constraints if c.relation == "<=")
    a, b = matrix(names, equalities)
    dependent = _independent_columns(a, np.argsort(preference, kind="stable").astype(np.int64))
    free = np.setdiff1d(np.arange(len(names)), dependent)
    offset = np.zeros(len(names))
    basis = np.zeros((len(names), len(free)))
    basis[free, np.arange(len(free))] = 1.0
    if len(dependent):
        both = np.linalg.lstsq(a[:, dependent], np.column_stack([b, -a[:, free]]))[0]
        solution = _without_dust(both)
        offset[dependent], basis[dependent] = solution[:, 0], solution[:, 1:]
    result = FeasibleSet(tuple(names), equalities, inequalities, free, offset, basis)
    result.require_feasible()
    return result


def _without_dust(values: np.ndarray) -> Array:
    """Rounding errors set to zero, so that rows say what they mean."""
    return np.where(np.abs(values) < 1e-13, 0.0, values)


def _independent_columns(a: Array, order: IntArray) -> IntArray:
    """A maximal set of independent columns that prefers the first of ``order``."""
    chosen = []
    span = np.zeros((a.shape[0], 0))
    for column in order:
        rest = a[:, column]
        for _ in range(2):  # once more against rounding
            rest = rest - span @ (span.T @ rest)
        norm = float(np.linalg.norm(rest))
        if norm > _RANK_TOL:
            chosen.append(column)
            span = np.column_stack([span, rest / norm])
    return np.array(sorted(chosen), dtype=np.int64)


def staged_least_squares(stages: Sequence[tuple[Array, Array]], num_unknowns: int) -> Array:
    """s that minimizes |M s - r|^2 of the first stage, among those of the second, and so on.

    Args:
        stages: (M, r) each, (k, num_unknowns) and (k,).
        num_unknowns: Length of s; directions that no stage determines stay 0.
    """
    s = np.zeros(num_unknowns)
    free = np.eye(num_unknowns)
    for rows, rhs in stages:
        if free.shape[1] == 0 or len(rows) == 0:
            continue
        seen = rows @ free
        s = s + free @ np.linalg.lstsq(seen, rhs - rows @ s, rcond=1e-10)[0]
        free = free @ scipy.linalg.null_space(seen, rcond=1e-10)
    return s


def solve_qp(hessian: Array, gradient: Array, rows: Array, lower: Array, upper: Array) -> Array:
    """min 1/2 s' H s + g' s, lower <= rows s <= upper, polished.

    Args:
        hessian: H, symmetric positive semidefinite, (n, n).
        gradient: g, (n,).
        rows: (k, n).
        lower, upper: (k,); infinite where there is none.

    Returns:
        s, (n,).

    Raises:
        ImportError: osqp is not installed.
        ConvergenceError: it stopped early.
    """
    osqp: Any = optional("osqp", purpose="the closest feasible design")
    solver = osqp.OSQP()
    solver.setup(
        scipy.sparse.csc_matrix(np.triu(hessian)),
        gradient,
        scipy.sparse.csc_matrix(rows),
        lower,
        upper,
        verbose=False,
        eps_abs=1e-10,
        eps_rel=1e-10,
        max_iter=200_000,
        polishing=True,
    )
    result = solver.solve(raise_error=False)
    if not result.info.status.startswith("solved"):
        raise ConvergenceError(
            f"osqp stopped with '{result.info.status}' after {result.info.iter} iterations",
            residual_norm=float(result.info.prim_res),
            tolerance=1e-10,
            num_iters=int(result.info.iter),
        )
    return np.asarray(result.x, dtype=np.float64)
