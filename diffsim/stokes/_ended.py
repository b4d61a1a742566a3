"""Why a flow's cases ended, and what is said where one did not converge."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from torch import Tensor

from diffsim.core.errors import ConvergenceError, ConvergenceWarning
from diffsim.core.record import Solve, announce, is_recording, verdict, warn
from diffsim.stokes._systems import StokesContext

STATS = ("num_iters", "divergence", "converged", "net_inflow", "residual", "pressure_error")
"""What the kernels tell of every case."""


def solve_of(stats: Tensor, what: str, options: Any, iterative: bool) -> Solve:
    """Why the cases of a flow ended, from their ``STATS``.

    Args:
        stats: (cases, len(STATS)).
        what: Name of the equations.
        options: The kernel's options.
        iterative: Whether the iterative solver was taken.
    """
    rows = [dict(zip(STATS, row, strict=True)) for row in stats.tolist()]
    measures = [_measure(row, options, iterative) for row in rows]
    reached = tuple(m.reached for m in measures)
    count = tuple(int(row["num_iters"]) for row in rows)
    return Solve(
        solver=what,
        ended=verdict([row["converged"] for row in rows], reached, count, options.max_iters),
        residual=reached,
        tolerance=tuple(m.tolerance for m in measures),
        num_iters=count,
        details=dict(zip(STATS, stats.unbind(-1), strict=True)),
    )


class _Measure(NamedTuple):
    """What decides whether a case has converged, how far it came, and what helps."""

    name: str
    reached: float
    tolerance: float
    remedy: str


def _measure(row: dict[str, float], options: Any, iterative: bool) -> _Measure:
    """Of the conditions that are not met, the one that is to blame; where all are, the residual."""
    residual = _Measure("relative residual", row["residual"], options.rtol, _remedy(iterative))
    if not options.incompressible:
        return residual
    remedy = "raise max_iters or bulk_ratio, or loosen tolerance"
    reached = {
        "relative divergence": row["divergence"],
        "estimated error of the pressures": row["pressure_error"],
    }
    unmet = [
        _Measure(name, value, options.tolerance, remedy)
        for name, value in reached.items()
        if not value <= options.tolerance
    ]
    if not unmet or (iterative and not residual.reached <= residual.tolerance):
        return residual
    return max(unmet, key=lambda measure: measure.reached)


def _remedy(iterative: bool) -> str:
    if iterative:
        return 'raise max_iters, loosen rtol, or choose method="direct"'
    return "lower bulk_ratio or penalty, or loosen rtol"


def finish(stats: Tensor, what: str, ctx: StokesContext, iterative: bool, on_failure: str) -> None:
    """Tell the records; warn or raise where a case did not converge."""
    if is_recording():
        announce(solve_of(stats.clone(), what, ctx.options, iterative))
    failed = stats[:, STATS.index("converged")] == 0
    if not bool(failed.any()):
        return
    first = dict(zip(STATS, stats[failed][0].tolist(), strict=True))
    measure = _measure(first, ctx.options, iterative)
    message = (
        f"{what} stopped after {first['num_iters']:.0f} iterations at {measure.name} "
        f"{measure.reached:.3e}, needed {measure.tolerance:.3e}; {measure.remedy}"
    )
    if on_failure == "warn" and math.isfinite(measure.reached):
        warn(message, ConvergenceWarning, stacklevel=2)
        return
    raise ConvergenceError(
        message,
        residual_norm=measure.reached,
        tolerance=measure.tolerance,
        num_iters=int(first["num_iters"]),
    )
