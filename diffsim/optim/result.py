"""Result of a search, and why it ended."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.core.record import Solve
from diffsim.optim.evaluation import Evaluation

Ended = Literal["converged", "budget", "callback", "failed"]


@checked(kinds_only=True)
@dataclass(frozen=True, eq=False, kw_only=True)
class Result:
    """Result of a search.

    Attributes:
        history: All evaluations in the order in which L-BFGS asked for them.
        final: The iterate that L-BFGS accepted last. It may be worse than the best evaluation:
            a line search can pass that by.
        ended: "converged": a tolerance is met. "budget": evaluations or iterations are spent.
            "callback": the callback said so. "failed": a line search found no lower value.
        message: Reason for the end in words, scipy's own where scipy ended the search.
    """

    history: tuple[Evaluation, ...]
    final: Evaluation
    ended: Ended
    message: str

    @property
    def best(self) -> Evaluation:
        """The evaluation of the least value, the first where several share it."""
        return min(self.history, key=lambda e: e.value)

    @property
    def x(self) -> Array:
        """Point of the least value, (n,)."""
        return self.best.x

    @property
    def value(self) -> float:
        """Least value of the objective."""
        return self.best.value

    @property
    def gradient(self) -> Array:
        """Gradient at ``x``, (n,)."""
        assert self.best.gradient is not None  # the best has not failed: the start had not
        return self.best.gradient

    @property
    def num_evaluations(self) -> int:
        """Number of evaluations of value and gradient, failed ones included."""
        return len(self.history)

    @property
    def num_failed(self) -> int:
        """Evaluations that met the wall."""
        return sum(bool(e.failure) for e in self.history)

    @property
    def solve(self) -> Solve:
        """Why the search ended; the residual is the gradient's norm at ``final``."""
        gradient = self.final.gradient
        return Solve(
            solver="minimization",
            ended=(self.ended,),
            residual=(math.nan if gradient is None else float(np.linalg.norm(gradient)),),
            tolerance=(math.nan,),
            num_iters=(self.num_evaluations,),
            details=self.message,
        )

    @property
    def converged(self) -> bool:
        """Whether a tolerance is met."""
        return self.ended == "converged"
