"""Named linear constraints: matrices, satisfiability, the smallest conflict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import linprog

from diffsim.core.arrays import Array
from diffsim.core.errors import DiffsimError


class InfeasibleDesignError(DiffsimError):
    """No design satisfies all constraints.

    Attributes:
        conflict: An irreducible set: without any one of these the rest could be satisfied.
    """

    def __init__(self, conflict: Sequence[str]):
        super().__init__(
            f"these {len(conflict)} constraints cannot all hold; change or drop one of them:\n  "
            + "\n  ".join(conflict)
        )
        self.conflict = tuple(conflict)


@dataclass(frozen=True)
class Constraint:
    """sum of coefficient * parameter (== or <=) bound.

    Attributes:
        label: Description for messages; rows with one label stand and fall together.
        coefficients: By name of the parameter.
        bound: Right-hand side.
        relation: "==" or "<=".
    """

    label: str
    coefficients: Mapping[str, float]
    bound: float
    relation: Literal["==", "<="]


def matrix(names: Sequence[str], constraints: Sequence[Constraint]) -> tuple[Array, Array]:
    """Rows (len(constraints), len(names)) and right-hand sides."""
    index = {name: i for i, name in enumerate(names)}
    rows = np.zeros((len(constraints), len(names)))
    for row, constraint in zip(rows, constraints, strict=True):
        for name, coefficient in constraint.coefficients.items():
            row[index[name]] += coefficient
    return rows, np.array([c.bound for c in constraints])


def irreducible_conflict(
    names: Sequence[str], constraints: Sequence[Constraint]
) -> tuple[str, ...]:
    """Labels of an irreducible unsatisfiable subset, by the deletion filter.

    Each label is left out in turn and stays out if the rest is still unsatisfiable (Chinneck,
    "Feasibility and Infeasibility in Optimization", 2008, alg. 6.2).
    """
    kept = list(dict.fromkeys(c.label for c in constraints))
    for label in list(kept):
        trial = [c for c in constraints if c.label in kept and c.label != label]
        if not satisfiable(names, trial):
            kept.remove(label)
    return tuple(kept)


def satisfiable(names: Sequence[str], constraints: Sequence[Constraint]) -> bool:
    """Whether any parameters satisfy all constraints (an LP by HiGHS)."""
    a_eq, b_eq = matrix(names, [c for c in constraints if c.relation == "=="])
    a_in, b_in = matrix(names, [c for c in constraints if c.relation == "<="])
    solution = linprog(np.zeros(len(names)), a_in, b_in, a_eq, b_eq, bounds=(None, None))
    return solution.status == 0
