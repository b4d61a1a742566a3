"""Named linear constraints: as text, matrices, satisfiability, the smallest conflict."""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import linprog

from diffsim.core.arrays import Array
from diffsim.core.errors import DiffsimError
from diffsim.core.expression import syntax_tree


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
    """sum of coefficient * parameter (== or <=) bound."""

    label: str  # description for messages; rows with one label stand and fall together
    coefficients: Mapping[str, float]  # by name of the parameter
    bound: float  # right-hand side
    relation: Literal["==", "<="]  # "==" or "<="


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


_RELATIONS = {ast.Eq: ("==", 1.0), ast.LtE: ("<=", 1.0), ast.GtE: ("<=", -1.0)}
_HOW = "write it as 'arm_1.length == 2 * arm_2.length + 0.1' (==, <= or >=, +, -, * and / numbers)"


def parse_constraint(text: str, require_name: Callable[[str], str]) -> Constraint:
    """A linear equality or inequality of parameters.

    Args:
        text: The relation; lengths in meters.
        require_name: Returns a parameter's name or raises for an unknown one.

    Raises:
        ValueError: not a linear relation, or an unknown parameter.
    """
    try:
        tree = syntax_tree(text.strip())
    except SyntaxError as error:
        raise ValueError(f"constraint {text!r} cannot be read ({error.msg}); {_HOW}") from error
    if (
        not isinstance(tree, ast.Compare)
        or len(tree.ops) != 1
        or type(tree.ops[0]) not in _RELATIONS
    ):
        raise ValueError(f"constraint {text!r} must be one relation; {_HOW}")
    relation, sign = _RELATIONS[type(tree.ops[0])]
    left = _linear(tree.left, text, require_name)
    right = _linear(tree.comparators[0], text, require_name)
    difference = _combine(left, right, -1.0)
    constant = difference.pop("", 0.0)
    coefficients = {name: sign * c for name, c in difference.items() if c != 0.0}
    if not coefficients:
        raise ValueError(f"constraint {text!r} holds no parameter; {_HOW}")
    return Constraint(text.strip(), coefficients, -sign * constant, relation)  # type: ignore[arg-type]


def _linear(node: ast.expr, text: str, require_name: Callable[[str], str]) -> dict[str, float]:
    """Coefficients by name; the constant under the empty name."""
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        return {"": float(node.value)}
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        return {require_name(f"{node.value.id}.{node.attr}"): 1.0}
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        return _combine({}, _linear(node.operand, text, require_name), -1.0)
    if isinstance(node, ast.BinOp):
        left = _linear(node.left, text, require_name)
        right = _linear(node.right, text, require_name)
        if isinstance(node.op, ast.Add | ast.Sub):
            return _combine(left, right, 1.0 if isinstance(node.op, ast.Add) else -1.0)
        if isinstance(node.op, ast.Mult) and set(left) <= {""}:
            return _combine({}, right, left.get("", 0.0))
        if isinstance(node.op, ast.Mult) and set(right) <= {""}:
            return _combine({}, left, right.get("", 0.0))
        if isinstance(node.op, ast.Div) and set(right) <= {""} and right.get("", 0.0) != 0.0:
            return _combine({}, left, 1.0 / right[""])
    raise ValueError(f"constraint {text!r} is not linear at {ast.unparse(node)!r}; {_HOW}")


def _combine(left: dict[str, float], right: dict[str, float], factor: float) -> dict[str, float]:
    result = dict(left)
    for name, coefficient in right.items():
        result[name] = result.get(name, 0.0) + factor * coefficient
    return result
