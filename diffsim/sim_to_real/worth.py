"""What it would buy to mend a cause: a task's optimum with it, with half of it, and without it."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from diffsim.sim_to_real.tracking import EVALUATIONS, TrackingTask, best_command
from diffsim.systems.twin import Twin

SHARES = (1.0, 0.5, 0.0)  # of a cause's size: as it is, half mended, mended


@dataclass(frozen=True)
class Worth:
    """A task's optimum, a cause mended in part; root mean squares of misses in units of ``miss``.

    Attributes:
        cause: Its name; "all" for all together.
        whole, half, none: With the cause, with half of it, and without it, each with the command
            that is best then.
        unaware: With the cause, under the command that is best without it.
    """

    cause: str
    whole: float
    half: float
    none: float
    unaware: float

    @property
    def words(self) -> str:
        """A line for people."""
        return (
            f"{self.cause}: best miss {self.whole:.3g} with it, {self.half:.3g} with half, "
            f"{self.none:.3g} without; {self.unaware:.3g} if the command does not know of it"
        )


def worth(twin: Twin, task: TrackingTask, *, evaluations: int = EVALUATIONS) -> tuple[Worth, ...]:
    """What each cause costs a task, and all causes together where there are several.

    Args:
        twin: Diagnosed model, planned for the task's time and set-up.
        task: What is wanted.
        evaluations: Of each search for a command.
    """
    found, groups = [], {name: [name] for name in twin.causes}
    if len(groups) > 1:
        groups["all"] = list(twin.causes)
    whole = best_command(twin, task, evaluations=evaluations)
    for name, causes in groups.items():
        best = [whole]
        for share in SHARES[1:]:  # each from where the one before ended: least left to chance
            mended = twin.with_share(share, causes)
            start = best[-1].knots
            best.append(best_command(mended, task, starts=[start], evaluations=evaluations))
        _, half, none = best
        with torch.no_grad():
            seen = twin.simulate(task.commands(torch.from_numpy(none.knots)))
        unaware = float(task.score(seen))
        found.append(Worth(name, whole.score, half.score, none.score, unaware))
    return tuple(found)
