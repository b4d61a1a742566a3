"""What it would buy to mend a cause: a task's optimum with it, with half of it, and without it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import torch

from diffsim.core.checked import checked
from diffsim.core.figures import figure
from diffsim.core.units import after_number, factor, small_scale
from diffsim.data.shown import unit_of_steps
from diffsim.diagnose.judge.own_values import words_of
from diffsim.sim_to_real.tracking import EVALUATIONS, TrackingTask, best_command
from diffsim.systems.twin import Twin

SHARES = (1.0, 0.5, 0.0)  # of a cause's size: as it is, half mended, mended
ALL = "all"
UNSHOWN = 5e-3  # of a number: what its first digits do not show
MISS = "miss"  # root mean square, in units of ``miss``
Found = TypeVar("Found")


@checked(kinds_only=True)
@dataclass(frozen=True)
class Worth:
    """A task's optimum, a cause mended in part.

    Attributes:
        cause: Its name; "all" for all together.
        whole, half, none: With the cause, with half of it, and without it, each with the command
            that is best then.
        unaware: With the cause, under the command that is best without it.
        of: What these are: "miss", root mean squares in units of ``miss``, less is better; or
            "travel" [m], more is better.
        noise: What the search for a command leaves open: by how much its two best ends with the
            cause differ, and what three digits do not show.
        unit: Unit in which a miss is read; empty: in the task's ``miss``, where channels differ.
        one: How large a miss of 1 is, in ``unit``.
    """

    cause: str
    whole: float
    half: float
    none: float
    unaware: float
    of: str = MISS
    noise: float = 0.0
    unit: str = ""
    one: float = 1.0

    @checked
    def read(self, value: float) -> str:
        """One of these numbers with its unit, small ones with a prefix.

        Args:
            value: As ``whole``, ``bought`` and so on.
        """
        given, one = ("m", 1.0) if self.of != MISS else (self.unit, self.one)
        unit, times = small_scale(given, (one * self.whole, one * self.none))
        return f"{figure(times * one * value)}{after_number(unit)}"

    @property
    def bought(self) -> float:
        """What mending it as a whole buys: misses less, or way more [m]."""
        return self.whole - self.none if self.of == MISS else self.none - self.whole

    @property
    def is_nothing(self) -> bool:
        """Whether mending the cause gains no more than the search for a command leaves open."""
        return self.bought <= self.noise

    @property
    def words(self) -> str:
        """A line for people."""
        name = "all causes" if self.cause == ALL else words_of(self.cause)
        text = (
            f"{name}: best {self.of} {self.read(self.whole)} with it, {self.read(self.half)} "
            f"with half, {self.read(self.none)} without; {self.read(self.unaware)} if the command "
            "does not know of it"
        )
        return f"{text}; mending it buys nothing" if self.is_nothing else text


@dataclass(frozen=True)
class TaskByShare(Generic[Found]):
    """What is asked of a model in which causes act with a share of their sizes."""

    # function (share, causes, best command so far or None) -> the best command
    best: Callable[[float, Collection[str], Found | None], Found]
    score: Callable[[Found], float]  # function of it: what it reached in its own model
    unaware: Callable[[Found], float]  # function of it: what it reaches where causes act in full
    of: str = MISS  # what scores are

    def worth(self, causes: Sequence[str]) -> tuple[Worth, ...]:
        """What each cause costs, and all causes together where there are several."""
        groups: dict[str, Sequence[str]] = {name: [name] for name in causes}
        if len(groups) > 1:
            groups[ALL] = causes
        whole, mended = [self.best(SHARES[0], (), None)], {}
        for name, mine in groups.items():
            # each from where the one before ended, with the cause once more: left to chance, what
            # has the cause might do worse than by the command that does not know of it
            half = self.best(SHARES[1], mine, whole[0])
            none = self.best(SHARES[2], mine, half)
            mended[name] = half, none
            whole.append(self.best(SHARES[0], (), none))
        best, second = sorted((self.score(found) for found in whole), reverse=self.of != MISS)[:2]
        noise = max(abs(best - second), UNSHOWN * abs(best))
        return tuple(
            Worth(
                name, best, self.score(half), self.score(none), self.unaware(none), self.of, noise
            )
            for name, (half, none) in mended.items()
        )


@checked
def worth(twin: Twin, task: TrackingTask, *, evaluations: int = EVALUATIONS) -> tuple[Worth, ...]:
    """What each cause costs a task, and all causes together where there are several.

    Args:
        twin: Diagnosed model, planned for the task's time and set-up.
        task: What is wanted.
        evaluations: Of each search for a command.
    """

    def unaware(knots: torch.Tensor) -> float:
        with torch.no_grad():
            return float(task.score(twin.simulate(task.commands(knots))))

    found = TaskByShare(
        best=lambda share, causes, last: best_command(
            twin.with_share(share, causes) if causes else twin,
            task,
            starts=None if last is None else [last.knots],
            evaluations=evaluations,
        ),
        score=lambda found: found.score,
        unaware=lambda found: unaware(torch.from_numpy(found.knots)),
    ).worth(twin.causes)
    channels = {c.name: c for c in twin.study.channels}
    wanted = [(channels[name], course.miss) for name, course in task.given.wanted.items()]
    kinds = {(c.unit, unit_of_steps(c), miss) for c, miss in wanted}
    unit, shown, one = kinds.pop() if len(kinds) == 1 else ("", "", 1.0)
    if shown != unit:
        unit, one = shown, one * factor(unit, shown)
    return tuple(replace(row, unit=unit, one=one) for row in found)
