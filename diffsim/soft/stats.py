"""What the solver did: residuals, iterations, solves and factorizations, step by step."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from diffsim.core.record import Solve, listening
from diffsim.soft._solves import SolveStats


@contextmanager
def record_stats() -> Iterator[list[SolveStats]]:
    """Collect the statistics of every solve inside the ``with`` block, in order of execution.

    These are the ``details`` of the soft solves of ``diffsim.record()``: each thread of Python
    collects its own. Steps that checkpointing computes twice are listed twice; explicit steps solve
    nothing.

    with soft.record_stats() as solves:
        final = body(state)
        loss(final).backward()
    print([s.num_iters.item() for s in solves if s.kind == "adjoint"])
    """
    solves: list[SolveStats] = []

    def listen(solve: Solve) -> None:
        if isinstance(solve.details, SolveStats):
            solves.append(solve.details)

    with listening(listen):
        yield solves
