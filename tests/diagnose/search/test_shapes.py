"""Numbers of formulas, such as how soon a sensor is warm: fitted once the sizes are known."""

from dataclasses import replace

import numpy as np
import pytest

from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import Problem, WhiteNoise, fit
from diffsim.identify.linearization import linearization_at
from diffsim.systems.registry import setup_of
from tests.systems.toy_cart import TIME, cart_study

DRIFT, BEND = "sensor_drift_of_position", "bend_of_sensor_drift_of_position"


def drift_beside(study):
    """Problem of a cart with a drift of its sensor."""
    study = replace(study, runs=study.fit_runs)
    setup = setup_of(study)
    effects = [e for e in setup.effects if e.name == DRIFT]
    return Problem(setup.model, study.runs, WhiteNoise(study.channels), tuple(effects)), study


def fitted(problem):
    """The fit of a problem from its values beforehand, as a search makes it."""
    return gauss_newton(problem, linearization_at(problem, np.zeros(len(problem.names))))[0]


@pytest.mark.parametrize("lasts", [0.8, 4.0])
def test_a_sensor_that_warms_has_a_time_constant_of_its_own(lasts):
    problem, _ = drift_beside(
        cart_study(reading=lambda x: x + 0.03 * (1.0 - np.exp(-TIME / lasts)))
    )
    found = fitted(problem)
    assert found.chi2 / found.num_samples < 1.1
    assert found.values[BEND] == pytest.approx(TIME[-1] / lasts, rel=0.15)
    assert found.values[DRIFT] == pytest.approx(0.03 * (1.0 - np.exp(-TIME[-1] / lasts)), rel=0.03)


def test_a_drift_that_is_even_stays_so():
    problem, _ = drift_beside(cart_study(reading=lambda x: x + 0.03 * TIME / TIME[-1]))
    found = fitted(problem)
    assert found.values[DRIFT] == pytest.approx(0.03, rel=0.03)
    assert found.values[BEND] < 0.1


def test_a_shape_does_not_stand_in_for_what_else_is_missing():
    """A spring that grows stiffer leaves 70 noise sd, whatever the course of a small drift."""
    problem, study = drift_beside(
        cart_study(
            force=lambda x, v: -100.0 * x**3,
            reading=lambda x: x + 0.01 * (1.0 - np.exp(-2.0 * TIME)),
        )
    )
    found = fitted(problem)
    assert found.chi2 / found.num_samples > 1000.0
    assert found.values[BEND] == 0.001
    bent = fit(problem.model, study.runs, study.channels, effects=problem.effects)
    assert bent.values[BEND] > 1.0  # where nothing holds it


def test_a_shape_that_is_held_has_the_sd_that_its_slopes_tell():
    """It was saved with the sd from beforehand: bands of an even drift bent it either way."""
    problem, _ = drift_beside(
        cart_study(force=lambda x, v: -100.0 * x**3, reading=lambda x: x + 0.03 * TIME / TIME[-1])
    )
    found = fitted(problem)
    assert found.values[BEND] == 0.001
    assert found.sd[BEND] < 1.0  # 3 beforehand


def test_a_shape_that_a_budget_left_unfitted_is_no_converged_fit():
    problem, _ = drift_beside(cart_study(reading=lambda x: x + 0.03 * (1.0 - np.exp(-TIME / 0.8))))
    start = linearization_at(problem, fitted(problem).x)
    start = linearization_at(problem, np.where([n == BEND for n in problem.names], 0.0, start.x))
    spent = problem.model.simulations.steps
    found = gauss_newton(problem, start, until=spent)[0]
    assert found.values[BEND] == 0.001 and found.ended == "budget"
    assert gauss_newton(problem, start)[0].values[BEND] > 1.0


def test_a_shape_brings_a_set_up_with_a_better_one():
    """A spring between two masses lost to a delay: of its half share alone it was far behind."""
    problem, _ = drift_beside(cart_study(reading=lambda x: x + 0.03 * (1.0 - np.exp(-TIME / 0.8))))
    start, end = linearization_at(problem, np.zeros(len(problem.names))), fitted(problem)
    ahead = 0.5 * (end.chi2 + end.prior)
    found = gauss_newton(problem, start, best_cost=ahead)[0]
    assert found.values[BEND] == pytest.approx(end.values[BEND], rel=0.05)
    # nor is it bent where even so it would stay behind
    lost = gauss_newton(problem, start, best_cost=ahead - 1e6)[0]
    assert lost.values[BEND] == 0.001
