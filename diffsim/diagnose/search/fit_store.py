"""Fits kept on disk by their start, so that a resumed search takes the same way to the last bit."""

from __future__ import annotations

import hashlib
from typing import cast

import numpy as np

from diffsim.core.record import Ended
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.diagnose.search.store import Store
from diffsim.identify import Fit, Problem
from diffsim.identify.fitting import summary
from diffsim.identify.linearization import Linearization, measured_of, whitened


def gauss_newton_kept(
    store: Store | None, problem: Problem, start: Linearization, best_cost: float
) -> tuple[Fit, Linearization]:
    """``gauss_newton``, read back where an earlier process ended the same fit.

    A finished fit does not serve as the start of itself: its trust region would be another one,
    and the resumed search would end elsewhere within the tolerance.

    Args:
        store: Fits of this study, model and set of candidates; None: none are kept.
        problem: Fitting problem that is minimized.
        start: Start point, with the slopes of all coordinates.
        best_cost: As of ``gauss_newton`` [nats].
    """
    if store is None:
        return gauss_newton(problem, start, best_cost=best_cost)
    name = f"ended fit {_digest(problem, start, best_cost)}"
    kept = store.load_arrays(name)
    if kept is None:
        fit, at = gauss_newton(problem, start, best_cost=best_cost)
        store.save_arrays(
            name,
            x=at.x,
            record=at.record,
            columns=at.columns,
            slope_error=np.array(at.slope_error),
            residual=fit.residual,
            jacobian=fit.jacobian,
            ended=np.array(fit.ended),
            message=np.array(fit.message),
            evaluations=np.array(fit.num_evaluations),
        )
        return fit, at
    coordinates = tuple(range(len(kept["x"])))
    at = Linearization(
        kept["x"], kept["record"], coordinates, kept["columns"], float(kept["slope_error"])
    )
    fit = summary(
        problem,
        at.x,
        kept["residual"],
        kept["jacobian"],
        cast(Ended, str(kept["ended"])),
        str(kept["message"]),
        int(kept["evaluations"]),
    )
    return fit, at


def _digest(problem: Problem, start: Linearization, best_cost: float) -> str:
    """Of all that decides where a fit ends; the noise floor shows in the whitened residual."""
    residual = whitened(problem, measured_of(problem) - start.record)
    digest = hashlib.sha256(repr((problem.names, best_cost, start.slope_error)).encode())
    for array in (start.x, start.record, start.slopes(range(len(start.x))), residual):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
