"""Frozen options of a search: budget, tolerances, failure wall."""

from __future__ import annotations

from dataclasses import dataclass, field

from diffsim.core.check import require_count, require_number
from diffsim.core.checked import checked
from diffsim.core.errors import DiffsimError


@dataclass(frozen=True)
class Budget:
    """Limits on the cost of a search.

    Attributes:
        evaluations: Largest number of evaluations of the objective with its gradient, failed ones
            included; None: any number.
        iterations: Largest number of L-BFGS iterations, each a line search; None: any number.
        finish_line_search: End a line search that is under way when the evaluations are spent, as
            scipy does; up to ``Tolerances.line_search`` evaluations come on top. Otherwise the
            budget is exact.
    """

    evaluations: int | None = 100
    iterations: int | None = None
    finish_line_search: bool = False

    def __post_init__(self) -> None:
        for name in ("evaluations", "iterations"):
            if getattr(self, name) is not None:
                require_number(name, getattr(self, name), at_least=1)
        if not isinstance(self.finish_line_search, (bool, int)):
            got = type(self.finish_line_search).__name__
            raise TypeError(f"finish_line_search must be True or False, got {got}")


@dataclass(frozen=True)
class Tolerances:
    """Tolerances of scipy's L-BFGS-B, by scipy's names and with its defaults.

    Attributes:
        ftol: A search converges when (f_k - f_k+1) / max(abs(f_k), abs(f_k+1), 1) is at most this,
            f in the search's unit.
        gtol: It converges when the largest component of the projected gradient is at most this.
        line_search: Evaluations of one line search at most.
        memory: Pairs of steps and gradient changes that make up the Hessian.
    """

    ftol: float = 2.2204460492503131e-09
    gtol: float = 1e-5
    line_search: int = 20
    memory: int = 10

    def __post_init__(self) -> None:
        for name in ("ftol", "gtol"):
            require_number(name, getattr(self, name), at_least=0.0)
        for name in ("line_search", "memory"):
            require_count(name, getattr(self, name), at_least=1)


@checked
@dataclass(frozen=True)
class Wall:
    """High plateau without slope that the line search sees where an evaluation fails.

    A failure is one of ``failures``, or a value or gradient that is not finite. The line search
    interpolates between the last good point and the wall, so that it backs off. The wall must be
    finite: after an infinite one scipy (1.17) returns to its last iterate and reports convergence.

    Attributes:
        height: Value at least, in the search's unit.
        over_first: At least this many times the size of the first value.
        over_best: At least this many times the least value so far.
        failures: Exceptions that count as a failed evaluation; others end the search. At the start
            all are raised, since no step leads back from there.
    """

    height: float = 1e3
    over_first: float = 1e3
    over_best: float = 0.0
    failures: tuple[type[Exception], ...] = (DiffsimError,)

    def __post_init__(self) -> None:
        for name in ("height", "over_first", "over_best"):
            require_number(name, getattr(self, name), at_least=0.0)

    @checked(kinds_only=True)
    def value(self, first: float, best: float) -> float:
        """Value of the wall, given the first and the least value so far, all in the search's
        unit."""
        return max(self.height, self.over_first * abs(first), self.over_best * best)


@checked
@dataclass(frozen=True)
class Options:
    """Budget, tolerances and failure wall of a search.

    Attributes:
        budget: Largest number of evaluations and iterations.
        tolerances: Tolerances at which the search has converged.
        wall: Exceptions and values that count as a failed evaluation; None: every exception ends
            the search.
        unit: L-BFGS sees value and gradient over this; tolerances count in it. None: the size of
            the first value (1 if that is zero).
    """

    budget: Budget = field(default_factory=Budget)
    tolerances: Tolerances = field(default_factory=Tolerances)
    wall: Wall | None = field(default_factory=Wall)
    unit: float | None = 1.0

    def __post_init__(self) -> None:
        if self.unit is not None:
            require_number("unit", self.unit, above=0.0)
