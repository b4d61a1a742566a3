"""First fit of the plain model, where whole runs are too hard: growing time windows.

The misfit of a long run has many minima: a frequency that is a little off is out of phase at its
end, an unstable motion leaves the range of numbers. A quarter of each run has a wide valley. Its
end starts the fit to half, and that to all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from diffsim.core.errors import DiffsimError
from diffsim.data.study import Run
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import Fit, Problem
from diffsim.identify.linearization import Linearization, linearization_at

Array = NDArray[np.float64]
MIN_SAMPLES = 8  # of a run in a window
FAR = 25.0  # chi2 per sample from which short windows are asked
ABOVE = 10.0  # chi2 per sample over that of the shortest window, from which longer ones are fitted
MAX_SHORTENED = 4

Ended = tuple[Fit, Linearization]


def first_fit(problem: Problem, windows: Sequence[float]) -> Ended:
    """Fit of the plain model from its prior; through growing windows where that fails.

    A model that cannot be simulated over its own windows (multiple shooting) is asked for shorter
    ones, ``SimModel.shortened``; the fit's problem holds the model that was used.

    Args:
        problem: The plain model on the runs to be fitted.
        windows: Shares of each run that are fitted first, ascending; (): only whole runs.

    Raises:
        DiffsimError: neither whole runs nor windows can be simulated and fitted.
    """
    model = problem.model
    for _ in range(MAX_SHORTENED):
        problem = replace(problem, model=model)
        try:
            return _grown(problem, windows)
        except DiffsimError:
            shorter = model.shortened()
            if shorter is None:
                raise
            shorter.simulations = model.simulations  # goes on counting
            model = shorter
    return _grown(problem, windows)


def cut(run: Run, share: float) -> Run:
    """The first part of a run.

    Args:
        run: Recorded run.
        share: Share of its samples that is kept.
    """
    count = len(run.time_s)
    keep = min(max(int(np.ceil(share * count)), MIN_SAMPLES), count)
    command = {
        name: values[:keep] if len(values) == count else values
        for name, values in run.command.items()
    }
    return replace(run, time_s=run.time_s[:keep], measured=run.measured[:keep], command=command)


def _grown(problem: Problem, windows: Sequence[float]) -> Ended:
    start = np.zeros(problem.num_base)
    try:
        whole = gauss_newton(problem, linearization_at(problem, start))
    except DiffsimError as error:
        if not windows:
            raise
        found = _through(problem, start, windows, None)
        if found is None:
            raise error
        return found
    if not windows or (whole[0].converged and _per_sample(whole[0]) < FAR):
        return whole
    through = _through(problem, start, windows, whole[0])
    ends = [whole] if through is None else [whole, through]
    return min(ends, key=lambda end: end[0].chi2 + end[0].prior)


def _through(
    problem: Problem, x: Array, windows: Sequence[float], whole: Fit | None
) -> Ended | None:
    """Fits to growing parts of the runs; None where they fail, or promise nothing better."""
    for k, share in enumerate(windows):
        part = replace(problem, runs=tuple(cut(run, share) for run in problem.runs))
        try:
            short, _ = gauss_newton(part, linearization_at(part, x))
        except (DiffsimError, ValueError):  # too hard still, or a model of whole runs only
            continue
        is_hopeful = whole is None or _per_sample(whole) > ABOVE * _per_sample(short)
        if k == 0 and whole is not None and whole.converged and not is_hopeful:
            return None
        x = short.x
    try:
        return gauss_newton(problem, linearization_at(problem, x))
    except DiffsimError:
        return None


def _per_sample(fit: Fit) -> float:
    return max(fit.chi2 / fit.num_samples, 1.0)
