"""Sets of causes fitted from the data sheet, where the plain model's fit has left it.

A cause that is missing drives the base parameters away from what is known of them. Where it is
large they end in another valley, a mass at a tenth of its value, and no cause helps from there: of
two that are missing neither shows. At the values of the data sheet the truth is near in all but its
causes, and linear evidence ranks pairs of them without a simulation.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from diffsim.core.errors import DiffsimError
from diffsim.core.memo import Memo
from diffsim.data.study import Run
from diffsim.diagnose.search.evidence import TIE_DIGITS, SetPosterior
from diffsim.diagnose.search.fit import HARD_START_CHI2
from diffsim.diagnose.search.gauss_newton import LEAST_RECORDS, iterated
from diffsim.diagnose.search.scan import can_scan_one_run, groups, num_points
from diffsim.diagnose.search.simulations import NONE, Center, Members, Simulations
from diffsim.identify import Problem, Whitener
from diffsim.identify.effort import SearchSettings
from diffsim.identify.linearization import Linearization, linearization_at

Array = NDArray[np.float64]
LEAST_REFITS = 4  # sets that are fitted from there
FROM_PRIOR = 0.5  # of the budgets of scans and of refits, for those from the data sheet
PAIRED = 12  # causes that are best alone, each paired with every other


def is_prior_too_dear(
    simulations: Simulations, settings: SearchSettings, *, most_scanned: int = 0
) -> bool:
    """Whether slopes at the prior, which nobody simulated yet, would take all that is left: a table
    of which nothing is fitted is in vain.

    Args:
        simulations: Simulations made so far.
        settings: Effort of the search.
        most_scanned: Number of effects that are scanned together, at most; 0: none are. With
            them it is what is for scans and slopes, and fits from there.
    """
    wide, spent = simulations.wide, simulations.scan_steps
    points, share = 0, FROM_PRIOR if most_scanned else 1.0
    left = min(settings.scan_steps - spent, share * settings.refit_steps)
    if most_scanned:
        tried = groups(wide.effects, NONE, most_scanned)
        points = sum(num_points([wide.effects[i] for i in group]) for group in tried)
        points = min(points, settings.scan_points)
    is_made = simulations.at_prior is not None
    if most_scanned:
        together = min(most_scanned, 2)
        is_made = any(len(group) >= together for _, group in simulations.prior_scans)
    cost = wide.cost_of_table(points)
    if can_scan_one_run(wide):
        cost = wide.cost_of_table() + points * wide.cost() / len(wide.runs)
    return not is_made and cost > left


def center_at_prior(
    simulations: Simulations, settings: SearchSettings, num_families: int
) -> tuple[Center | None, Simulations]:
    """The plain model at its prior as a center, with the scans of effects with kinks where these
    leave something for fits.

    Args:
        simulations: Simulations made so far.
        settings: Effort of the search.
        num_families: Families of effects, for the evidence.

    Returns:
        The center, None where it cannot be simulated, and the simulations with the work it took.
    """
    wide = simulations.wide
    budget = FROM_PRIOR * (settings.scan_steps - simulations.scan_steps)
    x = np.clip(np.zeros(len(wide.names)), *wide.bounds)
    # kept apart: scans are known by the set that they start from, here as at the plain model's fit
    apart = replace(simulations, scans=simulations.prior_scans, place=" at the data sheet")
    # what alone has a threshold, such as a limit, comes before pairs: its slope at zero is zero
    sizes = (settings.max_effects, 1)
    affordable = (n for n in sizes if not is_prior_too_dear(simulations, settings, most_scanned=n))
    most = next(affordable, 0)
    settings = replace(
        settings, scan_steps=simulations.scan_steps + budget, max_effects=max(most, 1)
    )
    try:
        at = simulations.at_prior or apart.remembered(
            f"slopes{apart.place}", lambda: _slopes(wide, x)
        )
        center, made = apart.center(NONE, at, num_families), apart
        if most:
            center, made = apart.scanned(center, settings, num_families)
    except DiffsimError:
        return None, simulations
    made = replace(made, scans=simulations.scans, prior_scans=made.scans, place=simulations.place)
    return center, replace(made, at_prior=at)


def _slopes(wide: Problem, x: Array) -> Linearization:
    return linearization_at(wide, x, list(range(len(x))), screen=True)


class _Warm:
    """A whitener for noise that is larger by a factor: what is known beforehand holds longer."""

    def __init__(self, whitener: Whitener, factor: float):
        self._whitener, self._factor = whitener, factor
        self._made: Memo[sparse.csr_array] = Memo()

    def matrix(self, run: Run) -> sparse.csr_array:
        """(num_valid, num_samples * num_channels)."""
        return self._made(run, lambda: self._whitener.matrix(run) * (1.0 / self._factor))


def cooled(problem: Problem, start: Linearization) -> Linearization:
    """Where a fit begins that first trusts the data sheet, then the record more and more.

    Under noise so large that the record at the start is no surprise, the base parameters stay near
    their priors and the sizes move; then under the geometric mean of that noise and the true one.

    Args:
        problem: Problem of a set.
        start: Start point in its coordinates.
    """
    residual = problem.residual_of(start.record)
    excess = float(residual @ residual) / max(len(residual), 1)
    if not np.isfinite(excess) or excess < HARD_START_CHI2:
        return start
    at, cost = start, problem.cost()
    for factor in (excess**0.5, excess**0.25):
        warm = replace(problem, whitener=_Warm(problem.whitener, factor))
        until = problem.model.simulations.steps + LEAST_RECORDS * cost
        at = linearization_at(problem, iterated(warm, at, until=until)[0].at.x)
    return at


def promising_sets(center: Center, max_effects: int) -> list[tuple[Members, SetPosterior]]:
    """Single causes and pairs by their linear evidence at a center, best first."""
    count = len(center.evidence.problem.effects)
    alone = _rank_sets(center, (frozenset({i}) for i in range(count)))
    if max_effects < 2:
        return alone
    best = [next(iter(members)) for members, _ in alone[:PAIRED]]
    pairs = {frozenset({i, j}) for i in best for j in range(count) if i != j}
    found = [*alone, *_rank_sets(center, pairs)]
    return sorted(found, key=lambda e: -round(e[1].nats, TIE_DIGITS))


def _rank_sets(center: Center, sets: Iterable[Members]) -> list[tuple[Members, SetPosterior]]:
    ranked = [(members, center.weigh(members)) for members in sets]
    return sorted(ranked, key=lambda e: (-round(e[1].nats, TIE_DIGITS), sorted(e[0])))
