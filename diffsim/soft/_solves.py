"""Figures of a soft solve, in the order of the kernels, and what they say to the records."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

from torch import Tensor

from diffsim.core.record import Solve, announce, is_recording, listening, verdict


class SolveStats(NamedTuple):
    """One implicit step, one adjoint or one tangent solve; every tensor is (batch,) float64.

    Attributes:
        kind: ``step`` (also static equilibria), ``adjoint``, or ``tangent`` (one entry for all
            directions, of the worst; norms relative to its right-hand side).
        residual_norm: Norm of the last residual; step: [N], adjoint: unit of dL/dx.
        tolerance: Norm it had to reach, same unit.
        scale: Norm that ``rtol`` refers to, same unit.
        num_iters: Outer iterations; adjoint: Krylov iterations.
        num_solves: Solves with the constant factor.
        num_factorizations: Factorizations of the tangent.
        energy: Elastic energy at the answer [J]; adjoint: 0.
        converged: 1 where the residual met its tolerance, else 0.
        num_contacts: Nodes in contact at the answer; 0 without obstacles, as the following.
        num_slipping: How many of these slip.
        num_set_changes: Iterations that changed the status of a contact.
        num_cycles: Times that the statuses came round again and were resolved.
    """

    kind: str
    residual_norm: Tensor
    tolerance: Tensor
    scale: Tensor
    num_iters: Tensor
    num_solves: Tensor
    num_factorizations: Tensor
    energy: Tensor
    converged: Tensor
    num_contacts: Tensor
    num_slipping: Tensor
    num_set_changes: Tensor
    num_cycles: Tensor


STATS = SolveStats._fields[1:]
_SOLVERS = {
    "step": "soft step",
    "adjoint": "adjoint of a soft step",
    "tangent": "tangent of a soft step",
}
_UNITS = {"step": "N"}


def notify(kind: str, stats: Tensor, max_iters: int, *, contact: bool = False) -> None:
    """Tell the open records of a solve.

    Args:
        kind: As of :class:`SolveStats`.
        stats: (batch, len(STATS)) of the kernel.
        max_iters: Most iterations allowed.
        contact: Whether obstacles took part.
    """
    if not is_recording():
        return
    figures = SolveStats(kind, *stats.clone().unbind(1))
    residual, count = figures.residual_norm.tolist(), figures.num_iters.tolist()
    announce(
        Solve(
            solver=_SOLVERS[kind] + (" in contact" if contact else ""),
            ended=verdict(figures.converged.tolist(), residual, count, max_iters),
            residual=tuple(residual),
            tolerance=tuple(figures.tolerance.tolist()),
            num_iters=tuple(int(n) for n in count),
            unit=_UNITS.get(kind, "-"),
            details=figures,
        )
    )


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
