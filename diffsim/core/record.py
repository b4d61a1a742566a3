"""Why a solve ended: one record for every solver, and the list of what a block of code solved.

The words are few, as in PETSc's converged reasons: a result that can be used has "converged" or is
"rank_deficient"; whatever else it says is the reason why it cannot.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, get_args

from diffsim.core.units import after_number

Ended = Literal[
    "converged",
    "rank_deficient",
    "budget",
    "stalled",
    "infeasible",
    "callback",
    "failed",
    "not_finite",
]
ENDED: tuple[Ended, ...] = get_args(Ended)
USABLE: tuple[Ended, ...] = ("converged", "rank_deficient")


@dataclass(frozen=True, eq=False, kw_only=True)
class Solve:
    """Why a solve ended, and how well its equations are solved; a value for each item of a batch.

    Attributes:
        solver: The equations that were solved, such as "soft step" or "adjoint of a Stokes flow".
        ended: "converged": the residual met its tolerance. "rank_deficient": so it did, at a
            solution that is not the only one. "budget": iterations or evaluations are spent.
            "stalled": no step made it smaller any more. "infeasible": no solution keeps the limits.
            "callback": the caller's function said so. "failed": the solver gave up. "not_finite":
            NaN or infinity.
        residual: What the equations leave, in ``unit``.
        tolerance: What the residual had to reach, in ``unit``; NaN where another measure decides.
        num_iters: Iterations, or evaluations of a search.
        unit: Unit of residual and tolerance; "-" where they are relative.
        details: The solver's own figures: ``soft.SolveStats``, a flow's ``stats``, ...
    """

    solver: str
    ended: tuple[Ended, ...]
    residual: tuple[float, ...]
    tolerance: tuple[float, ...]
    num_iters: tuple[int, ...]
    unit: str = "-"
    details: Any = None

    def __post_init__(self) -> None:
        count = len(self.ended)
        for name in ("residual", "tolerance", "num_iters"):
            if len(getattr(self, name)) != count:
                raise ValueError(
                    f"{name} must have {count} values, one for each of ended, "
                    f"got {len(getattr(self, name))}"
                )
        for word in self.ended:
            if word not in ENDED:
                raise ValueError(f"ended must be of {', '.join(ENDED)}, got {word!r}")

    @property
    def converged(self) -> bool:
        """Whether every item can be used."""
        return all(word in USABLE for word in self.ended)

    @property
    def worst(self) -> int:
        """Index of the first item that cannot be used, or of the largest residual."""
        for index, word in enumerate(self.ended):
            if word not in USABLE:
                return index
        return max(range(len(self.residual)), key=self.residual.__getitem__, default=0)

    def __str__(self) -> str:
        if not self.ended:
            return f"{self.solver}: nothing to solve"
        i = self.worst
        of = f" (item {i} of {len(self.ended)})" if len(self.ended) > 1 else ""
        unit = after_number(self.unit)
        needed = "" if math.isnan(self.tolerance[i]) else f", needed {self.tolerance[i]:.1e}{unit}"
        return (
            f"{self.solver}{of}: {self.ended[i]} after {self.num_iters[i]} iterations at residual "
            f"{self.residual[i]:.1e}{unit}{needed}"
        )


@dataclass(frozen=True, eq=False)
class Record:
    """What a block of code solved, and what it was warned of, both in order.

    Attributes:
        solves: Every solve; steps that checkpointing computes twice are listed twice.
        warnings: Every warning of diffsim, also those that Python's filters hide.
    """

    solves: list[Solve] = field(default_factory=list)
    warnings: list[Warning] = field(default_factory=list)

    @property
    def failed(self) -> list[Solve]:
        """The solves of which an item cannot be used."""
        return [solve for solve in self.solves if not solve.converged]


class _Listener(NamedTuple):
    solve: Callable[[Solve], object]
    warning: Callable[[Warning], object] | None


_listeners: ContextVar[tuple[_Listener, ...]] = ContextVar("diffsim records", default=())


@contextmanager
def listening(
    solve: Callable[[Solve], object], warning: Callable[[Warning], object] | None = None
) -> Iterator[None]:
    """Call ``solve`` and ``warning`` with every one inside the ``with`` block, in this thread."""
    token = _listeners.set((*_listeners.get(), _Listener(solve, warning)))
    try:
        yield
    finally:
        _listeners.reset(token)


@contextmanager
def record() -> Iterator[Record]:
    """Collect every solve and every warning inside the ``with`` block.

    Each thread of Python collects its own; threads that diffsim starts belong to the one that
    started them. Blocks can be nested.

    with diffsim.record() as done:
        loss(body(state)).backward()
    for solve in done.solves:
        print(solve)  # soft step: converged after 3 iterations at residual 1.2e-07 N, ...
    """
    mine = Record()
    with listening(mine.solves.append, mine.warnings.append):
        yield mine


def is_recording() -> bool:
    """Whether anybody listens: a solver need not make its ``Solve`` otherwise."""
    return bool(_listeners.get())


def announce(solve: Solve) -> None:
    """Add a solve to all open records."""
    for each in _listeners.get():
        each.solve(solve)


def warn(message: str, category: type[Warning] = UserWarning, *, stacklevel: int = 1) -> None:
    """``warnings.warn``, collected by all open records.

    Args:
        message: The warning's text.
        stacklevel: As of ``warnings.warn``, seen from the caller.
    """
    for each in _listeners.get():
        if each.warning is not None:
            each.warning(category(message))
    warnings.warn(message, category, stacklevel=stacklevel + 1)


def verdict(
    converged: Sequence[float], residual: Sequence[float], num_iters: Sequence[float], budget: float
) -> tuple[Ended, ...]:
    """Why iterations ended, for each item.

    Args:
        converged: Nonzero where the tolerance was met.
        residual: Residuals of the last iteration.
        num_iters: Number of iterations that were done.
        budget: Most iterations allowed.
    """
    words: list[Ended] = []
    for done, left, count in zip(converged, residual, num_iters, strict=True):
        if not math.isfinite(left):
            words.append("not_finite")
        elif done:
            words.append("converged")
        else:
            words.append("budget" if count >= budget else "stalled")
    return tuple(words)
