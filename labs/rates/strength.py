"""How visible a hidden cause is: lambda, simulated from recordings without noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from diffsim.cli.diagnose_inputs import inputs_of
from diffsim.core.errors import DiffsimError
from diffsim.core.threads import one_thread
from diffsim.data.study import Study
from diffsim.diagnose.search.fit import Case, null_fit
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import Fit
from diffsim.identify.linearization import linearization_at
from labs.rates.draw import Draw

MOST_TRIES = 6  # sizes that are recorded to meet a wanted visibility
NEAR = 1.25  # factor between wanted and found visibility that will do
LONGEST = 10.0  # factor from one tried size to the next
LEAST = 1e-3  # lambda of what does not show at all


class Visibility:
    """Lambda of a case's cause by its size.

    lambda^2 is what the cause adds to the least chi2 + prior of the plain model. lambda^2 / 2 are
    the nats that naming it can gain, whether it shows as a misfit or pulls base parameters off
    their data sheets.

    Args:
        case: What is hidden, in what.
    """

    def __init__(self, case: Draw):
        self.case = case
        plain = case.rig.record(case.seed, {}, case.trouble)
        inputs = inputs_of(plain.study, seed=0, setup_file=case.rig.setup_file)
        setup = inputs.setup
        study = inputs.study.without_tests()
        self.null = null_fit(
            Case(study, setup.model, setup.effects, setup.unknowns, setup.settings)
        )
        self.plain = self._cost(plain.clean)

    def __call__(self, size: float) -> float:
        """Lambda at a size."""
        case = self.case
        hidden = case.rig.record(case.seed, case.sizes(size), case.trouble)
        return float(np.sqrt(max(self._cost(hidden.clean) - self.plain, 0.0)))

    def _cost(self, clean: Study) -> float:
        fit = self._fitted(clean)
        return fit.chi2 + fit.prior

    def _fitted(self, clean: Study) -> Fit:
        """The plain model, from its fit to the noisy data and weighed as these."""
        study = inputs_of(clean, seed=0, setup_file=self.case.rig.setup_file).study
        problem = replace(self.null.fit.problem, runs=study.fit_runs)
        return gauss_newton(problem, linearization_at(problem, self.null.fit.x))[0]


@one_thread
def size_for(case: Draw) -> tuple[float, float]:
    """A size of the hidden cause with about the wanted visibility, and its lambda.

    Sizes are tried from a typical one on; a power law between the last two says which is next.
    What cannot be simulated is tried nearer to what could.

    Args:
        case: What is hidden, in what.
    """
    visible = Visibility(case)
    size = case.cause.typical
    tried: list[tuple[float, float]] = []
    for _ in range(MOST_TRIES):
        try:
            tried.append((size, max(visible(size), LEAST)))
        except (DiffsimError, RuntimeError):
            if not tried:
                raise
            size = float(np.sqrt(size * tried[-1][0]))
            continue
        if max(tried[-1][1] / case.wanted, case.wanted / tried[-1][1]) < NEAR:
            break
        size = min(_next_size(tried, case.wanted), case.cause.most)
        if any(abs(np.log(size / before)) < 0.01 for before, _ in tried):
            break
    return min(tried, key=lambda t: abs(np.log(t[1] / case.wanted)))


def _next_size(tried: Sequence[tuple[float, float]], wanted: float) -> float:
    """By a power law through the last two sizes, between those that show too little and too much.

    Args:
        tried: Sizes with their lambda.
        wanted: Lambda that is looked for.
    """
    (size, found), power = tried[-1], 1.0
    if len(tried) > 1:
        before, low = tried[-2]
        power = float(np.clip(np.log(found / low) / np.log(size / before), 0.3, 3.0))
    factor = float(np.clip((wanted / found) ** (1.0 / power), 1.0 / LONGEST, LONGEST))
    below = max((s for s, strength in tried if strength < wanted), default=0.0)
    above = min((s for s, strength in tried if strength > wanted), default=np.inf)
    if below < size * factor < above or not (0.0 < below < above < np.inf):
        return size * factor
    return float(np.sqrt(below * above))
