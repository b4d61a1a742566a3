"""What follows the last set shares one more budget."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.diagnose.search.evidence import Hypothesis
from diffsim.diagnose.search.fit import Case, null_fit
from diffsim.diagnose.search.fitted_sets import Search
from diffsim.diagnose.search.search import (
    begin,
    fitted_exactly,
    fitted_to_end,
    refit,
    repaired,
    search_sets,
)
from diffsim.diagnose.search.simulations import Simulations
from diffsim.identify.effort import DiagnosisSettings, SearchSettings
from diffsim.identify.linearization import linearization_at
from tests.diagnose import toy

EFFECTS = (toy.BIAS, toy.DELAY, toy.DRAG)
BOTH, ONE = frozenset({0, 1}), frozenset({0})
PLAIN = 4e5


def begun(plain_steps: float = np.inf) -> Search:
    """A search of the toy at its plain model."""
    study = toy.generate(4, {"bias": 0.3, "delay": 0.03})
    own = SearchSettings(max_effects=2)
    settings = DiagnosisSettings(search=own, plain_steps=plain_steps)
    null = null_fit(Case(study, toy.model(study.runs), EFFECTS, (), settings))
    return begin(null, Simulations(null.wide))


def test_it_is_counted_from_where_all_sets_are_fitted():
    search = begun()
    assert search.ends == np.inf
    model = search.wide.model
    before = model.simulations.steps
    settings = search.null.case.settings
    own = replace(settings.search, refit_steps=PLAIN)
    settings = replace(settings, search=own, plain_steps=0.5 * PLAIN)
    case = replace(search.null.case, settings=settings)
    after = search_sets(replace(search, null=replace(search.null, case=case)))
    assert before <= after.ends - PLAIN <= model.simulations.steps


@pytest.mark.parametrize("is_spent", [False, True])
def test_once_it_is_spent_nothing_is_simulated(is_spent):
    """Each of them takes what it lacks where something is left."""
    search = begun()
    for members in (ONE, BOTH):
        search = refit(search, members)
    cut = replace(search.fit_of(BOTH), chi2=1e9, ended="budget")
    posterior = replace(search.posteriors[Hypothesis(BOTH)], fit=cut)
    made = search.simulations
    away = linearization_at(made.narrow(BOTH), made.fitted[BOTH].x[: len(cut.x)] + 0.3)
    posteriors = {**search.posteriors, Hypothesis(BOTH): posterior}
    search = replace(search, posteriors=posteriors, simulations=made.kept(BOTH, away))
    search = replace(search, ends=search.steps if is_spent else np.inf)
    tally = search.wide.model.simulations
    for stage in (
        repaired,
        lambda s: fitted_exactly(s, BOTH),
        lambda s: fitted_to_end(s, [BOTH]),
    ):
        before = tally.steps
        stage(search)
        assert (tally.steps > before) != is_spent
    assert repaired(search).num_late == int(is_spent)
    exact = fitted_exactly(search, BOTH)
    assert exact.num_late == int(is_spent) and (BOTH in exact.exact) != is_spent
    if not is_spent:  # once its slopes are right, nothing is lacking
        assert fitted_exactly(replace(exact, ends=exact.steps), BOTH).num_late == 0
