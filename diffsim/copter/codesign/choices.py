"""Discrete choices by branch and bound: only what could still be better is solved."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from diffsim.copter.codesign.pareto import undominated
from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.core.errors import DiffsimError
from diffsim.core.runs import run_each

C = TypeVar("C")


@checked(kinds_only=True)
@dataclass(frozen=True)
class Chosen(Generic[C]):
    """Result of a search over choices.

    Attributes:
        choices: Choices of the front, sorted by their first figure, largest first.
        figures: Their figures, (num_choices, num_figures).
        solved: Everything that was solved, with its figures.
        pruned: Choices that were not: something solved is as good as they could be at best.
        failed: Choices without a solution, with the reason.
    """

    choices: tuple[C, ...]
    figures: Array
    solved: tuple[tuple[C, tuple[float, ...]], ...]
    pruned: tuple[C, ...]
    failed: tuple[tuple[C, str], ...]


@checked
def choose(
    choices: Sequence[C],
    bound: Callable[[C], Sequence[float]],
    solve: Callable[[C], Sequence[float]],
    *,
    executor: Executor | None = None,
    at_once: int = 8,
) -> Chosen[C]:
    """The choices that no other one beats in all figures, all to be made large.

    Choices are solved in rounds, those first whose bounds are best. One is left out where something
    solved has every figure at least as large as its bound: its own figures cannot be larger.

    Args:
        choices: What to choose from.
        bound: Function of a choice: figures that it cannot exceed; cheap, called for all.
        solve: Function of a choice: its figures. A ``DiffsimError`` says that it has none.
        executor: Executor of a round; None: one after another. It does not change what is solved.
        at_once: Choices of a round.

    Returns:
        ``Chosen``.

    Raises:
        ValueError: no choices, or a solution above its bound.
        DiffsimError: none of the choices has a solution.
    """
    if not choices:
        raise ValueError("choices is empty; give at least one")
    bounds = np.array([bound(choice) for choice in choices], dtype=np.float64)
    span = np.ptp(bounds, axis=0)
    order = list(np.argsort(-(bounds / np.where(span > 0.0, span, 1.0)).sum(1), kind="stable"))
    solved: list[tuple[int, tuple[float, ...]]] = []
    pruned: list[int] = []
    failed: list[tuple[int, str]] = []
    while order:
        found = np.array([figures for _, figures in solved]).reshape(len(solved), bounds.shape[1])
        out = {k for k in order if (found >= bounds[k]).all(axis=1).any()}
        pruned += [k for k in order if k in out]
        order = [k for k in order if k not in out]
        now, order = order[:at_once], order[at_once:]
        answers = run_each(_Attempt(solve), [choices[k] for k in now], executor)
        for k, answer in zip(now, answers, strict=True):
            if isinstance(answer, str):
                failed.append((k, answer))
                continue
            _require_below(choices[k], answer, bounds[k])
            solved.append((k, answer))
    if not solved:
        raise DiffsimError(f"none of {len(choices)} choices has a solution: {failed[-1][1]}")
    figures = np.array([f for _, f in solved])
    front = sorted(undominated(-figures), key=lambda i: -figures[i, 0])
    return Chosen(
        choices=tuple(choices[solved[i][0]] for i in front),
        figures=figures[front],
        solved=tuple((choices[k], f) for k, f in solved),
        pruned=tuple(choices[k] for k in pruned),
        failed=tuple((choices[k], why) for k, why in failed),
    )


class _Attempt(Generic[C]):
    """``solve``, with the reason as text where there is no solution."""

    def __init__(self, solve: Callable[[C], Sequence[float]]):
        self.solve = solve

    def __call__(self, choice: C) -> tuple[float, ...] | str:
        try:
            return tuple(float(v) for v in self.solve(choice))
        except DiffsimError as error:
            return " ".join(str(error).split())


def _require_below(choice: object, figures: Sequence[float], bound: Array) -> None:
    over = np.asarray(figures) - bound
    if (over > 1e-6 * np.abs(bound) + 1e-9).any():
        raise ValueError(
            f"bound of {choice} is {bound.tolist()}, but its solution is {list(figures)}: a bound "
            "must not be exceeded"
        )
